"""How far each hard case is from its bound, and whether another setting of the processor changes how it ends.

    python -m tests.hard_cases.margins docs/hard_cases.csv [--all] [--seeds 20]

A margin is the distance of the mean figure from its bound in standard deviations over seeds. A seed moves every object at
release by up to 10 micrometres and 0.002 degrees, which changes no declared outcome; a chaotic case has seeds of its own,
and of what cameras measure the noise has them. The other setting takes away AVX2 and FMA from numpy, OpenBLAS and numba.
Lines that the table has stay, and each new line is written as soon as it is there: delete a line to measure its case again.
"""

import argparse
import csv
import dataclasses
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import groupby
from multiprocessing.pool import Pool
from pathlib import Path

from schemas.environment import KEEP
from schemas.errors import CaptureError, SceneError
from tests.hard_cases import (
    capture_cases,
    flight_cases,
    recording_cases,
    surface_cases,
    test_chaotic_cases,
    test_hard_cases,
)
from tests.hard_cases.camera_cases import CAMERAS, HOLD, CameraCase
from tests.hard_cases.case import Case, nudged, refuse
from tests.hard_cases.cases import CASES
from tests.hard_cases.chaotic_cases import CHAOTIC, SEEDS, Chaotic
from workers.render.raster.gbuffer import shared_renderer

RESTS = "rests"
"""Begins what is declared of a chaotic case: the share of seeds that must come to rest."""

WEAK = 2.0
"""Spreads: a case whose margin is smaller is weak."""

OTHER_PROCESSOR = {
    KEEP: "1",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4,AVX512_ICL,AVX512_SPR",
    "OPENBLAS_CORETYPE": "Nehalem",
    "NUMBA_CPU_NAME": "nehalem",
    "NUMBA_CPU_FEATURES": "+sse4.2",
}

TIERS = ("", "minute", "slow")
"""Markers of tests, by what they take."""

COLUMNS = (
    *("case", "declared", "ended", "wrong", "measured", "figure"),
    *("bound", "spread", "margin", "seconds", "other_processor"),
)


@dataclass(frozen=True)
class Ending:
    """How one seed of a case ended: in a word, what was measured, its seconds of processor, and what is wrong with it."""

    ended: str
    what: str = ""
    figure: float | None = None
    bound: float | None = None
    seconds: float = 0.0
    wrong: str = ""


@dataclass(frozen=True)
class Series:
    """A case over seeds. `seeded` is false where nothing in it is random; `tier` is the marker of its test."""

    name: str
    declared: str
    end: Callable[[int], Ending]
    seeded: bool = True
    tier: str = ""


# ---------------------------------------------------------------------------------------------- one seed of a case


def _at_rest(case: Case, seed: int) -> Ending:
    made, end = test_hard_cases.ending(case, partial(nudged, seed=seed))
    what, figure, bound, wrong = test_hard_cases.judge(case, made, end)
    ended = end.reason if isinstance(end, SceneError) else "settled"
    return Ending("wrong" if wrong else ended, what, figure, bound, wrong=wrong)


FLAGGED = capture_cases.FLAG
ENDED = {HOLD: "holds", FLAGGED: "flagged"}


def _chaotic(case: Chaotic, seed: int) -> Ending:
    made, end = test_chaotic_cases.ending(case, seed)
    if isinstance(end, SceneError):
        return Ending(end.reason)
    return Ending("settled", case.measure.what, float(case.measure.of(made, end)), case.measure.bound)


def _held(outcome: str, what: str, bound: float, figure: Callable[[int], float | None], seed: int) -> Ending:
    try:
        value = figure(seed)
        ended = FLAGGED if value is None else HOLD
    except (SceneError, CaptureError) as error:
        value, ended = None, refuse(error.reason)
    if ended != outcome or (value is not None and value > bound):
        return Ending("wrong", what, value, bound, wrong=ended)
    return Ending(ENDED.get(ended, ended.removeprefix(refuse(""))), what, value, bound if value is not None else None)


def _captured(case: capture_cases.CaptureCase, seed: int) -> float | None:
    with tempfile.TemporaryDirectory() as folder:
        return capture_cases.run(case, Path(folder), seed)[0]


def _drawn(case: CameraCase, _: int) -> float:
    return case.figure(shared_renderer())


