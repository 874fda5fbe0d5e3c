"""`verso test`: runs lint, types, layer rules and tests, and lists what was skipped and why."""

import argparse
import contextlib
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

from services.cli.skips import Machine, Skip, read_expected, stale, unexpected
from services.run.machine import usable_cores

ROOT: Final = Path(__file__).resolve().parents[2]

EXPECTED_SKIPS: Final = "tests/expected_skips.txt"

CORE_SECONDS: Final = {"default": 800, "ci": 2200, "all": 14400}
"""What a whole run takes by scope, in seconds of one core: estimates, from a run on two cores. Said
before the first run on a machine; later ones say how long the last one took."""

LAST_RUN: Final = Path(sys.prefix, "verso-test-seconds.json")
"""Seconds of the last whole run by scope and number of processes."""


@dataclass(frozen=True)
class Check:
    """The result of one tool: its name, whether it passed, its time, and a remark for the summary."""

    name: str
    passed: bool
    seconds: float
    remark: str = ""


@dataclass(frozen=True)
class Tally:
    """Numbers of tests by outcome, every test that was skipped, with its reason, and the reasons of known failures."""

    passed: int
    failed: int
    skips: tuple[Skip, ...] = ()
    known: tuple[str, ...] = ()

    @classmethod
    def read(cls, junit: Path) -> "Tally":
        """Counts from a JUnit file; zeros where pytest died before it wrote one."""
        try:
            cases = list(ElementTree.parse(junit).iter("testcase"))
        except (OSError, ElementTree.ParseError):
            return cls(0, 0)
        failed = sum(case.find("failure") is not None or case.find("error") is not None for case in cases)
        left = [(case, skip) for case in cases if (skip := case.find("skipped")) is not None]
        known = tuple(skip.get("message", "") for _, skip in left if skip.get("type") == "pytest.xfail")
        skips = tuple(
            (_node_of(case), skip.get("message", "")) for case, skip in left if skip.get("type") != "pytest.xfail"
        )
        return cls(len(cases) - failed - len(left), failed, skips, known)


def _node_of(case: ElementTree.Element) -> str:
    """`tests/test_a.py::test_b`."""
    return f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name', '')}"


def main(args: list[str]) -> int:
    """Run `verso test ARGS`; returns 0 if all passed, 1 if not, 2 if it cannot be run as asked."""
    asked = _parser().parse_args(args)
    if reason := _missing_tools() or _missing_paths(asked.paths):
        print(f"verso test: {reason}", file=sys.stderr)
        return 2
    whole, began = not (asked.paths or asked.matching), time.monotonic()
    if whole:
        print(f"verso test: {expected_duration(asked.scope, _processes())}", flush=True)
    checks = [] if asked.paths else [_run_check(name, command) for name, command in _static_checks().items()]
    with tempfile.TemporaryDirectory(prefix="verso-test-") as folder:
        junit = Path(folder, "junit.xml")
        started = time.monotonic()
        status = _call(_pytest_command(asked, junit))
        tally = Tally.read(junit)
    remark = f"{tally.passed} passed, {tally.failed} failed, {len(tally.skips)} skipped"
    if status == 5:  # pytest's own code
        remark = "no test was found"
    checks.append(Check("pytest", status == 0, time.monotonic() - started, remark))
    notes: list[str] = []
    if whole and status in (0, 1):
        skips, notes = check_skips(tally.skips, asked.scope)
        checks += [skips] if asked.scope != "default" else []
        _keep_duration(asked.scope, time.monotonic() - began)
    print(_summary(checks, tally, notes), flush=True)
    return 0 if all(check.passed for check in checks) else 1


def check_skips(skips: Sequence[Skip], scope: str) -> tuple[Check, list[str]]:
    """Whether every skip is expected on this machine; a line for each that is not, and for each stale expectation."""
    expected = read_expected((ROOT / EXPECTED_SKIPS).read_text())
    machine = Machine(scope, ROOT)
    strange = unexpected(skips, expected, machine)
    told = [f"  not expected, {number} x {test}: {reason}" for (test, reason), number in sorted(strange.items())]
    unused = stale(skips, expected, machine)
    told += [f"  expected and not skipped: {line.condition} | {line.tests} | {line.reason}" for line in unused]
    remark = f"{strange.total()} not in {EXPECTED_SKIPS}, {len(unused)} of its lines without use here"
    return Check("skips", not strange, 0.0, remark), told


