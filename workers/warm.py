"""Imported by a fork server: what numba loads at a process's first compiled loop, 0.4 s, is loaded once for all children."""

import sys

if "numba" in sys.modules:
    from numba.core.registry import cpu_target

    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
