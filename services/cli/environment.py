"""Edge: restarts a command in the environment that its bytes depend on (schemas/environment.py)."""

import os
import sys
from pathlib import Path

from schemas.environment import settings_to_change


def processor_flags(cpuinfo: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """The features of this machine's first core as Linux names them; empty where it does not say."""
    try:
        with cpuinfo.open() as lines:
            first = next((line for line in lines if line.startswith("flags")), "")
    except OSError:
        return frozenset()
    return frozenset(first.partition(":")[2].split())


def enter_stack_environment() -> None:
    """Return at once if the environment is the stack's; else run this same command line again in it.

    For a command's own start only: the process is replaced, with the same interpreter, options and arguments.
    """
    changes = settings_to_change(os.environ, processor_flags())
    if changes:
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, **changes})
