"""The context of a worker process: the job, its assets, the renderer."""

import hashlib
import json
from dataclasses import dataclass

from schemas.job.job import Job
from workers.assets.catalogue import Catalogue
from workers.pipeline.allocator import keep_freed_memory
from workers.render.raster.gbuffer import Renderer, shared_renderer

OUTSIDE_SETTINGS = {"name", "scenes", "first_scene", "run", "output", "verso", "preset"}
"""Keys of a job that do not change what a scene is."""


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
    """Prepare this process, its allocator and its renderer, for the job's scenes."""
    keep_freed_memory()
    return WorkerContext(job, catalogue, shared_renderer(), settings_digest(job, catalogue.digest))


def settings_digest(job: Job, catalogue_digest: str) -> str:
    """SHA-256, hex, of the settings and assets that decide what a scene is.

    Without the paths of asset folders, as the same files elsewhere are the same assets, and without sensor effects that
    are off.
    """
    settings = job.model_dump(mode="json", exclude=OUTSIDE_SETTINGS)
    settings["sensor"] = {name: effect for name, effect in settings["sensor"].items() if effect is not None}
    if not settings["sensor"]:
        del settings["sensor"]
    for source in (*settings["assets"]["objects"], *settings["assets"]["tables"]):
        source.pop("folder", None)
    text = json.dumps([settings, catalogue_digest], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
