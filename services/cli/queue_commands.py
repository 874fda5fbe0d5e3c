"""Handlers of the queue's commands: each takes the parsed options, prints, and returns the exit code."""

import argparse
import contextlib
import signal
import sys
import tempfile
import time
import urllib.parse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.errors import InputError, MachineError, RunError, command_line, plural
from schemas.queue import JobRequest
from services.cli import rows
from services.cli.commands import tell_result
from services.cli.environment import default_queue
from services.job.job_file import load_job, name_of, read_text, refuse_folders
from services.queue.queue import Queue, make_queue, new_id, open_queue
from services.run.progress import finish

if TYPE_CHECKING:
    from services.queue.drivers import Ending
    from services.queue.supervise import Drivers


def submit(options: argparse.Namespace) -> int:
    """`verso submit`."""
    changes = [*([f"scenes={options.scenes}"] if options.scenes else []), *options.changes]
    job = load_job(options.job, changes)
    remedy = "a job of the queue runs on a cluster: write the whole path, from / on, as all its hosts see it"
    refuse_folders(job, name_of(options.job), lambda folder: folder.startswith("/") or "://" in folder, remedy)
    queue = make_queue(_place(options))
    request = JobRequest(
        id=new_id(),
        name=job.name,
        text=read_text(options.job),
        changes=tuple(changes),
        folder=str(options.job.parent.resolve()),
        out=_absolute(options.out or f"data/{job.name}"),
        scenes=job.scenes,
        retry_failed=options.retry_failed,
        priority=options.priority,
        submitted=time.time(),
    )
    while not queue.put_request(request):
        request = request.model_copy(update={"id": new_id()})
    print(request.id, flush=True)
    _say(
        f"job {request.id} ({job.name}, {plural(job.scenes, 'scene')}) waits in {queue.name}; its folder is {request.out}"
    )
    _say(_describe_supervisor(queue))
    return finish(options, True, id=request.id, name=job.name, out=request.out, queue=queue.name)


def jobs(options: argparse.Namespace) -> int:
    """`verso jobs`."""
    from services.queue.listing import format_rows, list_jobs

    queue = open_queue(_place(options))
    listed = list_jobs(queue)
    print("\n".join(format_rows(listed)) if listed else f"{queue.name} has no jobs")
    if any(job.state in ("queued", "waiting", "running", "cancelling") for job in listed):
        _say(_describe_supervisor(queue))
    return finish(options, True, queue=queue.name, jobs=[asdict(job) for job in listed])


def logs(options: argparse.Namespace) -> int:
    """`verso logs`."""
    from services.queue.listing import follow_logs, header, read_logs

    queue, drivers = open_queue(_place(options)), _drivers(options)
    view = queue.read(options.id)
    if options.follow:
        if not view.ended:
            _say(_describe_supervisor(queue))
        for part in follow_logs(queue, drivers, options.id, _say):
            print(part, end="", flush=True)
        view = queue.read(options.id)
        return finish(options, True, id=options.id, state=view.state, attempts=view.attempt)
    texts = read_logs(queue, drivers, view, _say)
    for attempt, text in texts.items():
        print(f"{header(attempt)}{text}", end="" if text.endswith("\n") else "\n")
    if not texts:
        _say(f"job {view.request.id} is {view.state}: nothing is known of what it wrote")
    known = bool(texts) or view.attempt == 0
    return finish(options, known, id=options.id, state=view.state, logs=texts)


def cancel(options: argparse.Namespace) -> int:
    """`verso cancel`."""
    queue = open_queue(_place(options))
    view = queue.append(options.id, "cancel") or queue.read(options.id)
    if view.state not in ("cancelling", "cancelled"):
        raise RunError(f"job {options.id} is {view.state}: there is nothing to cancel")
    if view.state == "cancelling":
        _say(f"job {options.id} runs: its supervisor stops it; what is committed in {view.request.out} is kept")
        _say(_describe_supervisor(queue))
    print(f"{options.id}: {view.state}")
    return finish(options, True, id=options.id, state=view.state)


