"""The list of expected skips: what it allows, under which condition, and which of its lines are of no use."""

from collections import Counter
from pathlib import Path

import pytest

from services.cli.skips import CONDITIONS, Expected, Machine, read_expected, stale, unexpected
from tests.conftest import why_skip

ROOT = Path(__file__).resolve().parents[3]
HERE = Machine("default", ROOT)


def test_the_list_of_this_project_can_be_read_and_allows_what_the_markers_skip():
    expected = read_expected((ROOT / "tests" / "expected_skips.txt").read_text())
    for scope in ("default", "ci", "all"):
        reasons = [why_skip({marker}, scope) for marker in ("slow", "minute", "docker", "root")]
        skips = [("tests/deploy/test_image.py::test_a", reason) for reason in reasons if reason]
        assert not unexpected(skips, expected, Machine(scope, ROOT))


@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_can_be_asked(condition):
    assert CONDITIONS[condition](HERE) in (True, False)


def test_a_line_allows_its_tests_for_its_reason_while_its_condition_holds():
    line = Expected("not --all", "tests/test_a.py::*", "slow: *")
    assert not unexpected([("tests/test_a.py::test_b[1]", "slow: minutes")], [line], HERE)
    for skip in (("tests/test_b.py::test_b", "slow: minutes"), ("tests/test_a.py::test_b", "the moon is full")):
        assert unexpected([skip, skip], [line], HERE) == Counter({skip: 2})
    assert unexpected([("tests/test_a.py::test_b", "slow: minutes")], [line], Machine("all", ROOT)).total() == 1


def test_a_line_that_nothing_was_skipped_by_is_stale_where_its_condition_holds():
    lines = [Expected(condition, "tests/test_a.py::*", "slow") for condition in ("not --all", "sometimes")]
    assert stale([], lines, HERE) == lines[:1]
    assert stale([("tests/test_a.py::test_b", "slow")], lines, HERE) == []
    assert stale([], lines, Machine("all", ROOT)) == []


@pytest.mark.parametrize("line", ["always", "always | tests/a.py::*", "on mondays | * | it rains"])
def test_a_line_that_is_none_is_told(line):
    with pytest.raises(ValueError, match=r"is not `condition \| tests \| reason`"):
        read_expected(f"# a comment\n\n{line}\n")
