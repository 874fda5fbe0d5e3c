"""Which tests may be skipped, and when: the list of tests/expected_skips.txt, compared with what a run skipped."""

import importlib.util
import os
import platform
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

Skip = tuple[str, str]
"""(test as FILE::NAME, reason)."""

SOMETIMES: Final = "sometimes"
"""The condition of a skip that nothing but the test itself can foresee."""


@dataclass(frozen=True)
class Machine:
    """What the conditions ask about: the scope of the run, and the checkout whose neighbours are looked at."""

    scope: str
    root: Path


def _fails(*command: str) -> bool:
    try:
        return subprocess.run(command, capture_output=True, timeout=20, check=False).returncode != 0
    except (OSError, subprocess.TimeoutExpired):
        return True


def _no_loop(tool: str) -> bool:
    return os.geteuid() != 0 or shutil.which(tool) is None or _fails("losetup", "-f")


def no_huge_pages() -> bool:
    """Whether glibc is too old to ask for huge pages, or the kernel gives them to nobody, or to all."""
    library, number = platform.libc_ver()
    too_old = library != "glibc" or tuple(map(int, number.split("."))) < (2, 35)
    setting = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    return too_old or not setting.exists() or "[madvise]" not in setting.read_text()


CONDITIONS: Final[dict[str, Callable[[Machine], bool]]] = {
    "always": lambda machine: True,
    SOMETIMES: lambda machine: True,
    "not --all": lambda machine: machine.scope != "all",
    "neither --ci nor --all": lambda machine: machine.scope == "default",
    "not root": lambda machine: os.geteuid() != 0,
    "no Docker": lambda machine: _fails("docker", "info"),
    "no vfat": lambda machine: _no_loop("mkfs.vfat"),
    "no ext4": lambda machine: _no_loop("mkfs.ext4"),
    "no tmpfs": lambda machine: _fails("unshare", "--mount", "mount", "-t", "tmpfs", "none", "/mnt"),
    "no network namespaces": lambda machine: _fails("unshare", "--net", "true"),
    "no hosts tool": lambda machine: not (machine.root.parent / "shared" / "tools" / "hosts").exists(),
    "no shared data": lambda machine: not (machine.root.parent / "shared" / "data").is_dir(),
    "no mitsuba": lambda machine: importlib.util.find_spec("mitsuba") is None,
    "no chromium": lambda machine: shutil.which("chromium") is None,
    "no mujoco": lambda machine: importlib.util.find_spec("mujoco") is None,
    "no torch": lambda machine: importlib.util.find_spec("torch") is None,
    "no webdataset": lambda machine: importlib.util.find_spec("webdataset") is None,
    "no datasets": lambda machine: importlib.util.find_spec("datasets") is None,
    "one core": lambda machine: len(os.sched_getaffinity(0)) < 2,
    "no huge pages": lambda machine: no_huge_pages(),
    "no glibc": lambda machine: platform.libc_ver()[0] != "glibc",
}
"""Whether a condition holds on this machine, asked of the machine and never of the tests."""


@dataclass(frozen=True)
class Expected:
    """A line of the list: under `condition`, tests that `tests` matches may be skipped for a reason that `reason` matches."""

    condition: str
    tests: str
    reason: str

    def covers(self, skip: Skip) -> bool:
        """Whether the line is about this skip."""
        return fnmatchcase(skip[0], self.tests) and fnmatchcase(skip[1], self.reason)


def read_expected(text: str) -> list[Expected]:
    """The lines of a list, `condition | tests | reason` each. Raises ValueError naming a line that is none."""
    lines = []
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            parts = [part.strip() for part in line.split(" | ", 2)]
            if len(parts) != 3 or parts[0] not in CONDITIONS:
                raise ValueError(f"{line!r} is not `condition | tests | reason` with one of: {', '.join(CONDITIONS)}")
            lines.append(Expected(*parts))
    return lines


def unexpected(skips: Iterable[Skip], expected: Sequence[Expected], machine: Machine) -> Counter[Skip]:
    """Skips that no line allows here, with their numbers."""
    allowed = [line for line in expected if CONDITIONS[line.condition](machine)]
    return Counter(skip for skip in skips if not any(line.covers(skip) for line in allowed))


def stale(skips: Sequence[Skip], expected: Sequence[Expected], machine: Machine) -> list[Expected]:
    """Lines whose condition holds here although nothing was skipped by them: the tests are gone, or need it no more."""
    unused = [line for line in expected if not any(line.covers(skip) for skip in skips)]
    return [line for line in unused if line.condition != SOMETIMES and CONDITIONS[line.condition](machine)]
