"""Figures of a benchmark: the machine, pinning to one core, laps of a side, and what follows from their times."""

import contextlib
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

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
        "threads_per_core": threads_per_core(),
        "cpu": next((line.partition(":")[2].strip() for line in cpuinfo if line.startswith("model name")), "unknown"),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1),
        "gl_renderer": renderer,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
        "load_1min": os.getloadavg()[0],
        "versions": {name: version(name) for name in LIBRARIES},
    }


def threads_per_core(topology: Path = Path("/sys/devices/system/cpu/cpu0/topology/thread_siblings_list")) -> int | None:
    """Logical cores per physical core, None where unknown. Two of one physical core gain less than 2 times."""
    try:
        parts = [part.split("-") for part in topology.read_text().strip().split(",")]
    except OSError:
        return None
    return sum(int(part[-1]) - int(part[0]) + 1 for part in parts)


def process_age_s() -> float:
    """Seconds since this process started, to a hundredth."""
    began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - began


@dataclass(frozen=True)
class Spread:
    """A figure over rounds: its median, minimum and maximum."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, figures: Sequence[float]) -> "Spread":
        """The spread of at least one figure. Raises ValueError for none."""
        if not figures:
            raise ValueError("a spread of no figures")
        return cls(median(figures), min(figures), max(figures))


def format_spread(spread: Mapping[str, float], form: str = ".2f", unit: str = "") -> str:
    """The fields of a `Spread` as text: the median, and in brackets the minimum and the maximum."""
    return f"{spread['median']:{form}}{unit} [{spread['least']:{form}} to {spread['most']:{form}}]"


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


def with_loading(lap: Lap) -> float:
    """Seconds for one scene more, including the work outside the clock."""
    return (lap.wall_s + lap.apart_s) / lap.scenes


def slope_ratio(slow: Sequence[Lap], fast: Sequence[Lap], slope: Callable[[Lap], float] = by_clock) -> Spread:
    """How many times as many scenes `fast` makes in the same time, over pairs of laps of the same round."""
    return Spread.of([slope(a) / slope(b) for a, b in zip(slow, fast, strict=True)])


def stage_table(laps: Sequence[Lap], middle: Callable[[list[float]], float] = median) -> dict[str, float]:
    """Milliseconds per scene by stage, the median over laps; `rest` is the remainder.

    With `middle=mean` a stage of few scenes, such as casting rays, shows its cost spread over all scenes.
    """
    names = list(dict.fromkeys(name for lap in laps for name in lap.stages_s))
    table = {name: middle([lap.stages_s.get(name, 0.0) / lap.scenes * 1e3 for lap in laps]) for name in names}
    table["rest"] = middle([(lap.wall_s - sum(lap.stages_s.values())) / lap.scenes * 1e3 for lap in laps])
    return table


def describe_head(figures: Mapping[str, Any]) -> list[str]:
    """Processor, load and command: the first lines of the shorter reports."""
    machine = figures["machine"]
    return [f"machine    {machine['cpu']}, load {machine['load_1min']:.1f}", f"command    {figures['command']}"]
