"""The C library's allocator, set to keep the memory that freed arrays give back."""

import contextlib
import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Names of mallopt(3)."""

OWN_PAGES_BYTES = 32 * 2**20
"""Larger blocks, such as an image of 4096 x 4096 in float64, still come from the kernel and go back to it."""

KEPT_BYTES = 64 * 2**20
"""The free memory at the end of the heap that is kept at most: about what a scene of 640 x 480 images needs."""


def keep_freed_memory() -> None:
    """Reuse freed arrays of megabytes without asking the kernel for their pages each time.

    By default glibc returns every block above 128 KiB at once, and an image is 0.3 to 7 MB: a sixth of a scene's time
    went into 21,000 page faults, where 1,200 are enough. Does nothing with another C library.
    """
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, OWN_PAGES_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
