"""How this process's C library keeps the memory that arrays give back."""

import contextlib
import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Names of mallopt(3)."""

OWN_PAGES_BYTES = 32 * 2**20
"""Larger blocks still come from the kernel and go back to it: an image of 4096 x 4096 in float64 does."""

KEPT_BYTES = 64 * 2**20
"""At most this much that is free at the end of the heap stays: about what a scene of 640 x 480 images needs."""


def keep_freed_memory() -> None:
    """Let freed arrays of megabytes be used again without asking the kernel for their pages each time.

    By default glibc returns every block above 128 KiB at once, and an image is 0.3 to 7 MB: of a scene's time a sixth
    went into page faults, 21,000 of them, where 1,200 are enough. Nothing happens with another C library.
    """
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, OWN_PAGES_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
