"""The number of cores that this process may use: a container's share of the machine."""

import math
import os
from pathlib import Path


def usable_cores(proc: Path = Path("/proc/self/cgroup"), cgroups: Path = Path("/sys/fs/cgroup")) -> int:
    """The smaller of the cores it may be scheduled on and its control groups' quota, at least 1.

    A quota is rounded up: one worker would waste half a core of 1.5, two share them.
    """
    cores = len(os.sched_getaffinity(0))
    quota = min((_quota(folder) for folder in _control_groups(proc, cgroups)), default=math.inf)
    return math.ceil(quota) if quota < cores else cores


def _control_groups(proc: Path, cgroups: Path) -> list[Path]:
    """The folders whose limits apply to this process: its own group and all above it, in either version's layout."""
    try:
        lines = proc.read_text().splitlines()
    except OSError:
        return []
    folders: list[Path] = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        top = cgroups / "cpu" if controllers else cgroups
        own = top / path.lstrip("/")
        # Inside a container the path may be the host's, of which only the top is mounted here.
        folders += [own, *(above for above in own.parents if above.is_relative_to(top))]
    return folders


def _quota(folder: Path) -> float:
    """Cores that one control group grants, by version 2's `cpu.max` or version 1's pair of files; inf where unlimited."""
    try:
        if (both := folder / "cpu.max").exists():
            granted, period = both.read_text().split()
        else:
            granted, period = ((folder / f"cpu.cfs_{part}_us").read_text().strip() for part in ("quota", "period"))
    except OSError:
        return math.inf
    return math.inf if granted in ("max", "-1") else int(granted) / int(period)
