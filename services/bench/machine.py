"""The machine of a benchmark: its description, and pinning to one core."""

import contextlib
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path

from services.bench.others import installed

LIBRARIES = ("numpy", "opencv-contrib-python-headless", "pybullet", "pyrender", "pyarrow", "trimesh", "PyOpenGL", "ray")


@contextlib.contextmanager
def pinned(core: int | None = None) -> Iterator[int]:
    """Pins this thread, and the processes that it starts, to one core: by default the last that it may use."""
    before = os.sched_getaffinity(0)
    chosen = max(before) if core is None else core
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
        "versions": {name: found for name in LIBRARIES if (found := installed(name)) is not None},
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
