"""The processes that measure errors, one for each core; times are taken elsewhere, and not while these work."""

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from schemas.job.job import Job
from services.study.measure.looking import measure_colour, measure_pictures
from services.study.measure.settling import measure_settling
from services.study.model import Setting
from workers.assets.catalogue import open_catalogue
from workers.pipeline.context import WorkerContext, open_worker


@dataclass(frozen=True)
class Task:
    """One scene with these settings: `kind` is settling, images or colour; `posed` and `released` are settling's."""

    name: str
    kind: str
    settings: tuple[Setting, ...]
    scene_id: int
    posed: bool = False
    released: bool = False


@dataclass(frozen=True)
class Crew:
    """So many processes for one job."""

    job: Job
    job_folder: Path
    processes: int

    def measure(self, tasks: Sequence[Task]) -> Iterator[tuple[str, Any]]:
        """Answers by name, as they are ready. What a task raises is raised here; the others are dropped."""
        if not tasks:
            return
        fresh = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(self.processes, mp_context=fresh) as pool:
            told = self.job.model_dump_json(), str(self.job_folder)
            running = {pool.submit(_work, *told, task): task.name for task in tasks}
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


def _work(job: str, folder: str, task: Task) -> Any:
    context = _context(job, folder)
    if task.kind == "settling":
        return measure_settling(context, task.settings, task.scene_id, task.posed, task.released)
    measure = measure_pictures if task.kind == "images" else measure_colour
    return measure(context, task.settings, task.scene_id)
