"""Processes of this machine: found, signalled, ended, and every way in which a supervised command can end."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from dataclasses import replace
from pathlib import Path

import pytest

from services.run.machine import descendants, marked, read_process, send, usable_cores
from services.run.supervisor import LAST_WORDS, MARK, Facts, judge
from tests.kit.killed_runs import chain_of

ROOT = Path(__file__).resolve().parents[3]

FAMILY = """
import json, os, subprocess, sys, time
from services.run.machine import adopt_orphans, descendants, end_all
adopt_orphans()
stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"
orphan = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {stubborn!r}], start_new_session=True)"
children = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) for code in (stubborn, orphan)]
[child.stdout.readline() for child in children]
stopped = subprocess.Popen(["sleep", "600"])
stopped.send_signal(19)
children[1].wait()
family = sorted(process.pid for process in descendants(os.getpid()))
print(json.dumps([family, [process.pid for process in end_all(lambda: descendants(os.getpid()))]]))
"""


@pytest.fixture
def sleeper():
    child = subprocess.Popen(["sleep", "600"], env={"ONE": "run"})
    yield child
    child.kill()
    child.wait()


@pytest.mark.minute
def test_orphans_in_other_sessions_stopped_and_stubborn_ones_are_ended_and_nobody_else(sleeper):
    begun = time.monotonic()
    done = subprocess.run([sys.executable, "-c", FAMILY], cwd=ROOT, capture_output=True, text=True, check=True)
    family, left = json.loads(done.stdout)
    assert (len(family), left) == (3, [])
    assert [pid for pid in family if read_process(pid) is not None] == []
    assert sleeper.poll() is None
    assert time.monotonic() - begun < 15


def test_processes_are_known_by_their_environment_and_by_their_start(sleeper):
    assert [process.pid for process in marked("ONE=run")] == [sleeper.pid]
    assert [*marked("ONE=ru"), *marked("NE=run")] == []
    process = read_process(sleeper.pid)
    assert process is not None and process in descendants(os.getpid())
    send(replace(process, born="0"), signal.SIGKILL)  # its id was given out again
    time.sleep(0.1)
    assert sleeper.poll() is None
    send(process, signal.SIGKILL)
    assert sleeper.wait(10) == -signal.SIGKILL
    assert read_process(sleeper.pid) is None
    send(process, signal.SIGKILL)  # nothing is there, and nothing happens


QUOTA = {"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}


def test_a_containers_quota_is_respected(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)))
    by_quota = {"200000": 2, "150000": 2, "50000": 1, "max": 16, "6400000": 16}
    cases = [("0::/\n", {"cpu.max": f"{quota} 100000\n"}, cores) for quota, cores in by_quota.items()]
    cases += [
        ("0::/user/job\n", {"user/cpu.max": "300000 100000\n", "user/job/cpu.max": "max 100000\n"}, 3),
        ("3:cpu,cpuacct:/\n", QUOTA, 4),
        ("3:cpu:/docker/abc\n", QUOTA, 4),
        ("3:cpu:/\n", {**QUOTA, "cpu/cpu.cfs_quota_us": "-1\n"}, 16),
        ("3:cpuset:/\n", QUOTA, 16),
    ]
    for number, (membership, files, cores) in enumerate(cases):
        here = tmp_path / str(number)
        for name, text in {"cgroup": membership, **{f"sys/{name}": text for name, text in files.items()}}.items():
            (here / name).parent.mkdir(parents=True, exist_ok=True)
            (here / name).write_text(text)
        assert usable_cores(here / "cgroup", here / "sys") == cores, (membership, files)
    assert usable_cores(tmp_path / "absent", tmp_path) == 16


# ------------------------------------------------------------------------------------------------ the supervisor

KEPT = "all is kept"
STOPPED = {signal.SIGINT: "interrupted", signal.SIGTERM: "stopped by SIGTERM", signal.SIGHUP: "stopped by SIGHUP"}
DEATHS = {
    signal.SIGKILL: "killed (SIGKILL), which Linux also does where memory runs out",
    signal.SIGABRT: "crashed (SIGABRT)",
    signal.SIGSEGV: "crashed (SIGSEGV)",
    signal.SIGRTMIN + 1: f"crashed (signal {signal.SIGRTMIN + 1})",
    7 << 8: "ended without a word (exit code 7)",
    0: "ended without a word (exit code 0)",
}
"""By wait status."""


def test_an_end_is_judged_by_what_the_command_told_by_the_signal_and_by_how_its_process_ended():
    for code in (0, 1, 2):
        for status in (code << 8, signal.SIGABRT, signal.SIGKILL):
            for stopped_by in (None, signal.SIGTERM):
                assert judge(Facts(code=code), status, stopped_by, KEPT) == (code, None)
    for number, words in STOPPED.items():
        line = (1, f"{words}; all is kept")
        for status in (1 << 8, signal.SIGABRT, signal.SIGKILL):
            assert judge(Facts(), status, number, KEPT) == line
            assert judge(Facts(code=1, ended_by=signal.SIGINT), status, number, KEPT) == line
        assert judge(Facts(code=1, ended_by=number), 1 << 8, None, KEPT) == line, "it reached the command alone"
        assert judge(Facts(), number, None, KEPT) == line
    for status, words in DEATHS.items():
        code, line = judge(Facts(), status, None, KEPT)
        assert code == 1 and words in line and line.endswith("; all is kept"), "never as success"


START = """
import os, signal, subprocess, sys, time
from services.run.supervisor import supervise, tell
def command():
    {body}
