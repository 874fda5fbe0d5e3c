"""The memory that a process took, for tests that it stays flat."""

from pathlib import Path


def peak_mib() -> float:
    """Most memory that this program has held. (`ru_maxrss` would be that of the process that started it, if larger.)"""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024
