"""Every way in which a supervised command can end has its line and its exit code."""

import signal

import pytest

from services.run.supervisor import Facts, judge

KEPT = "all is kept"
WITHOUT_A_WORD = 7 << 8


@pytest.mark.parametrize("code", [0, 1, 2])
def test_a_command_that_told_its_code_needs_no_line_however_its_process_ended(code):
    for status in (code << 8, signal.SIGABRT, signal.SIGKILL):
        assert judge(Facts(code=code), status, None, KEPT) == (code, None)
        assert judge(Facts(code=code), status, signal.SIGTERM, KEPT) == (code, None)


@pytest.mark.parametrize(
    ("stopped_by", "words"),
    [
        (signal.SIGINT, "interrupted; all is kept"),
        (signal.SIGTERM, "stopped by SIGTERM; all is kept"),
        (signal.SIGHUP, "stopped by SIGHUP; all is kept"),
    ],
)
def test_a_signal_is_named_whether_the_command_ended_in_order_or_crashed(stopped_by, words):
    for status in (1 << 8, signal.SIGABRT, signal.SIGKILL):
        assert judge(Facts(), status, stopped_by, KEPT) == (1, words)
        assert judge(Facts(code=1, ended_by=signal.SIGINT), status, stopped_by, KEPT) == (1, words)


def test_a_signal_that_reached_the_command_alone_is_named_too():
    assert judge(Facts(code=1, ended_by=signal.SIGTERM), 1 << 8, None, KEPT) == (1, "stopped by SIGTERM; all is kept")
    assert judge(Facts(), signal.SIGTERM, None, KEPT) == (1, "stopped by SIGTERM; all is kept")
    assert judge(Facts(), signal.SIGINT, None, KEPT) == (1, "interrupted; all is kept")


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (signal.SIGKILL, "killed (SIGKILL), which Linux also does where memory runs out"),
        (signal.SIGABRT, "crashed (SIGABRT)"),
        (signal.SIGSEGV, "crashed (SIGSEGV)"),
        (signal.SIGRTMIN + 1, f"crashed (signal {signal.SIGRTMIN + 1})"),
        (WITHOUT_A_WORD, "ended without a word (exit code 7)"),
        (0, "ended without a word (exit code 0)"),
    ],
)
def test_a_death_is_told_with_what_is_kept_and_never_as_success(status, words):
    code, line = judge(Facts(), status, None, KEPT)
    assert code == 1
    assert line is not None
    assert words in line
    assert line.endswith("; all is kept")
