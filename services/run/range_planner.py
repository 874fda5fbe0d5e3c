"""Planning of the ranges that are still to be made, such that ranges never overlap."""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby

from schemas.dataset.commit import CommitSummary, Span
from schemas.errors import OutputError
from schemas.job.job import Job

MAX_SHARD = 64
"""Scenes in a shard of a large job: seconds of work for each millisecond that Ray takes to hand it out."""


def plan_spans(job: Job, commits: Sequence[CommitSummary], retry_failed: bool) -> list[Span]:
    """The missing ranges, and with `retry_failed` the scenes to try again. Raises as `plan_ranges`."""
    ranges = plan_ranges(job.first_scene, job.stop_scene, job.run.range_size, committed_ranges(commits))
    spans = [Span(start=start, stop=stop) for start, stop in ranges]
    return spans + plan_retries(commits) if retry_failed else spans


def plan_ranges(
    first_scene: int, stop_scene: int, range_size: int, committed: Iterable[tuple[int, int]]
) -> list[tuple[int, int]]:
    """The missing ranges [start, stop), in order. `committed` may be out of date: planners never conflict.

    Grid lines lie at first_scene + k * range_size. No range crosses one. Within a cell, the only starts that are ever
    planned are the cell's own line and the stop of a committed range. A range ends at the next line or at stop_scene,
    whichever comes first.

    Ranges cannot overlap, even if planners have old views and other values of stop_scene: a record is put only if
    absent, so one start has one range for ever. In a cell, the first committed range can only begin at the line (no stop
    existed before it), and each later one begins where one of them stops. So they form a single chain without overlap,
    and no range leaves its cell. An old view lacks the end of a chain: it plans a start that is taken, and loses the
    put.

    Raises OutputError where scenes outside [first_scene, stop_scene) are committed: fewer scenes than committed is
    refused; and where committed ranges do not lie on this grid.
    """
    if range_size < 1 or stop_scene <= first_scene:
        raise ValueError(f"no ranges of {range_size} scenes in [{first_scene}, {stop_scene})")
    stops = dict(committed)
    _check_grid(first_scene, stop_scene, range_size, stops)
    missing = []
    for line in range(first_scene, stop_scene, range_size):
        start, end = line, min(line + range_size, stop_scene)
        while start in stops:
            start = stops[start]
        if start < end:
            missing.append((start, end))
    return missing


def plan_retries(summaries: Sequence[CommitSummary]) -> list[Span]:
    """One span for each range that still has environmental failures, with those scenes alone."""
    spans = []
    for group in ranges_with_retries(summaries):
        scenes = tuple(scene for scene, kind in effective_failures(group) if kind == "environmental")
        if scenes:
            spans.append(Span(start=group[0].start, stop=group[0].stop, retry=group[-1].retry + 1, scenes=scenes))
    return spans


def choose_shard_size(scenes: int, slots: int) -> int:
    """Scenes in a shard: enough that Ray costs little, few enough that every slot has at least two shards."""
    return min(MAX_SHARD, math.ceil(scenes / (2 * slots)))


def group_shards(spans: Sequence[Span], shard_size: int) -> Iterator[tuple[Span, ...]]:
    """Whole ranges in order, grouped until they hold at least `shard_size` scenes. Made one at a time, on demand."""
    shard: list[Span] = []
    for span in spans:
        shard.append(span)
        if sum(len(one.scene_ids) for one in shard) >= shard_size:
            yield tuple(shard)
            shard = []
    if shard:
        yield tuple(shard)


def committed_ranges(summaries: Iterable[CommitSummary]) -> list[tuple[int, int]]:
    """(start, stop) of every committed range, in order."""
    return [(one.start, one.stop) for one in summaries if one.retry == 0]


def ranges_with_retries(summaries: Iterable[CommitSummary]) -> list[list[CommitSummary]]:
    """The commits of each range: itself, then its retries in order."""
    ordered = sorted(summaries, key=lambda one: (one.start, one.retry))
    return [list(group) for _, group in groupby(ordered, key=lambda one: one.start)]


def effective_failures(group: Sequence[CommitSummary]) -> list[tuple[int, str]]:
    """(scene id, kind) of the scenes of one range that failed, after all its retries, in order."""
    failed: dict[int, str] = {}
    for one in group:
        for scene in one.scenes:
            failed.pop(scene, None)
        failed.update((scene, kind) for scene, kind, _ in one.failed)
    return sorted(failed.items())


def _check_grid(first_scene: int, stop_scene: int, range_size: int, stops: dict[int, int]) -> None:
    last = max(stops.values(), default=first_scene)
    if min(stops, default=first_scene) < first_scene or last > stop_scene:
        raise OutputError(
            f"scenes {min(stops)} to {last - 1} are committed, more than the job's {first_scene} to {stop_scene - 1}: "
            "fewer scenes than committed are refused, ask for at least as many or choose another --out"
        )
    known_stops = set(stops.values())
    for start, stop in stops.items():
        line = first_scene + (start - first_scene) // range_size * range_size
        if stop <= start or stop > line + range_size or (start != line and start not in known_stops):
            raise OutputError(
                f"the committed range [{start}, {stop}) does not fit ranges of {range_size} scenes from {first_scene}: "
                "a dataset keeps the range_size of its first run"
            )