def expected_duration(scope: str, processes: int) -> str:
    """How long a whole run takes, in words: as the last one here, or by an estimate."""
    last = _last_runs().get(f"{scope} {processes}")
    seconds = last or CORE_SECONDS[scope] / processes
    source = "as the last time" if last else "an estimate"
    cores = f"{processes} core{'s' * (processes > 1)}"
    return f"about {max(1, round(seconds / 60))} minutes on {cores}, {source}"


def _last_runs() -> dict[str, float]:
    try:
        runs = json.loads(LAST_RUN.read_text())
        return {name: float(seconds) for name, seconds in runs.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}


def _keep_duration(scope: str, seconds: float) -> None:
    with contextlib.suppress(OSError):  # the figure is a service, and no result
        LAST_RUN.write_text(json.dumps(_last_runs() | {f"{scope} {_processes()}": round(seconds, 1)}) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="verso test",
        description="Lint, types, layer rules and tests. Says at the end what was skipped and why.",
        epilog="example: verso test tests/hard_cases --figures figures.json",
    )
    parser.add_argument("paths", nargs="*", metavar="PATH", help="only the tests in this file, folder or FILE::TEST")
    scope = parser.add_mutually_exclusive_group()
    scope.add_argument("--ci", dest="scope", action="store_const", const="ci", help="also what needs root or Docker")
    scope.add_argument(
        "--all", dest="scope", action="store_const", const="all", help="also that, and what takes minutes"
    )
    parser.add_argument("--figures", type=Path, metavar="FILE", help="write what the tests measured there, as JSON")
    parser.add_argument("-k", dest="matching", metavar="EXPR", help="only tests whose name matches, as in pytest")
    parser.set_defaults(scope="default")
    return parser


def _missing_tools() -> str:
    if not (ROOT / "tests").is_dir():
        return "the tests are not part of the installed package; run ./verso test in a checkout"
    if importlib.util.find_spec("pytest") is None:
        return "the test tools are not installed here; ./verso test in a checkout installs them"
    return ""


def _missing_paths(paths: Sequence[str]) -> str:
    gone = [path for path in paths if not Path(path.split("::")[0]).exists()]
    return f"no such file or folder: {', '.join(gone)}" if gone else ""


def _static_checks() -> dict[str, list[str]]:
    return {
        "ruff check": [sys.executable, "-m", "ruff", "check", "."],
        "ruff format": [sys.executable, "-m", "ruff", "format", "--check", "."],
        "mypy": [sys.executable, "-m", "mypy"],
        "layers": [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"],
    }


def _pytest_command(asked: argparse.Namespace, junit: Path) -> list[str]:
    command = [sys.executable, "-m", "pytest", f"--scope={asked.scope}", f"--junitxml={junit}"]
    # One file stays in one process: its tests share what is slow to start, such as a Ray.
    one_file = len(asked.paths) == 1 and Path(asked.paths[0].split("::")[0]).is_file()
    processes = _processes()
    if processes > 1 and not one_file:
        # Files go out in the order of tests/conftest.py, the longest first, and not by their number of tests.
        command += [f"--numprocesses={processes}", "--dist=loadfile", "--no-loadscope-reorder"]
    if asked.figures:
        command.append(f"--figures={asked.figures.absolute()}")
    if asked.matching:
        command += ["-k", asked.matching]
    return command + [os.path.abspath(path) for path in asked.paths]


def _processes() -> int:
    """A test process holds a GL context, a PyBullet world and a Ray: about 1 GB. More than 8 processes gain nothing."""
    return min(usable_cores(), 8)


def _run_check(name: str, command: list[str]) -> Check:
    started = time.monotonic()
    print(f"== {name}", flush=True)
    return Check(name, _call(command) == 0, time.monotonic() - started)


def _call(command: list[str]) -> int:
    # The checkout comes first on the path, also of the processes that the tests start.
    return subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False).returncode


def _summary(checks: Sequence[Check], tally: Tally, notes: Sequence[str]) -> str:
    lines = ["", "verso test:"]
    for check in checks:
        verdict = "ok" if check.passed else "FAILED"
        lines.append(f"  {check.name:<12} {verdict:<7} {check.seconds:6.1f} s  {check.remark}".rstrip())
    for title, reasons in (
        ("skipped, and why:", [reason for _, reason in tally.skips]),
        ("known failures, and why:", list(tally.known)),
    ):
        counted = [f"  {number:>4} x {reason}" for reason, number in Counter(reasons).most_common()]
        lines += [title, *counted] if counted else []
    if notes:
        lines += [f"compared with {EXPECTED_SKIPS}:", *notes]
    return "\n".join(lines)
