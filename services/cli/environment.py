"""Edge: restarts a command in the environment variables that its bytes depend on (schemas/environment.py), and reads settings."""

import os
import sys

from schemas.environment import settings_to_change
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


if __name__ == "__main__":  # what the launcher sets for tools that it starts itself
    print("\n".join(f"{name}={value}" for name, value in settings_to_change(os.environ, processor_flags()).items()))
