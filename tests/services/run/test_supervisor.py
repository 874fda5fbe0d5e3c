"""Every way in which a supervised command can end has its line and its exit code."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from services.run.machine import descendants
from services.run.supervisor import LAST_WORDS, Facts, judge
from tests.kit.killed_runs import chain_of

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


ROOT = Path(__file__).resolve().parents[3]

START = """
import os, signal, subprocess, sys, time
from services.run.supervisor import supervise, tell
def command():
    {body}
sys.exit(supervise(command, "all is kept"))
"""

FOREVER = "subprocess.Popen(['sleep', '600'], start_new_session=True); print('ready', flush=True); time.sleep(600)"


def start(body: str) -> subprocess.Popen[str]:
    return spawn(START.format(body=body))


def spawn(code: str, *arguments: str) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code, *arguments], cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def kill_each(pids: list[int], numbers: tuple[int, ...]) -> None:
    """SIGKILL to those of the numbers; one may have ended already, because another was killed."""
    for number in numbers:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pids[number], signal.SIGKILL)


def end(run: subprocess.Popen[str]) -> tuple[int, str, str]:
    told, wrong = run.communicate(timeout=60)
    return run.returncode, told, wrong


@pytest.mark.parametrize("code", [0, 1, 2])
def test_what_a_command_says_and_its_exit_code_arrive_unchanged(code):
    body = f"print('answer'); print('verso: why', file=sys.stderr); return {code}"
    assert end(start(body)) == (code, "answer\n", "verso: why\n")


def test_a_bug_in_the_command_itself_shows_its_traceback():
    code, _, wrong = end(start("raise ZeroDivisionError"))
    assert code == 1
    assert "ZeroDivisionError" in wrong
    assert "verso:" not in wrong


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("os.abort()", "crashed (SIGABRT) in Ray or in another library"),
        ("os.kill(os.getpid(), 9)", "was killed (SIGKILL), which Linux also does where memory runs out"),
        ("os._exit(7)", "ended without a word (exit code 7), as it does where Ray is lost"),
    ],
)
def test_a_command_that_dies_is_told_in_one_line(body, words):
    assert end(start(f"print('x', flush=True); {body}")) == (1, "x\n", f"verso: the run {words}; all is kept\n")


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGINT, "verso: interrupted; all is kept\n"),
        (signal.SIGTERM, "verso: stopped by SIGTERM; all is kept\n"),
        (signal.SIGHUP, "verso: stopped by SIGHUP; all is kept\n"),
    ],
)
def test_a_signal_ends_the_command_and_all_that_it_started(number, words):
    run = start(FOREVER)
    assert run.stdout is not None
    run.stdout.readline()
    below = descendants(run.pid)
    assert len(below) == 4  # the keeper, the command, the last process, and what the command started
    run.send_signal(number)
    assert end(run) == (1, "", words)
    assert not any(Path(f"/proc/{process.pid}").exists() for process in below)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_program_that_waits_for_json_gets_it_from_a_command_that_dies(number):
    run = spawn(START.format(body=FOREVER).replace('"all is kept"', '"all is kept", answers=True'))
    assert run.stdout is not None
    run.stdout.readline()
    os.kill(chain_of(run.pid)[2], number)
    code, told, wrong = end(run)
    answer = json.loads(told.splitlines()[-1])
    assert code == 1 and answer["ok"] is False and wrong == f"verso: {answer['error']}\n"


def test_a_command_that_ignores_the_interrupt_is_killed_by_a_second_one():
    run = start("signal.signal(signal.SIGINT, signal.SIG_IGN); " + FOREVER)
    assert run.stdout is not None
    run.stdout.readline()
    for _ in range(2):
        run.send_signal(signal.SIGINT)
        time.sleep(0.3)
    assert end(run) == (1, "", "verso: interrupted; all is kept\n")


@pytest.mark.parametrize("killed", [(0,), (1,), (0, 2), (1, 2), (2,), (0, 1, 2)])
def test_whichever_processes_are_killed_nothing_goes_on(killed):
    """0 is the process that the user started, 1 the keeper, 2 the command."""
    run = start(FOREVER)
    assert run.stdout is not None
    run.stdout.readline()
    below = descendants(run.pid)
    pids = chain_of(run.pid)
    kill_each(pids, killed)
    code, _, wrong = end(run)
    deadline = time.monotonic() + 15
    while left := [process.name for process in below if Path(f"/proc/{process.pid}").exists()]:
        assert time.monotonic() < deadline, left
        time.sleep(0.05)
    if 0 not in killed:
        assert (code, wrong.count("verso: "), wrong.count("; all is kept")) == (1, 1, 1)


@pytest.mark.parametrize("killed", [(2,), (0, 1, 2)])
def test_its_temporary_folder_goes_whichever_processes_are_killed(tmp_path, killed):
    folder = tmp_path / "private"
    (folder / "below").mkdir(parents=True)
    run = start(f"tell(folder={str(folder)!r}); " + FOREVER)
    assert run.stdout is not None
    run.stdout.readline()
    pids = chain_of(run.pid)
    kill_each(pids, killed)
    end(run)
    deadline = time.monotonic() + 15
    while folder.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_what_c_code_says_stays_out_of_the_terminal_and_is_kept_where_the_command_dies(tmp_path):
    body = f"tell(logs={str(tmp_path)!r}); os.write(2, b'*** stack dump'); print('mine', file=sys.stderr); "
    code, _, wrong = end(start(body + "os.abort()"))
    assert code == 1
    assert wrong.startswith("mine\nverso: the run crashed (SIGABRT)")
    assert "stack dump" not in wrong
    assert wrong.count("\n") == 2
    assert str(tmp_path / LAST_WORDS) in wrong
    assert (tmp_path / LAST_WORDS).read_text() == "*** stack dump"


def test_a_signal_that_the_user_ignores_stays_ignored():
    """As `nohup` does."""
    script = START.format(body="print('ready', flush=True); time.sleep(1); return 0")
    start_over = "os.execv(sys.executable, [sys.executable, '-c', sys.argv[1]])"
    run = spawn(f"import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); {start_over}", script)
    assert run.stdout is not None
    run.stdout.readline()
    run.send_signal(signal.SIGHUP)
    assert end(run) == (0, "", "")


def test_suspended_means_all_of_it_and_it_goes_on_afterwards():
    run = start("print('ready', flush=True); time.sleep(1.5); return 0")
    assert run.stdout is not None
    run.stdout.readline()
    run.send_signal(signal.SIGTSTP)
    time.sleep(0.5)
    assert {process.state for process in descendants(run.pid)[1:]} == {"T"}
    time.sleep(1.5)
    assert run.poll() is None
    run.send_signal(signal.SIGCONT)
    assert end(run) == (0, "", "")


def test_the_supervisor_loads_nothing_heavy():
    code = "import sys, services.cli.main; print(sorted({'ray', 'numpy', 'pydantic', 'pyarrow'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
