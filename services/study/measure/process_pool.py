"""A pool of processes, one for each core, that measures errors. Times are taken elsewhere, while the pool is idle."""

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any

from schemas.job.job import Job
from services.study.measure.scene_images import measure_colour, measure_scene_images
from services.study.measure.settling import measure_settling
from services.study.rounds import Unit
from workers.assets.catalogue import open_catalogue
from workers.pipeline.context import WorkerContext, open_worker


def measure_in_pool(job: Job, job_folder: Path, processes: int, units: Sequence[Unit]) -> Iterator[tuple[str, Any]]:
    """Answers by the units' names, as they are ready. What a unit raises is raised here, and the others are dropped."""
    if not units:
        return
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=fresh) as pool:
        told = job.model_dump_json(), str(job_folder)
        running = {pool.submit(_measure, *told, unit): unit.name for unit in units}
        try:
            for done in as_completed(running):
                yield running[done], done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


@cache
def _context(job: str, folder: str) -> WorkerContext:
    parsed = Job.model_validate_json(job)
    return open_worker(parsed, open_catalogue(parsed.assets, Path(folder), tuple(parsed.categories)))


def _measure(job: str, folder: str, unit: Unit) -> Any:
    context = _context(job, folder)
    if unit.kind == "settling":
        return measure_settling(context, unit.settings, unit.scene_id, unit.posed, unit.released)
    measure = measure_scene_images if unit.kind == "images" else measure_colour
    return measure(context, unit.settings, unit.scene_id)
