"""What of a dataset is still to be made, such that ranges never overlap; and which commits it had once and has no more."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from schemas.dataset.commit import Ledger, Span
from schemas.dataset.layout import commit_path
from schemas.errors import OutputError
from schemas.job.job import Job

MAX_SHARD = 64
"""Scenes in a shard of a large job: seconds of work for each millisecond that Ray takes to hand it out."""

MOST_RANGES = 4
"""Ranges in a shard whose size the job does not give."""


@dataclass(frozen=True)
class SpanPlan:
    """The spans that are still to be made, in order, and the number of their scenes. Spans are made one at a time, once."""

    scenes: int
    ranges: Iterable[tuple[int, int]]
    retries: Sequence[Span] = ()

    def __iter__(self) -> Iterator[Span]:
        yield from (Span(start=start, stop=stop) for start, stop in self.ranges)
        yield from self.retries


def plan_spans(job: Job, ledger: Ledger, retry_failed: bool) -> SpanPlan:
    """The missing ranges, and with `retry_failed` the scenes to try again. Raises as `plan_ranges`."""
    ranges = plan_ranges(job.first_scene, job.stop_scene, job.range_size, ledger.ranges)
    retries = plan_retries(ledger) if retry_failed else []
    return SpanPlan(job.scenes - ledger.committed + sum(span.count for span in retries), ranges, retries)


def plan_ranges(
    first_scene: int, stop_scene: int, range_size: int, committed: NDArray[np.int64] | Sequence[tuple[int, int]]
) -> Iterator[tuple[int, int]]:
    """The missing ranges [start, stop), in order, one at a time. `committed`, [N, 2] in any order, may be out of date.

    Grid lines lie at first_scene + k * range_size. In a cell between two, only the line and the stop of a committed range are
    ever planned as a start; a range ends at the next line or at stop_scene. Ranges cannot overlap, even if planners have old
    views and other values of stop_scene: a record is put only if absent, so one start has one range for ever, and the ranges
    of a cell form one chain from its line. An old view lacks the end of a chain: it plans a start that is taken, and loses
    the put.

    Raises OutputError where scenes outside [first_scene, stop_scene) are committed: fewer scenes than committed is
    refused; and where committed ranges do not lie on this grid.
    """
    if range_size < 1 or stop_scene <= first_scene:
        raise ValueError(f"no ranges of {range_size} scenes in [{first_scene}, {stop_scene})")
    ranges = np.asarray(committed, np.int64).reshape(-1, 2)
    ranges = ranges[np.argsort(ranges[:, 0])]
    _check_grid(first_scene, stop_scene, range_size, ranges)
    return _missing(first_scene, stop_scene, range_size, ranges)


def _missing(
    first_scene: int, stop_scene: int, range_size: int, ranges: NDArray[np.int64]
) -> Iterator[tuple[int, int]]:
    """The ranges that are missing on a grid that is checked; only cells that lack something take any time."""
    cells = (ranges[:, 0] - first_scene) // range_size
    last = np.append(cells[1:] != cells[:-1], True)[: len(cells)]
    cells, ends = cells[last], ranges[last, 1]  # in a cell, the range that starts last stops last
    lines = np.minimum(first_scene + (cells + 1) * range_size, stop_scene)
    following = np.append(cells[1:], math.ceil((stop_scene - first_scene) / range_size))[: len(cells)]
    gaps = np.flatnonzero((ends < lines) | (following != cells + 1))
    begun = int(cells[0]) if len(cells) else math.ceil((stop_scene - first_scene) / range_size)

    def whole(cell: int, stop_cell: int) -> Iterator[tuple[int, int]]:
        for start in range(first_scene + cell * range_size, first_scene + stop_cell * range_size, range_size):
            yield start, min(start + range_size, stop_scene)

    yield from whole(0, begun)
    for at in gaps:
        if ends[at] < lines[at]:
            yield int(ends[at]), int(lines[at])
        yield from whole(int(cells[at]) + 1, int(following[at]))


def plan_retries(ledger: Ledger) -> list[Span]:
    """One span for each range that still has environmental failures, with those scenes alone."""
    failed = ledger.failures
    failed = failed.filter(pc.equal(failed.column("kind"), "environmental"))
    pairs = zip(failed.column("start").to_pylist(), failed.column("scene_id").to_pylist(), strict=True)
    spans = []
    for start, group in groupby(pairs, key=itemgetter(0)):
        at = int(np.searchsorted(ledger.start, start, side="right")) - 1
        scenes = tuple(scene for _, scene in group)
        spans.append(Span(start=start, stop=int(ledger.stop[at]), retry=int(ledger.retry[at]) + 1, scenes=scenes))
    return spans


def deal_shards(
    spans: Iterable[Span], scenes: int, range_size: int, count_slots: Callable[[], int], shard_size: int | None = None
) -> Iterator[tuple[Span, ...]]:
    """Whole ranges in order, in shards of `shard_size` scenes or a little more. Made one at a time, on demand.

    Without a size, shards get smaller towards the end, so that all slots end at nearly the same time. A shard has half of an
    even share of the scenes that are left, and at most 64. At most four ranges, so that slow scenes, which have short ranges,
    have short shards too. `scenes` are those of all spans.
    """
    most, left, waiting = min(MAX_SHARD, MOST_RANGES * range_size), scenes, iter(spans)
    while True:
        least = shard_size or max(1, min(most, math.ceil(left / (2 * count_slots()))))
        shard: list[Span] = []
        while sum(span.count for span in shard) < least and (span := next(waiting, None)) is not None:
            shard.append(span)
        if not shard:
            return
        left -= sum(span.count for span in shard)
        yield tuple(shard)


def _check_grid(first_scene: int, stop_scene: int, range_size: int, ranges: NDArray[np.int64]) -> None:
    if not len(ranges):
        return
    start, stop = ranges.T
    if start.min() < first_scene or stop.max() > stop_scene:
        raise OutputError(
            f"scenes {start.min()} to {stop.max() - 1} are committed, more than the job's {first_scene} to "
            f"{stop_scene - 1}: fewer scenes than committed are refused, ask for at least as many or choose another --out"
        )
    line = first_scene + (start - first_scene) // range_size * range_size
    wrong = (stop <= start) | (stop > line + range_size) | ((start != line) & ~np.isin(start, stop))
    if wrong.any():
        at = int(np.flatnonzero(wrong)[0])
        raise OutputError(
            f"the committed range [{start[at]}, {stop[at]}) does not fit ranges of {range_size} scenes from {first_scene}: "
            "a dataset keeps the range_size of its first run"
        )


MOST_TOLD = 20


def find_lost(ledger: Ledger) -> list[str]:
    """What is lost, a line each with the remedy; empty where every commit of the kept summary is there."""
    remedy = "restore it from a copy, or run the job again to make its scenes anew"
    lines = [
        f"{commit_path(start, retry)} is lost: it was committed, and is gone; {remedy}" for start, retry in ledger.lost
    ]
    if len(lines) > MOST_TOLD:
        lines[MOST_TOLD:] = [f"{len(lines) - MOST_TOLD} more commits are lost; {remedy}"]
    return lines
