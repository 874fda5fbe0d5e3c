"""What a process sees of the node that it runs on: processor, environment, code, output folder. Edge.

Loads the standard library alone: on a cluster it runs before anything that reads the environment while it loads, and on
nodes that may lack this project.
"""

import json
import os
import socket
import time
import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

LOOK_S = 3.0
"""Time for a file that was just written to be seen through a network file system."""


@dataclass(frozen=True)
class Sight:
    """A node as one of its processes saw it."""

    host: str
    flags: frozenset[str]
    """Feature flags of its processor."""
    environment: dict[str, str]
    """Of the variables that were asked about, those that the process was started with."""
    code: str
    """Digest of the project's code there; empty where it cannot be imported."""
    no_code: str = ""
    """Why it cannot."""
    folder: str = ""
    """What is wrong with the output folder there; empty where nothing is."""


def processor_flags(cpuinfo: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Feature flags of this machine's first core, from Linux; empty where it does not list them."""
    try:
        with cpuinfo.open() as lines:
            first = next((line for line in lines if line.startswith("flags")), "")
    except OSError:
        return frozenset()
    return frozenset(first.partition(":")[2].split())


def start_environment(names: Iterable[str], environ: Path = Path("/proc/self/environ")) -> dict[str, str]:
    """Of these variables, those that this process was started with: what libraries read that load before our code."""
    lines = (line.decode(errors="replace").partition("=") for line in environ.read_bytes().split(b"\0"))
    started = {name: value for name, _, value in lines}
    return {name: started[name] for name in names if name in started}


def look_at_folder(proof: str, token: str, patience_s: float = LOOK_S) -> str:
    """What is wrong with the folder of the file `proof`, which holds `token` for every node that sees it; or nothing."""
    folder, deadline = os.path.dirname(proof), time.monotonic() + patience_s
    while (held := _token_in(proof)) != token:
        if time.monotonic() > deadline:
            if not os.path.isdir(folder):
                return "there is no such folder"
            return "it is another folder" if held is None else "it holds the lock of another run"
        time.sleep(0.1)
    return _why_not_writable(folder)


def _token_in(proof: str) -> str | None:
    try:
        held = json.loads(Path(proof).read_bytes())
        return str(held["token"])
    except (OSError, ValueError, KeyError, TypeError):  # a file that is just being replaced, too
        return None


def _why_not_writable(folder: str) -> str:
    scratch = os.path.join(folder, "_staging", "_tmp", f"node-{uuid.uuid4().hex}")
    try:
        os.makedirs(os.path.dirname(scratch), exist_ok=True)
        os.close(os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644))
        os.unlink(scratch)
    except OSError as error:
        return f"it cannot be written ({error.strerror})"
    return ""


def _read_code() -> tuple[str, str]:
    """(the digest of the project's code, "") or ("", why it cannot be imported)."""
    try:
        from workers.shard.code import code_digest
    except ImportError as error:
        return "", str(error)
    return code_digest(), ""


def see(names: Iterable[str], proof: str, token: str) -> Sight:
    """This process's node; `proof` is empty where the output is no folder."""
    code, no_code = _read_code()
    folder = look_at_folder(proof, token) if proof else ""
    return Sight(socket.gethostname(), processor_flags(), start_environment(names), code, no_code, folder)
