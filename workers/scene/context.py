"""The context of a worker process: the job, its assets, the renderer, and the C library's allocator."""

import contextlib
import ctypes
from dataclasses import dataclass

import cv2

from schemas.job.job import Job, settings_digest
from workers.assets.catalogue import Catalogue
from workers.render.raster.gbuffer import Renderer, shared_renderer


@dataclass(frozen=True, eq=False)
class WorkerContext:
    """What a process holds while it makes scenes; one for each process, as the renderer has its one GL context."""

    job: Job
    catalogue: Catalogue
    renderer: Renderer
    settings_digest: str
    forced: frozenset[str] = frozenset()
    """Effects that run also where a scene does not call for them: no switches of the job. For the audit."""
    withdrawn: frozenset[str] = frozenset()
    """Effects that do not run even where a scene calls for them. For tests."""


def open_worker(job: Job, catalogue: Catalogue) -> WorkerContext:
    """Prepare this process, its allocator, OpenCV and its renderer, for the job's scenes."""
    keep_freed_memory()
    cv2.setNumThreads(1)  # there is a worker for each core: its threads would wait for those of other workers
    return WorkerContext(job, catalogue, shared_renderer(), settings_digest(job, catalogue.digest))


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
