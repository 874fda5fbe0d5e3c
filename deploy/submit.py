"""Hands a job to a Ray cluster from its head, follows its log, and ends with its exit code.

    ray submit deploy/cluster.yaml deploy/submit.py JOB [options of `verso run`]
    ray submit deploy/cluster.yaml deploy/submit.py --follow ID
    ray submit deploy/cluster.yaml deploy/submit.py --stop ID

JOB is a file on the head, relative to ~/verso/jobs, or what `verso pack JOB.yaml` printed. `--out` is the whole path of a
folder that every node shares, a bucket, or a name below VERSO_STORAGE.

The job belongs to the cluster and not to this script: a closed terminal, Ctrl-C or a lost connection ends the script alone.
Uses the standard library and Ray, because `ray submit` copies this one file. Ray joins the words of its command line unquoted
into a shell on the head; from here on, no shell sees them as anything but words.
"""

import asyncio
import contextlib
import logging
import os
import re
import secrets
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DASHBOARD = os.environ.get("RAY_API_SERVER_ADDRESS", "http://127.0.0.1:8265")
JOBS = Path.home() / "verso" / "jobs"
VERSO = [sys.executable, "-P", "-m", "services.cli.main"]
GOES_ON = {signal.SIGINT: "Ctrl-C", signal.SIGHUP: "a lost connection", signal.SIGTERM: "SIGTERM"}
STARTING, STARTS_S = "No available agent", 90.0
"""What Ray says while a head that was just started takes no jobs yet, and the seconds that it may say so."""


class Refused(Exception):
    """What was asked for cannot be done; the message says why."""


class Left(BaseException):
    """The user left; the job goes on."""


def main(words: list[str]) -> int:
    """The exit code: the job's own, 2 for wrong input, 1 where it was stopped or lost, 128 + N where a signal N ends this."""
    try:
        check_words(words)
        require_token()
        if words[0] in ("--follow", "--stop"):
            if len(words) != 2:
                raise Refused(f"{words[0]} takes the id of one job")
            return follow(words[1]) if words[0] == "--follow" else stop(words[1])
        command = [*VERSO, "run", place_of(words[0]), *with_out(words[1:])]
        if code := rehearse(command):
            return code
        return 0 if "--dry-run" in words else follow(submit(command, words[0]))
    except Refused as refused:
        print(f"submit: {refused}", file=sys.stderr)
        return 2


def check_words(words: list[str]) -> None:
    """Raises Refused for words that no command has: the shell before this script may have made others of what was typed."""
    if not words or words[0] in ("-h", "--help"):
        raise Refused(f"what it takes:\n{__doc__}")
    for word in words:
        if not word.isprintable():
            raise Refused(f"{word!r} has characters that are no part of a name or value")
    if words[0].startswith("-") and words[0] not in ("--follow", "--stop"):
        raise Refused(f"the job comes first, and {words[0]!r} is none")
    if any(word.split("=")[0] == "--address" for word in words):
        raise Refused("--address is this cluster's")


def require_token() -> None:
    """Makes Ray ask with the cluster's token. Raises Refused where there is none."""
    os.environ["RAY_AUTH_MODE"] = "token"
    named = os.environ.get("RAY_AUTH_TOKEN_PATH")
    file = Path(named) if named else Path.home() / ".ray" / "auth_token"
    if not os.environ.get("RAY_AUTH_TOKEN") and not file.is_file():
        raise Refused(
            f"no token: set RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH, as deploy/cluster.env does ({file} is not there)"
        )


def place_of(job: str) -> str:
    """The job as `verso run` takes it. Raises Refused where there is no such file."""
    if job.startswith("job:"):
        return job
    path = JOBS / job
    if not path.is_file():
        known = ", ".join(sorted(file.name for file in JOBS.glob("*.yaml"))) or "nothing"
        raise Refused(f"no job {job!r}: {JOBS} has {known}; `verso pack JOB.yaml` sends a file that is not on the head")
    return str(path)


def with_out(words: list[str]) -> list[str]:
    """The options, with a name for `--out` put below VERSO_STORAGE. Raises Refused without an output folder."""
    words = [part for word in words for part in (word.split("=", 1) if word.startswith("--out=") else [word])]
    if "--out" not in words[:-1]:
        raise Refused("--out is missing: a folder that every node shares, a bucket, or a name below VERSO_STORAGE")
    at = words.index("--out") + 1
    out, storage = words[at], os.environ.get("VERSO_STORAGE", "")
    if "://" not in out and not out.startswith("/"):
        if not storage:
            raise Refused(f"--out {out}: give the whole path, or set VERSO_STORAGE in deploy/cluster.env")
        words[at] = f"{storage.rstrip('/')}/{out}"
    return words


