"""The supervisor: runs a command as a child, and whatever becomes of it, ends with a plain line and nothing left behind.

Three processes: the one that the user started, a keeper, and the command. The keeper and the command have sessions of
their own, so that a terminal's Ctrl-C reaches the first one alone, and Ray's processes never. The first two do the same:
they wait, pass signals on, and end all that descends from them; so either may be killed. A fourth process sleeps until all
three are gone, and then ends what carries the run's mark. Nothing heavy is loaded here.
"""

import contextlib
import json
import os
import shutil
import signal
import sys
import time
import traceback
import uuid
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Final

from services.run.machine import (
    GRACE_S,
    KILL_S,
    adopt_orphans,
    descendants,
    die_with,
    end_all,
    marked,
    reap,
    send,
)

STOPS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""Signals that ask a process to end."""


@dataclass(frozen=True)
class Facts:
    """What a command told its supervisor before it ended."""

    code: int | None = None
    """Its exit code, once it has said all that there is to say."""
    ended_by: int | None = None
    """The signal that it ended by in order, which it leaves to the supervisor to say."""
    folder: str | None = None
    """A temporary folder that must be gone after its end."""
    logs: str | None = None
    """The folder that keeps its last words."""


def judge(facts: Facts, status: int, stopped_by: int | None, kept: str) -> tuple[int, str | None]:
    """The exit code, and the line to print (None where the command printed its own).

    `status` is the command's wait status, `stopped_by` the signal that was passed on to it, `kept` what remains of its work.
    """
    if facts.code is not None and facts.ended_by is None:
        return facts.code, None
    ended_by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else None
    number = stopped_by or facts.ended_by or ended_by
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    if number == signal.SIGINT:
        how = "interrupted"
    elif number in STOPS:
        how = f"stopped by {name}"
    elif number == signal.SIGKILL:
        how = "the run was killed (SIGKILL), which Linux also does where memory runs out"
    elif number is not None:
        how = f"the run crashed ({name}) in Ray or in another library"
    else:
        how = f"the run ended without a word (exit code {os.waitstatus_to_exitcode(status)}), as it does where Ray is lost"
    return 1, f"{how}; {kept}"


STOP_S = 30.0
"""Time that the command gets to end after the first signal that stops it; a second one ends it at once."""

EXIT_S = 10
"""Time that the command's interpreter gets to end once its exit code is told."""

LAST_WORDS = "driver.txt"
"""The file in OUT/_logs with what Ray said in the command's process, where that is anything."""

_LAST_BYTES = 2**20

MARK = "VERSO_RUN"
"""The environment variable that all processes of one run have in common."""

_listeners: list[int] = []
"""Pipes to the supervisors of this process; empty where it has none."""


def supervise(command: Callable[[], int], kept: str, quiet: bool = True, answers: bool = False) -> int:
    """The exit code of `command`, which runs in a child; returns there too, with the same code.

    A command that dies is told in one line on standard error, with `kept`: what remains of its work. `quiet` keeps what
    C++ code writes out of the terminal. With `answers`, a JSON object is printed for a command that dies. For a process without
    threads.
    """
    words = os.memfd_create("last words") if quiet else None
    all_watched = {*STOPS, signal.SIGTSTP, signal.SIGCONT}
    watched = {number for number in all_watched if signal.getsignal(number) != signal.SIG_IGN}  # as `nohup` asks for
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, watched | {signal.SIGCHLD})
    last = os.pipe()
    keeper = _Layer(frozenset(watched), kept, words, answers, signal.SIGKILL, True, last, _set_mark())
    front = replace(keeper, dies_with_parent=signal.SIGTERM, innermost=False)
    return front.tend(lambda: keeper.tend(lambda: _drive(command, words, mask)))


def tell_failure(line: str, kind: str, answers: bool) -> None:
    """Tells the user why a command ended, and in the last line of `--json` the program that waits for an answer."""
    print(f"verso: {line}", file=sys.stderr)
    if answers:
        print(json.dumps({"ok": False, "error": line, "kind": kind}))


def _set_mark() -> str:
    """The line in the environments of all that the command starts. It leaves the mark of a run that started this one."""
    environ, name = os.environ, MARK  # noqa: TID251 - what the command starts inherits it, and is known by it
    while name in environ:
        name += "_"
    environ[name] = uuid.uuid4().hex
    return f"{name}={environ[name]}"


def tell(**facts: int | str | None) -> None:
    """Tells the supervisors a fact (the fields of `Facts`); nothing where there is none."""
    line = json.dumps(facts).encode() + b"\n"
    for pipe in _listeners:
        with contextlib.suppress(OSError):  # a supervisor that was killed
            os.write(pipe, line)


@contextlib.contextmanager
def core_stderr() -> Iterator[IO[str]]:
    """Descriptor 2 as a text stream: where C++ code writes, which a quiet supervisor keeps out of the terminal."""
    with open(2, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False) as stream:
        yield stream