def _recorded(case: recording_cases.RecordingCase, _: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        return recording_cases.worst_table_mm(case, Path(folder))


def _flown_deg(flight: flight_cases.Flight, _: int) -> float:
    return flight_cases.turned_otherwise_deg(flight_cases.flown(flight)[0], flight_cases.exact(flight)[0])


@cache
def all_series() -> tuple[Series, ...]:
    """Every hard case."""
    found = [Series(case.name, case.outcome, partial(_at_rest, case), tier=case.tier) for case in CASES]
    found += [Series(one.name, f"{RESTS} {one.rests:.0%}", partial(_chaotic, one), tier=one.tier) for one in CHAOTIC]
    found += [
        Series(one.name, one.outcome, partial(_held, one.outcome, one.what, one.bound, partial(_drawn, one)), False)
        for one in CAMERAS
    ]
    for capture in capture_cases.CAPTURES:
        end = partial(_held, capture.outcome, "worst camera, mm", capture.bound, partial(_captured, capture))
        found.append(Series(f"capture: {capture.name}", capture.outcome, end))
    for recording in recording_cases.RECORDINGS:
        end = partial(
            _held, recording.outcome, "depth of the table, mm", recording_cases.DEPTH_MM, partial(_recorded, recording)
        )
        found.append(Series(f"recording: {recording.name}", recording.outcome, end, False))
    for surface in surface_cases.SURFACES:
        end = partial(
            _held, surface.outcome, "cloud off, 95 %, mm", surface_cases.P95_MM, partial(surface_cases.p95_mm, surface)
        )
        found.append(Series(f"surface: {surface.name}", surface.outcome, end))
    for flight in flight_cases.FLIGHTS:
        end = partial(_held, HOLD, "turned otherwise, deg", flight.degrees, partial(_flown_deg, flight))
        found.append(Series(flight.name, HOLD, end, False))
    return tuple(found)


# ---------------------------------------------------------------------------------------------- the table


def margin(figures: Sequence[float], bound: float) -> float:
    """Distance of the mean from the bound in standard deviations; infinite where all figures are alike and within it."""
    spread, left = statistics.pstdev(figures), bound - statistics.fmean(figures)
    return left / spread if spread > 1e-12 * abs(bound) else float("inf") * (1.0 if left >= 0.0 else -1.0)


def line_of(series: Series, ends: Sequence[Ending], other: Ending) -> dict[str, str]:
    """A line of the table, from the endings of the seeds, the first as declared, and of that with the other processor."""
    counts = {word: sum(one.ended == word for one in ends) for word in dict.fromkeys(one.ended for one in ends)}
    measured = [one for one in ends if one.figure is not None and one.bound is not None]
    bounds = {one.bound for one in measured if one.bound is not None}
    line = dict.fromkeys(COLUMNS, "") | {
        "case": series.name,
        "declared": series.declared,
        "ended": ", ".join(f"{word} {count}" for word, count in counts.items()),
        "wrong": next((one.wrong.rstrip("; ") for one in ends if one.wrong), ""),
        "seconds": f"{statistics.median(one.seconds for one in ends):.2g}",
        "other_processor": "the same" if other.ended == ends[0].ended else other.ended,
    }
    if len(bounds) != 1:  # nothing was measured, or some seeds rest and others leave the table
        return line
    figures, bound = [one.figure for one in measured if one.figure is not None], float(*bounds)
    line |= {"measured": measured[0].what, "figure": f"{max(figures):.3g}", "bound": f"{bound:g}"}
    if series.seeded and len(figures) > 1:
        line |= {"spread": f"{statistics.pstdev(figures):.2g}", "margin": f"{margin(figures, bound):.3g}"}
    return line


def _timed(task: tuple[int, int]) -> tuple[tuple[int, int], Ending]:
    place, seed = task
    began = time.process_time()
    try:
        end = all_series()[place].end(seed)
    except Exception as error:  # one line of the table, and not the end of an hour's work
        end = Ending("wrong", wrong=f"{type(error).__name__}: {error}")
    return task, dataclasses.replace(end, seconds=time.process_time() - began)


def _pool(processes: int, environment: Mapping[str, str]) -> Pool:
    """Processes that have these variables beside this one's."""
    kept = dict(os.environ)
    os.environ |= environment
    try:
        return multiprocessing.get_context("spawn").Pool(processes)
    finally:
        os.environ.clear()
        os.environ |= kept


def main() -> int:
    """0 where every case ended as declared with every seed and on the other processor, with a margin that is not weak."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("file", type=Path, help="the table, CSV")
    ask.add_argument("--all", action="store_true", help="cases too that take a minute or more a seed")
    ask.add_argument("--seeds", type=int, default=SEEDS)
    ask.add_argument("--processes", type=int, default=2)
    given = ask.parse_args()
    kept = _kept(given.file)
    wanted = [place for place, one in enumerate(all_series()) if given.all or not one.tier or one.name in kept]
    places = [place for place in wanted if all_series()[place].name not in kept]
    places.sort(key=lambda place: TIERS.index(all_series()[place].tier))  # what is quick comes first
    tasks = [(place, seed) for place in places for seed in range(given.seeds if all_series()[place].seeded else 1)]
    with _pool(1, OTHER_PROCESSOR) as other, _pool(given.processes, {}) as usual:
        others = other.imap(_timed, [(place, 0) for place in places])
        for place, some in groupby(usual.imap(_timed, tasks, chunksize=2), lambda one: one[0][0]):
            line = line_of(all_series()[place], [end for _, end in some], next(others)[1])
            kept[line["case"]] = line
            _write(given.file, [kept[one.name] for one in all_series() if one.name in kept])
    weak = {name: said for name, line in kept.items() if (said := what_is_weak(line))}
    for name, said in weak.items():
        print(f"{name}: {said}")
    print(f"{len(kept)} cases, {len(weak)} weak or wrong")
    return int(bool(weak))


def _kept(file: Path) -> dict[str, dict[str, str]]:
    """The lines of a table that was begun, by case, of cases that there still are."""
    if not file.exists():
        return {}
    with file.open(newline="", encoding="utf-8") as lines:
        names = {one.name for one in all_series()}
        return {line["case"]: line for line in csv.DictReader(lines) if line["case"] in names}


def _write(file: Path, lines: Iterable[dict[str, str]]) -> None:
    with file.open("w", newline="", encoding="utf-8") as open_file:
        table = csv.DictWriter(open_file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(lines)


def what_is_weak(line: dict[str, str]) -> str:
    """What a line of the table must not have; empty where there is nothing."""
    said = [
        f"{line['ended']}: {line['wrong']}" if line["wrong"] else "",
        f"a margin of {line['margin']} spreads" if _is_close(line) else "",
        f"on another processor {line['other_processor']}" if line["other_processor"] != "the same" else "",
    ]
    return "; ".join(filter(None, said))


def _is_close(line: dict[str, str]) -> bool:
    """Whether the margin is weak; a chaotic case has none, whose seeds differ as they should."""
    return bool(line["margin"]) and float(line["margin"]) < WEAK and not line["declared"].startswith(RESTS)


if __name__ == "__main__":
    sys.exit(main())