def rehearse(command: list[str]) -> int:
    """The exit code of a dry run, which says what is wrong with the job or its options before it is queued."""
    return subprocess.run([*command, *([] if "--dry-run" in command else ["--dry-run"])], check=False).returncode


def client() -> Any:
    """The head's job API, Ray's `JobSubmissionClient`. Raises Refused where it does not answer, or not to this token."""
    try:
        from ray.job_submission import JobSubmissionClient
    except ImportError as error:
        raise Refused(
            f"{sys.executable} has no Ray ({error}): see the setup_commands of deploy/cluster.yaml"
        ) from error
    logging.getLogger("ray.dashboard.modules.job.sdk").setLevel(logging.WARNING)  # else it tells of its sockets
    with told(DASHBOARD):
        return JobSubmissionClient(DASHBOARD)


@contextlib.contextmanager
def told(what: str) -> Iterator[None]:
    """Raises Refused, which begins with `what`, for what Ray raises in the block."""
    from ray.exceptions import AuthenticationError

    try:
        yield
    except (ConnectionError, RuntimeError, AuthenticationError) as error:
        raise Refused(f"{what}: {' '.join(str(error).split())[:300]}") from error


def submit(command: list[str], job: str) -> str:
    """The id of the job that now runs the command on the cluster."""
    name = "packed" if job.startswith("job:") else re.sub(r"[^A-Za-z0-9_]+", "-", Path(job).stem)[:40]
    asked, submission = client(), f"verso-{name}-{secrets.token_hex(4)}"
    # Ray's supervisor gives this line to a shell: quoted, every word arrives as it is.
    entrypoint, deadline = shlex.join([*command, "--address", "auto"]), time.monotonic() + STARTS_S
    with told(DASHBOARD):
        while True:
            try:
                asked.submit_job(entrypoint=entrypoint, submission_id=submission)
                return submission
            except RuntimeError as error:
                if STARTING not in str(error) or time.monotonic() > deadline:
                    raise
            print("submit: the head has just started and takes no jobs yet: asked again", file=sys.stderr)
            time.sleep(1.0)


def follow(job: str) -> int:
    """Prints the job's log until it ends; its exit code."""
    asked = client()
    known(asked, job)
    print(f"submit: job {job}", file=sys.stderr, flush=True)

    def leave(number: int, frame: object) -> None:
        raise Left(number)

    for number in GOES_ON:
        signal.signal(number, leave)
    try:
        asyncio.run(print_log(asked, job))
    except Left as left:
        return say_how_to_return(job, left.args[0])
    except BrokenPipeError:
        return 128 + signal.SIGHUP
    info = asked.get_job_info(job)
    if info.status == "SUCCEEDED":
        return 0
    if info.status == "STOPPED":
        print(f"submit: job {job} was stopped; what is committed is kept", file=sys.stderr)
    elif info.driver_exit_code is None:
        print(f"submit: job {job}: {info.message}", file=sys.stderr)
    return info.driver_exit_code or 1


async def print_log(asked: Any, job: str) -> None:
    """Prints what the job says, as it says it, until the job has ended."""
    shown = 0

    def show(said: str, start: int) -> None:
        """Prints what is new of the text that begins at `start` of the log: a new connection begins at 0 again."""
        nonlocal shown
        print(said[max(0, shown - start) :], end="", flush=True)
        shown = max(shown, start + len(said))

    while True:
        heard = 0
        with contextlib.suppress(ConnectionError, RuntimeError):
            async for part in asked.tail_job_logs(job):
                show(part, heard)
                heard += len(part)
        if asked.get_job_status(job).is_terminal():
            return show(asked.get_job_logs(job), 0)
        await asyncio.sleep(1.0)


def say_how_to_return(job: str, number: int) -> int:
    """Says that the job goes on, and how it is followed and stopped; the exit code of a process that a signal ended."""
    again = "ray submit CLUSTER.yaml deploy/submit.py"
    lines = [
        f"left by {GOES_ON[signal.Signals(number)]}; job {job} goes on",
        f"{again} --follow {job}",
        f"{again} --stop {job}",
    ]
    with contextlib.suppress(OSError):  # the terminal is gone
        print("\n".join(f"submit: {line}" for line in lines), file=sys.stderr, flush=True)
    return 128 + number


def known(asked: Any, job: str) -> None:
    """Raises Refused where the cluster has no such job."""
    with told(job):
        asked.get_job_info(job)


def stop(job: str) -> int:
    """Asks a job to end; 0 where it ran."""
    asked = client()
    known(asked, job)
    asked.stop_job(job)
    print(f"submit: job {job} is being stopped; what is committed is kept", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
