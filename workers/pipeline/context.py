"""What a worker process holds while it makes scenes: the job, its assets, the renderer."""

from dataclasses import dataclass

from schemas.job.identity import settings_digest
from schemas.job.job import Job
from workers.assets.catalogue import Catalogue
from workers.pipeline.allocator import keep_freed_memory
from workers.render.raster.gbuffer import Renderer, shared_renderer


@dataclass(frozen=True, eq=False)
class WorkerContext:
    """One for each process: the renderer has the process's one GL context."""

    job: Job
    catalogue: Catalogue
    renderer: Renderer
    settings_digest: str
    forced: frozenset[str] = frozenset()
    """Effects that run also where a scene does not call for them: no switches of the job. For the audit."""


def open_worker(job: Job, catalogue: Catalogue) -> WorkerContext:
    """This process made ready to make the job's scenes: its allocator, its renderer."""
    keep_freed_memory()
    return WorkerContext(job, catalogue, shared_renderer(), settings_digest(job, catalogue.digest))
