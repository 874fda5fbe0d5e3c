"""`ray submit CLUSTER.yaml deploy/submit.py`: hands `verso run` to the cluster from its head, follows its log, has its exit code.

JOB is a file on the head, relative to ~/verso/jobs, or what `verso pack JOB.yaml` printed. `--out` is the whole path of a
folder that every node shares, a bucket, or a name below VERSO_STORAGE. The job belongs to the cluster and not to this process:
a closed terminal, Ctrl-C or a lost connection ends this process alone.
"""

import contextlib
import os
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final, NoReturn

from schemas.errors import InputError, VersoError
from services.queue.drivers import RayDrivers
from services.queue.listing import follow_log

USAGE: Final = "what it takes: JOB --out OUT [options of `verso run`], --follow ID, or --stop ID"
JOBS: Final = Path.home() / "verso" / "jobs"
VERSO: Final = (sys.executable, "-P", "-m", "services.cli.main")
GOES_ON: Final = {signal.SIGINT: "Ctrl-C", signal.SIGHUP: "a lost connection", signal.SIGTERM: "SIGTERM"}


class Left(BaseException):
    """The user left; the job goes on."""


def main(words: list[str]) -> int:
    """The exit code: the job's own, 2 for wrong input, 1 where it was stopped or lost, 128 + N where a signal N ends this."""
    environ = os.environ  # noqa: TID251 - the head's shell, as deploy/cluster.env sets it; Ray reads the token there
    try:
        check_words(words)
        require_token(environ)
        drivers = RayDrivers(environ.get("RAY_API_SERVER_ADDRESS", "http://127.0.0.1:8265"))
        if words[0] == "--follow":
            return follow(drivers, words[1])
        if words[0] == "--stop":
            drivers.require(words[1])
            drivers.stop(words[1])
            _say(f"job {words[1]} is being stopped; what is committed is kept")
            return 0
        run = [*VERSO, "run", place_of(words[0]), *with_out(words[1:], environ.get("VERSO_STORAGE", ""))]
        dry = "--dry-run" in words  # it says what is wrong with the job or its options before it is queued
        code = subprocess.run([*run, *([] if dry else ["--dry-run"])], check=False).returncode
        if code or dry:
            return code
        name = "packed" if words[0].startswith("job:") else re.sub(r"[^A-Za-z0-9_]+", "-", Path(words[0]).stem)[:40]
        job = f"verso-{name}-{secrets.token_hex(4)}"
        drivers.hand_over(job, [*run, "--address", "auto"])
        return follow(drivers, job)
    except VersoError as error:
        _say(str(error))
        return error.exit_code


def check_words(words: list[str]) -> None:
    """Raises InputError for words that no command has: the shell before this process may have made others of what was typed."""
    is_asked = bool(words) and words[0] in ("--follow", "--stop")
    if not words or (words[0].startswith("-") and not is_asked) or (is_asked and len(words) != 2):
        raise InputError(USAGE)
    if wrong := [word for word in words if not word.isprintable()]:
        raise InputError(f"{wrong[0]!r} has characters that are no part of a name or value")
    if any(word.split("=")[0] == "--address" for word in words):
        raise InputError("--address is this cluster's")


def require_token(environ: MutableMapping[str, str]) -> None:
    """Makes Ray ask with the cluster's token. Raises InputError where there is none."""
    environ["RAY_AUTH_MODE"] = "token"
    file = Path(environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
    if not environ.get("RAY_AUTH_TOKEN") and not file.is_file():
        raise InputError(
            f"no token: set RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH, as deploy/cluster.env does ({file} is not there)"
        )


def place_of(job: str) -> str:
    """The job as `verso run` takes it. Raises InputError where there is no such file."""
    path = JOBS / job
    if not job.startswith("job:") and not path.is_file():
        known = ", ".join(sorted(file.name for file in JOBS.glob("*.yaml"))) or "nothing"
        raise InputError(
            f"no job {job!r}: {JOBS} has {known}; `verso pack JOB.yaml` sends a file that is not on the head"
        )
    return job if job.startswith("job:") else str(path)


def with_out(words: list[str], storage: str) -> list[str]:
    """The options, with a name for `--out` put below `storage`. Raises InputError without an output folder."""
    words = [part for word in words for part in (word.split("=", 1) if word.startswith("--out=") else [word])]
    if "--out" not in words[:-1]:
        raise InputError("--out is missing: a folder that every node shares, a bucket, or a name below VERSO_STORAGE")
    at = words.index("--out") + 1
    if "://" not in words[at] and not words[at].startswith("/"):
        if not storage:
            raise InputError(f"--out {words[at]}: give the whole path, or set VERSO_STORAGE in deploy/cluster.env")
        words[at] = f"{storage.rstrip('/')}/{words[at]}"
    return words


def follow(drivers: RayDrivers, job: str) -> int:
    """Prints the job's log until it ends; its exit code. Raises InputError where the cluster has no such job."""
    drivers.require(job)
    _say(f"job {job}")

    def leave(number: int, frame: object) -> NoReturn:
        raise Left(number)

    for number in GOES_ON:
        signal.signal(number, leave)
    try:
        for part in follow_log(drivers, job):
            print(part, end="", flush=True)
    except Left as left:
        again = "ray submit CLUSTER.yaml deploy/submit.py"
        with contextlib.suppress(OSError):  # the terminal is gone
            _say(f"left by {GOES_ON[left.args[0]]}; job {job} goes on\nsubmit: {again} --follow {job}")
            _say(f"{again} --stop {job}")
        return 128 + int(left.args[0])
    except BrokenPipeError:
        return 128 + signal.SIGHUP
    code, message = drivers.end_of(job)
    if code is None:
        _say(f"job {job}: {message}; what is committed is kept")
    return 1 if code is None else code


def _say(line: str) -> None:
    print(f"submit: {line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
