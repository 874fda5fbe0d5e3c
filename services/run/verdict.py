"""How a supervised command ended: its exit code, and the line that says why where it did not say so itself. Pure."""

import os
import signal
from dataclasses import dataclass


@dataclass(frozen=True)
class Facts:
    """What a command told its supervisor before it ended."""

    code: int | None = None
    """Its exit code, once it has said all that there is to say."""
    interrupted: bool = False
    """It ended because of a signal, and leaves it to the supervisor to say so."""
    folder: str | None = None
    """A temporary folder that must be gone after its end."""
    logs: str | None = None
    """The folder that keeps its last words."""


def judge(facts: Facts, status: int, stopped_by: int | None, kept: str) -> tuple[int, str | None]:
    """The exit code, and the line to print (None where the command printed its own).

    `status` is the command's wait status, `stopped_by` the signal that the supervisor passed on to it, if any, and
    `kept` what remains of its work.
    """
    if facts.code is not None and not facts.interrupted:
        return facts.code, None
    if stopped_by is not None or facts.interrupted:
        number = stopped_by or signal.SIGINT
        how = "interrupted" if number == signal.SIGINT else f"stopped by {_name(number)}"
    elif not os.WIFSIGNALED(status):
        how = f"the run ended without a word (exit code {os.waitstatus_to_exitcode(status)}), as it does where Ray is lost"
    elif os.WTERMSIG(status) == signal.SIGKILL:
        how = "the run was killed (SIGKILL), which Linux also does where memory runs out"
    else:
        how = f"the run crashed ({_name(os.WTERMSIG(status))}) in Ray or in another library"
    return 1, f"{how}; {kept}"


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