@dataclass(frozen=True)
class _Layer:
    """One of the two processes above the command."""

    watched: frozenset[signal.Signals]
    kept: str
    words: int | None
    answers: bool
    dies_with_parent: signal.Signals
    """What its child gets when this process dies."""
    innermost: bool
    last: tuple[int, int]
    """The pipe whose end, when nobody can write to it any more, wakes the last process."""
    mark: str

    def tend(self, work: Callable[[], int]) -> int:
        """Runs `work` in a child; its exit code, in both processes."""
        adopt_orphans()
        ear, mouth = os.pipe()
        me = os.getpid()
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            os.close(ear)
            _listeners[:] = [*(_listeners or [self.last[1]]), mouth]
            os.setsid()
            die_with(me, self.dies_with_parent)
            return work()
        os.close(mouth)
        if self.innermost:
            _start_last(self.last, self.mark)
        status, stopped_by = self._wait(child)
        end_all(lambda: descendants(os.getpid()))  # all of them: they cannot leave a child subreaper
        facts = _read(ear)
        _remove(facts.folder)
        code, line = judge(facts, status, stopped_by, self.kept)
        where = _keep_last_words(self.words, facts.logs)
        if line is not None:
            self._say(line + where if stopped_by is None else line)
        tell(code=code, ended_by=None)
        return code

    def _say(self, line: str) -> None:
        """Tells the user, and the program that waits for an answer, how the command ended."""
        with contextlib.suppress(OSError):  # a terminal that was closed
            if sys.stderr.isatty():
                print("\r\x1b[K", end="", file=sys.stderr)  # a bar that its process could not end
            tell_failure(line, "Ended", self.answers)
            sys.stderr.flush()
            sys.stdout.flush()

    def _wait(self, child: int) -> tuple[int, int | None]:
        """The child's wait status, and the first signal that it was ended by, if any."""
        stopped_by: int | None = None
        deadline = float("inf")
        patience_s = STOP_S if self.innermost else STOP_S + 2 * (GRACE_S + KILL_S)
        while True:
            caught = signal.sigtimedwait(self.watched | {signal.SIGCHLD}, 1.0)
            statuses = reap()
            if child in statuses:
                return statuses[child], stopped_by
            number = caught.si_signo if caught else None
            if number in STOPS:
                # Python's interrupt for the command, and its end at the second one; the signal itself for the keeper
                for_command = signal.SIGINT if stopped_by is None else signal.SIGKILL
                stopped_by = stopped_by or number
                deadline = min(deadline, time.monotonic() + patience_s)
                os.kill(child, for_command if self.innermost else number)
            elif number in (signal.SIGTSTP, signal.SIGCONT):
                self._suspend(child, number)
            if time.monotonic() > deadline:
                os.kill(child, signal.SIGKILL)

    def _suspend(self, child: int, number: int) -> None:
        """Ctrl-Z, or going on after it, of the whole tree."""
        if self.innermost:
            for process in descendants(os.getpid()):
                send(process, signal.SIGSTOP if number == signal.SIGTSTP else signal.SIGCONT)
            return
        os.kill(child, number)
        if number == signal.SIGTSTP:
            os.kill(os.getpid(), signal.SIGSTOP)


def _start_last(pipe: tuple[int, int], mark: str) -> None:
    """Starts the process that outlives a kill of all others, and then ends what carries the run's mark."""
    if os.fork():
        return
    os.setsid()
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nowhere, number)
    for writer in {pipe[1], *_listeners}:
        os.close(writer)
    facts = _read(pipe[0], to_its_end=True)
    end_all(lambda: marked(mark))
    _remove(facts.folder)
    os._exit(0)


def _drive(command: Callable[[], int], words: int | None, mask: Collection[int]) -> int:
    """Runs the command in this process, and tells its exit code once everything is said."""
    if (
        words is not None
    ):  # from now on Python's standard error is the user's as before, and what C++ writes to is `words`
        users = os.dup(2)
        sys.stderr = os.fdopen(users, "w", buffering=1, encoding=sys.stderr.encoding, errors=sys.stderr.errors)
        os.dup2(words, 2)
    code = 1
    try:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        code = command()
        sys.stdout.flush()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is said
    except KeyboardInterrupt:
        tell(ended_by=signal.SIGINT)
    except SystemExit:  # how Ray answers SIGTERM; the command line raises none of its own from here on
        tell(ended_by=signal.SIGTERM)
    except Exception:
        traceback.print_exc()
    tell(code=code)
    # gRPC's destructors hang where a Ray did not start; the default of SIGALRM is to end the process
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(EXIT_S)
    return code


def _keep_last_words(words: int | None, logs: str | None) -> str:
    """Writes what C++ said last to the log folder; the end of a sentence that says where, or nothing."""
    size = 0 if words is None else os.fstat(words).st_size
    if words is None or logs is None or size == 0:
        return ""
    path = Path(logs) / LAST_WORDS
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o644)
        with open(file, "wb") as kept:
            kept.write(os.pread(words, _LAST_BYTES, max(0, size - _LAST_BYTES)))
    except OSError:
        return ""
    return f" ({path} has its last words)"


def _read(pipe: int, to_its_end: bool = False) -> Facts:
    """What came through the pipe so far, or until nobody can write to it any more."""
    os.set_blocking(pipe, to_its_end)
    data = b""
    with contextlib.suppress(BlockingIOError):
        while part := os.read(pipe, 2**16):
            data += part
    facts = Facts()
    for line in data.splitlines():
        with contextlib.suppress(ValueError):  # cut short by a kill
            facts = replace(facts, **json.loads(line))
    return facts


def _remove(folder: str | None) -> None:
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