sys.exit(supervise(command, "all is kept"))
"""

FOREVER = "subprocess.Popen(['sleep', '600'], start_new_session=True); print('ready', flush=True); time.sleep(600)"


def spawn(code: str, *arguments: str) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code, *arguments], cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def start(body: str) -> subprocess.Popen[str]:
    return spawn(START.format(body=body))


def begun(body: str = FOREVER, code: str = START, *arguments: str) -> subprocess.Popen[str]:
    """A command that has said the line `ready`."""
    run = spawn(code.replace("{body}", body), *arguments)
    assert run.stdout is not None
    run.stdout.readline()
    return run


def kill_each(pids: list[int], numbers: tuple[int, ...]) -> None:
    """SIGKILL to those of the numbers; one may have ended already, because another was killed."""
    for number in numbers:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pids[number], signal.SIGKILL)


def end(run: subprocess.Popen[str]) -> tuple[int, str, str]:
    said, wrong = run.communicate(timeout=60)
    return run.returncode, said, wrong


def wait_until_gone(*paths: Path) -> None:
    deadline = time.monotonic() + 15
    while left := [path for path in paths if path.exists()]:
        assert time.monotonic() < deadline, left
        time.sleep(0.05)


def test_what_a_command_says_and_its_exit_code_arrive_unchanged_and_a_bug_shows_its_traceback():
    for code in (0, 1, 2):
        body = f"print('answer'); print('verso: why', file=sys.stderr); return {code}"
        assert end(start(body)) == (code, "answer\n", "verso: why\n")
    code, _, wrong = end(start("raise ZeroDivisionError"))
    assert code == 1 and "ZeroDivisionError" in wrong and "verso:" not in wrong


def test_a_command_that_dies_is_told_in_one_line_and_what_c_code_said_is_kept_in_the_logs(tmp_path):
    for body, words in (
        ("os.kill(os.getpid(), 9)", "was killed (SIGKILL), which Linux also does where memory runs out"),
        ("os._exit(7)", "ended without a word (exit code 7), as it does where Ray is lost"),
    ):
        assert end(start(f"print('x', flush=True); {body}")) == (1, "x\n", f"verso: the run {words}; all is kept\n")
    body = f"tell(logs={str(tmp_path)!r}); os.write(2, b'*** stack dump'); print('mine', file=sys.stderr); os.abort()"
    code, _, wrong = end(start(body))
    crashed = "mine\nverso: the run crashed (SIGABRT) in Ray or in another library; all is kept"
    assert code == 1 and wrong.startswith(crashed) and wrong.count("\n") == 2
    assert "stack dump" not in wrong and str(tmp_path / LAST_WORDS) in wrong
    assert (tmp_path / LAST_WORDS).read_text() == "*** stack dump"


@pytest.mark.parametrize("number", STOPPED)
def test_a_signal_ends_the_command_and_all_that_it_started(number):
    run = begun()
    below = descendants(run.pid)
    assert len(below) == 4  # the keeper, the command, the last process, and what the command started
    run.send_signal(number)
    assert end(run) == (1, "", f"verso: {STOPPED[number]}; all is kept\n")
    assert not any(Path(f"/proc/{process.pid}").exists() for process in below)


@pytest.mark.minute
def test_what_a_run_starts_below_another_run_has_the_marks_of_both(monkeypatch):
    """The outer one is killed with all of the inner one's supervisors: its last process ends what that started, too."""
    outer = uuid.uuid4().hex
    monkeypatch.setenv(MARK, outer)
    run = begun()
    deadline = time.monotonic() + 15  # a program that was just started has no environment for a moment
    while not (started := [process.pid for process in marked(f"{MARK}={outer}") if process.name == "sleep"]):
        assert time.monotonic() < deadline or run.kill()
    kill_each(chain_of(run.pid), (0, 1, 2))
    end(run)
    wait_until_gone(*(Path(f"/proc/{pid}") for pid in started))


