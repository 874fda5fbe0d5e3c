"""Figures of a benchmark: the machine, pinning to one core, laps of a side, and what follows from their times."""

import contextlib
import os
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import fmean, median

LIBRARIES = ("numpy", "opencv-contrib-python-headless", "pybullet", "pyrender", "pyarrow", "trimesh", "PyOpenGL", "ray")


@contextlib.contextmanager
def pinned() -> Iterator[int]:
    """Pins this thread, and the processes that it starts, to the last core that it may use."""
    before = os.sched_getaffinity(0)
    chosen = max(before)
    os.sched_setaffinity(0, {chosen})
    try:
        yield chosen
    finally:
        os.sched_setaffinity(0, before)


def describe_machine(renderer: str) -> dict[str, object]:
    """Cores, processor, OpenGL device, load and versions: the context of every figure."""
    cpuinfo = Path("/proc/cpuinfo").read_text().splitlines()
    return {
        "cores": os.cpu_count(),
        "usable_cores": len(os.sched_getaffinity(0)),
        "cpu": next((line.partition(":")[2].strip() for line in cpuinfo if line.startswith("model name")), "unknown"),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1),
        "gl_renderer": renderer,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
        "load_1min": os.getloadavg()[0],
        "versions": {name: version(name) for name in LIBRARIES},
    }


@dataclass(frozen=True)
class Lap:
    """One side's part of a round: its scenes, its time, and the time of each stage.

    wall_s is by the clock; cpu_s is of the processor, without waiting for the disk and less disturbed by other processes;
    apart_s is by the clock for work outside wall_s, such as the script's loading of meshes.
    """

    scenes: int
    wall_s: float
    cpu_s: float
    stages_s: Mapping[str, float]
    apart_s: float = 0.0


def by_clock(lap: Lap) -> float:
    """Seconds for one scene more, without start-up."""
    return lap.wall_s / lap.scenes


def by_processor(lap: Lap) -> float:
    """Seconds of processor for one scene more."""
    return lap.cpu_s / lap.scenes


def spread_of(figures: Sequence[float]) -> dict[str, float]:
    """The median, minimum and maximum of a figure over rounds, of which there is at least one."""
    return {"median": median(figures), "least": min(figures), "most": max(figures)}


def slope_ratio(slow: Sequence[Lap], fast: Sequence[Lap], slope: Callable[[Lap], float] = by_clock) -> dict[str, float]:
    """How many times as many scenes `fast` makes in the same time, over pairs of laps of the same round."""
    return spread_of([slope(a) / slope(b) for a, b in zip(slow, fast, strict=True)])


def summarise_side(laps: Sequence[Lap]) -> dict[str, float | dict[str, float]]:
    """Milliseconds a scene: medians over laps; and means, in which a stage of few scenes, such as casting rays, is seen.

    The stage `rest` is what no stage accounts for.
    """
    names = dict.fromkeys(name for lap in laps for name in lap.stages_s)
    stages = {name: [lap.stages_s.get(name, 0.0) / lap.scenes * 1e3 for lap in laps] for name in names}
    stages["rest"] = [(lap.wall_s - sum(lap.stages_s.values())) / lap.scenes * 1e3 for lap in laps]
    return {
        "ms_per_scene": median(map(by_clock, laps)) * 1e3,
        "cpu_ms_per_scene": median(map(by_processor, laps)) * 1e3,
        "apart_ms": median(lap.apart_s / lap.scenes for lap in laps) * 1e3,
        "stages_ms": {name: median(each) for name, each in stages.items()},
        "stages_mean_ms": {name: fmean(each) for name, each in stages.items()},
    }
