"""What every test shares: which tests run here, and where the figures that they measure go."""

import contextlib
import functools
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any, Protocol

import pytest
from hypothesis import settings

from schemas.environment import settings_to_change
from services.run.machine import usable_cores
from services.run.worker_entry import processor_flags
from tests.kit.skips import Skips

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"

# The same examples on every run: a failure is a change of the code, not of the dice. No deadline on shared cores.
settings.register_profile("verso", deadline=None, derandomize=True)
settings.load_profile("verso")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("verso")
    group.addoption("--scope", choices=("default", "ci", "all"), default="default", help="see `./verso test --help`")
    group.addoption("--figures", type=Path, metavar="FILE", help="write what the tests measured, as a JSON list")


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput"):  # of several processes, the first one writes
        return
    config.pluginmanager.register(Skips(config.getoption("--scope") != "default"))
    if figures_file := config.getoption("--figures"):
        config.pluginmanager.register(FiguresWriter(figures_file))


def pytest_report_header() -> list[str]:
    changes = settings_to_change(os.environ, processor_flags())
    return [f"environment: not the stack's, bits may differ: {' '.join(sorted(changes))}"] if changes else []


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A test process holds a GL context, a PyBullet world and a Ray: about 1 GB. More than 8 processes gain nothing.

    One file stays in one process: its tests share what is slow to start, such as a Ray.
    """
    one_file = len(config.args) == 1 and Path(config.args[0].split("::")[0]).is_file()
    processes = min(usable_cores(), 8)
    return 0 if one_file or processes == 1 else processes


# ---------------------------------------------------------------------------------------------- which tests run here


@functools.cache
def docker_answers() -> bool:
    try:
        return (
            shutil.which("docker") is not None
            and not subprocess.run(["docker", "info"], capture_output=True, timeout=20, check=False).returncode
        )
    except subprocess.TimeoutExpired:
        return False


NEEDS = {
    "docker": (
        *("deploy/Dockerfile", "deploy/compile_loops.py", "deploy/entrypoint", "deploy/stack_environment.py"),
        *(".dockerignore", "docker-compose.yml", "requirements.lock", "requirements-study.lock"),
        *("requirements-reading.lock", "tests/deploy/test_image.py", "tests/kit/containers.py"),
    ),
    "browser": ("services/look", "tests/services/look"),
}
"""What tests with these markers are about: --ci runs them where some of it differs from the base."""


DAY_AGO = ("rev-list", "-1", "--before=1 day ago", "HEAD")


@functools.cache
def changed(*places: str) -> bool:
    """Whether files differ from the commit where this branch left the main one; on that, from a day ago, as it is tested daily.

    True where git cannot tell.
    """

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    for ask in (*(("merge-base", base, "HEAD") for base in ("origin/HEAD", "origin/main", "main")), DAY_AGO):
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            before = git(*ask)
            if before not in ("", git("rev-parse", "HEAD")):
                return bool(git("diff", "--name-only", before, "--", *places))
    return True


def why_skip(markers: set[str], scope: str) -> str:
    """The first reason why a test with these markers cannot or should not run; empty if it runs."""
    if "slow" in markers and scope != "all":
        return "slow: runs with --all"
    if markers & {"docker", "root"} and scope == "default":
        return "needs root or Docker: runs with --ci"
    if "minute" in markers and scope == "default":
        return "takes about a minute: runs with --ci"
    if scope == "ci" and any(not changed(*places) for marker, places in NEEDS.items() if marker in markers):
        return "what it needs has not changed: runs with --all"
    if "docker" in markers and not docker_answers():
        return "no Docker engine answers"
    if "root" in markers and os.geteuid() != 0:
        return "this user is not root"
    if "shared_data" in markers and not SHARED_DATA.is_dir():
        return "no ../shared/data beside the checkout"
    return ""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if reason := why_skip({marker.name for marker in item.iter_markers()}, config.getoption("--scope")):
            item.add_marker(pytest.mark.skip(reason=reason))
    items.sort(key=_place_of)


LONGEST_FIRST = (
    "services/study/test_command.py",
    "services/run/test_run_job.py",
    "services/run/test_whole_scenes.py",
    "effects/test_random_scenes.py",
    "effects/test_physics_effects.py",
    "services/bench/test_rounds.py",
    "kit/test_energy_minimum.py",
)
"""Files of a minute or so: a process that begins one last works on alone."""


def _place_of(item: pytest.Item) -> int:
    """Sorts the tests of long files before all others, and leaves every other order as it is."""
    path = item.path.as_posix()
    return next(
        (place for place, name in enumerate(LONGEST_FIRST) if path.endswith(f"tests/{name}")), len(LONGEST_FIRST)
    )


# ---------------------------------------------------------------------------------------------- figures


class RecordFigure(Protocol):
    def __call__(self, name: str, outcome: str, figure: float | None = None, bound: float | None = None) -> None: ...


@pytest.fixture
def record_figure(request: pytest.FixtureRequest) -> RecordFigure:
    """`record_figure(name, outcome, figure, bound)`: what a case came to, for `./verso test --figures FILE`."""
    figures: list[dict[str, Any]] = []
    request.node.user_properties.append(("figures", figures))

    def record(name: str, outcome: str, figure: float | None = None, bound: float | None = None) -> None:
        # Plain floats, because numpy's do not travel between test processes.
        plain = [None if number is None else float(number) for number in (figure, bound)]
        figures.append({"name": name, "outcome": outcome, "figure": plain[0], "bound": plain[1]})

    return record


class FiguresWriter:
    """Collects the figures from all test processes and writes them in one piece when the run ends."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.rows: list[dict[str, Any]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or (report.when == "setup" and not report.passed):
            for name, figures in report.user_properties:
                if name == "figures":
                    self.rows += self._of_test(report, figures)

    @staticmethod
    def _of_test(report: pytest.TestReport, figures: Any) -> list[dict[str, Any]]:
        """A case that failed says so, whatever it had recorded; one that recorded nothing is still in the list."""
        if not figures:
            test = report.nodeid.rpartition("::")[2]
            return [{"name": test, "outcome": report.outcome, "figure": None, "bound": None}]
        return [{**row, "outcome": "failed"} if report.failed else row for row in figures]

    def pytest_sessionfinish(self) -> None:
        self.rows.sort(key=lambda row: row["name"])
        self.file.write_text(json.dumps(self.rows, indent=1) + "\n")