def test_a_program_that_waits_for_json_gets_it_from_a_command_that_dies():
    run = begun(code=START.replace('"all is kept"', '"all is kept", answers=True'))
    os.kill(chain_of(run.pid)[2], signal.SIGKILL)
    code, said, wrong = end(run)
    answer = json.loads(said.splitlines()[-1])
    assert code == 1 and answer["ok"] is False and wrong == f"verso: {answer['error']}\n"


def test_a_command_whose_interpreter_does_not_end_is_ended_with_its_exit_code():
    patience = "import atexit, services.run.supervisor as module; module.EXIT_S = 1"
    assert end(start(f"{patience}; atexit.register(time.sleep, 600); print('said'); return 3")) == (3, "said\n", "")


def test_a_command_that_ignores_the_interrupt_is_killed_by_a_second_one():
    run = begun("signal.signal(signal.SIGINT, signal.SIG_IGN); " + FOREVER)
    for _ in range(2):
        run.send_signal(signal.SIGINT)
        time.sleep(0.3)
    assert end(run) == (1, "", "verso: interrupted; all is kept\n")


@pytest.mark.minute
@pytest.mark.parametrize(
    "killed",
    [(0,), (1,), (2,), *(pytest.param(several, marks=pytest.mark.minute) for several in ((0, 2), (1, 2), (0, 1, 2)))],
)
def test_whichever_processes_are_killed_nothing_goes_on_and_the_temporary_folder_goes(tmp_path, killed):
    """0 is the process that the user started, 1 the keeper, 2 the command."""
    folder = tmp_path / "private"
    (folder / "below").mkdir(parents=True)
    run = begun(f"tell(folder={str(folder)!r}); " + FOREVER)
    below = descendants(run.pid)
    kill_each(chain_of(run.pid), killed)
    code, _, wrong = end(run)
    wait_until_gone(*(Path(f"/proc/{process.pid}") for process in below), folder)
    if 0 not in killed:
        assert (code, wrong.count("verso: "), wrong.count("; all is kept")) == (1, 1, 1)


def test_a_signal_that_the_user_ignores_stays_ignored():
    """As `nohup` does."""
    script = START.format(body="print('ready', flush=True); time.sleep(1); return 0")
    start_over = "os.execv(sys.executable, [sys.executable, '-c', sys.argv[1]])"
    run = begun("", f"import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); {start_over}", script)
    run.send_signal(signal.SIGHUP)
    assert end(run) == (0, "", "")


def test_suspended_means_all_of_it_and_it_goes_on_afterwards():
    run = begun("print('ready', flush=True); time.sleep(0.8); return 0")
    run.send_signal(signal.SIGTSTP)
    time.sleep(0.4)
    assert {process.state for process in descendants(run.pid)[1:]} == {"T"}
    time.sleep(0.8)
    assert run.poll() is None
    run.send_signal(signal.SIGCONT)
    assert end(run) == (0, "", "")