def supervise(options: argparse.Namespace) -> int:
    """`verso supervise`."""
    from services.queue.drivers import answers, own_ray
    from services.queue.supervise import Rules, supervise

    queue = make_queue(_place(options))
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    rules, failed = Rules(options.at_once, _driver_command(options), options.until_empty), []
    on_own = options.address == rows.OWN_RAY or (options.address is None and not answers(rows.DASHBOARD))
    try:
        place = own_ray(queue.name, _say) if on_own else contextlib.nullcontext(_cluster_drivers(options))
        failed = supervise(queue, place, rules, _say)
        _say("the queue is empty" + (f"; failed: {', '.join(failed)}: `verso logs ID` says why" if failed else ""))
    except KeyboardInterrupt:
        then = "its jobs wait" if on_own else "jobs that run go on, the others wait"
        _say(f"supervision ends; {then} for the next `verso supervise`")
    return finish(options, not failed, queue=queue.name, failed=failed)


def drive(options: argparse.Namespace) -> int:
    """`verso drive`."""
    from services.queue.drivers import Ending, drive, sharing_of
    from services.run.run_job import RunRequest, run_job

    queue = open_queue(_place(options))

    def work(asked: JobRequest) -> "Ending":
        with tempfile.TemporaryDirectory(prefix="verso-job-") as folder:
            file = Path(folder) / "job.yaml"
            file.write_text(asked.text, encoding="utf-8")
            job = load_job(file, asked.changes)
        request = RunRequest(job, Path(asked.folder), asked.out, "auto", asked.retry_failed, sharing=sharing_of(queue))
        result = run_job(request)
        complete, answer = tell_result(asked.out, job, result)
        note = "" if complete else "scenes failed: `verso logs` says why"
        code = finish(options, complete, **answer)
        return Ending(code, note, sum(answer["scenes"].values()), answer["digest"])

    return drive(queue, options.id, options.attempt, work)


def _place(options: argparse.Namespace) -> str:
    """The queue that was asked for. Raises InputError where none is."""
    queue = options.queue or default_queue()
    if queue is None:
        raise InputError("which queue? name it by --queue URL or in the environment variable VERSO_QUEUE")
    return _absolute(str(queue))


def _drivers(options: argparse.Namespace) -> "Drivers":
    from services.queue.drivers import LogsHere, RayDrivers

    return LogsHere(rows.DASHBOARD) if options.address is None else RayDrivers(options.address)


def _cluster_drivers(options: argparse.Namespace) -> "Drivers":
    """Those of a cluster that answers. Raises MachineError, with one more remedy where no address was asked for."""
    drivers = _drivers(options)
    try:
        drivers.states()
    except MachineError as error:
        own = "; or give the queue a Ray of its own on this machine: --address own" if options.address is None else ""
        raise MachineError(f"{error}{own}") from error
    return drivers


def _driver_command(options: argparse.Namespace) -> list[str]:
    """The words that start Verso on the cluster's head."""
    if options.driver is not None:
        return [str(options.driver)]
    host = urllib.parse.urlsplit(options.address or rows.DASHBOARD).hostname
    if options.address == rows.OWN_RAY or host in ("127.0.0.1", "localhost", "::1"):
        return [sys.executable, "-P", "-m", "services.cli.main"]
    return ["verso"]


def _absolute(place: str) -> str:
    return place.rstrip("/") if "://" in place else str(Path(place).resolve())


def _describe_supervisor(queue: Queue) -> str:
    """Whether somebody looks after the queue, as far as can be told at once."""
    from services.run.lock import is_here, read_holder, shows_life

    holder = read_holder(queue.store)
    if holder is None or (is_here(holder) and not shows_life(queue.store, holder)):
        return f"no supervisor is running: `{command_line('supervise', '--queue', queue.name)}` starts the jobs"
    return f"supervised by process {holder.pid} on {holder.host}"


def _say(line: str) -> None:
    print(f"verso: {line}", file=sys.stderr, flush=True)
