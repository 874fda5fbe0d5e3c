"""Edge: restarts a command in the environment variables that its bytes depend on (schemas/environment.py), and reads settings."""

import io
import os
import re
import shutil
import sys
from pathlib import Path

from schemas.environment import settings_to_change
from services.cli.rows import COMMANDS
from services.run.worker_entry import processor_flags


def enter_stack_environment() -> None:
    """Replace this process by the same command line in the stack's environment; return at once where it has that already.

    Only for the start of a command.
    """
    changes = settings_to_change(os.environ, processor_flags())
    if changes:
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, **changes})


def default_queue() -> str | None:
    """The queue that commands use where they name none: $VERSO_QUEUE."""
    return os.environ.get("VERSO_QUEUE") or None


def host_place(out: str) -> str:
    """In a container whose /data is a folder of the host's, $VERSO_HOST_DATA: where a place is there, in brackets; else empty."""
    host = os.environ.get("VERSO_HOST_DATA")
    place = os.path.realpath(out) if "://" not in out else ""
    return f" (on the host: {host}{place.removeprefix('/data')})" if host and place.startswith("/data/") else ""


def typed_program() -> str:
    """What starts the program where its user is: `./verso` in a checkout, `verso` where that is found, else its path.

    The launcher and the containers' file say it in $VERSO_TYPED.
    """
    typed = os.environ.get("VERSO_TYPED") or (sys.argv[0] if Path(sys.argv[0]).name == "verso" else "verso")
    program = shutil.which("verso")
    same = program is not None and os.path.isfile(typed) and os.path.samefile(program, typed)
    return "verso" if same else typed


def as_typed(text: str) -> str:
    """The text with every command of ours as it is typed here."""
    return _COMMAND.sub(typed_program().replace("\\", r"\\"), text) if "verso " in text else text


_COMMAND = re.compile(rf"(?<![\w./-])verso(?= (?:{'|'.join([*COMMANDS, 'COMMAND', '--help'])})\b)")


class _Stream(io.TextIOWrapper):
    """A text stream that writes commands as they are typed."""

    def write(self, text: str) -> int:
        return super().write(as_typed(text))


def speak_as_typed() -> None:
    """From here on this process prints commands as they are typed; nothing changes where that is `verso`."""
    for name in ("stdout", "stderr") if typed_program() != "verso" else ():
        old = getattr(sys, name)
        if isinstance(old, io.TextIOWrapper) and not isinstance(old, _Stream):
            how = (old.encoding, old.errors, None, old.line_buffering, old.write_through)
            setattr(sys, name, _Stream(old.detach(), *how))


if __name__ == "__main__":  # what the launcher sets for tools that it starts itself
    for name, value in settings_to_change(os.environ, processor_flags()).items():
        print(f"{name}={value}")
