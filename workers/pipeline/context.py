"""The context of a worker process: the job, its assets, the renderer."""

from dataclasses import dataclass

import cv2

from schemas.job.identity import settings_digest
from schemas.job.job import Job
from workers.assets.catalogue import Catalogue
from workers.pipeline.allocator import keep_freed_memory
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
