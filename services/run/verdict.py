"""How a supervised command ended: its exit code, and the line that says why where it did not say so itself. Pure."""

import os
import signal
from dataclasses import dataclass
from typing import Final

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

    `status` is the command's wait status, `stopped_by` the signal that the supervisor passed on to it, if any, and
    `kept` what remains of its work.
    """
    if facts.code is not None and facts.ended_by is None:
        return facts.code, None
    if number := stopped_by or facts.ended_by or _stop_of(status):
        how = "interrupted" if number == signal.SIGINT else f"stopped by {_name(number)}"
    elif not os.WIFSIGNALED(status):
        how = f"the run ended without a word (exit code {os.waitstatus_to_exitcode(status)}), as it does where Ray is lost"
    elif os.WTERMSIG(status) == signal.SIGKILL:
        how = "the run was killed (SIGKILL), which Linux also does where memory runs out"
    else:
        how = f"the run crashed ({_name(os.WTERMSIG(status))}) in Ray or in another library"
    return 1, f"{how}; {kept}"


def _stop_of(status: int) -> int | None:
    """The signal of a process that ended by one that asks it to."""
    return os.WTERMSIG(status) if os.WIFSIGNALED(status) and os.WTERMSIG(status) in STOPS else None


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
