"""Shards of small jobs, run in this process onto a disk."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from schemas.dataset.commit import Span
from schemas.dataset.shard import ShardOrder, ShardReport
from schemas.job.job import Job
from workers.assets.catalogue import open_catalogue
from workers.shard.run_shard import run_shard
from workers.store.local import LocalStore


def run(
    job: Job, out: Path, *spans: tuple[int, int], is_over: Callable[[], bool] = lambda: False, **changes: Any
) -> ShardReport:
    """The report of a shard of these ranges, with changes of its order."""
    whole = tuple(Span(start=start, stop=stop) for start, stop in spans)
    order = ShardOrder.of(str(out), job, "test").model_copy(update={"spans": whole, **changes})
    LocalStore(out).prepare()
    return run_shard(order, open_catalogue(job.assets, Path(), tuple(job.categories)), is_over)
