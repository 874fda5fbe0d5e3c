"""A pytest plugin: tells why tests were skipped, and fails a run for --ci or --all whose skip nobody expected."""

from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest

EXPECTED = Path(__file__).resolve().parents[1] / "expected_skips.txt"


class Skips:
    """The reasons of skips and of known failures, from all test processes. For the process that the others report to."""

    def __init__(self, must_be_expected: bool, expected: Path = EXPECTED) -> None:
        self._must_be_expected = must_be_expected
        self._expected = [line for line in expected.read_text().splitlines() if line and not line.startswith("#")]
        self._skips: dict[str, str] = {}
        """Reasons by test, or by file where all of it was skipped: every process tells of that."""
        self._known: dict[str, str] = {}

    def unexpected(self) -> Counter[str]:
        """Reasons that no line of the list matches, with the number of their tests."""
        counts = Counter(self._skips.values())
        return Counter(
            {why: n for why, n in counts.items() if not any(fnmatchcase(why, line) for line in self._expected)}
        )

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.skipped and hasattr(report, "wasxfail"):
            self._known[report.nodeid] = report.wasxfail
        elif report.skipped:
            self._skips[report.nodeid] = _reason(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.skipped:
            self._skips[report.nodeid] = _reason(report)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self._must_be_expected and session.exitstatus == pytest.ExitCode.OK and self.unexpected():
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        strange = f"skipped although {EXPECTED.name} does not expect it", self.unexpected()
        told = (("skipped", self._skips), ("known failures", self._known))
        for title, counts in [*((title, Counter(reasons.values())) for title, reasons in told), strange]:
            if counts:
                terminalreporter.write_line(f"{title}, and why:")
            for reason, number in counts.most_common():
                terminalreporter.write_line(f"  {number:>4} x {reason}")


def _reason(report: pytest.TestReport | pytest.CollectReport) -> str:
    place = report.longrepr
    return str(place[2] if isinstance(place, tuple) else place).removeprefix("Skipped: ")
