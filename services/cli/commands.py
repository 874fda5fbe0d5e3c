"""Handlers of the commands: each takes the parsed options, prints, and returns the exit code."""

import argparse
import dataclasses
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from schemas.dataset.layout import COMMITS
from schemas.errors import InputError, RunError, VersoError, command_line, needs_making, plural
from schemas.job.job import Job
from services.cli.environment import host_place
from services.job.job_file import load_job, pack_job
from services.job.record import read_job, require_dataset, require_job
from services.read.verdict import explain_damage
from services.run.progress import ProgressLine, finish
from workers.store.local import open_store
from workers.store.store import Store

if TYPE_CHECKING:
    from services.run.run_job import RunResult


def extra(options: argparse.Namespace) -> int:
    """`verso extra`. Raises InputError: the launcher has done it before, or there is none."""
    raise InputError(
        f"extra {options.name} is installed by `./verso` in a checkout; elsewhere: pip install 'verso-data[{options.name}]'"
    )


def checkout(options: argparse.Namespace) -> int:
    """`verso test` and `verso lock`. Raises InputError: only the launcher of a checkout does them, before it starts Python."""
    raise InputError(f"{options.command} is a command of a checkout's launcher: type ./{options.command} there")


def wheels(options: argparse.Namespace) -> int:
    """`verso wheels`. Raises InputError where this is no checkout."""
    script = Path(__file__).parents[2] / "deploy/wheels.py"
    if not script.exists():
        raise InputError("wheels builds those of a checkout: type ./verso wheels DIR there")
    return subprocess.run([sys.executable, "-P", str(script), str(options.dir)]).returncode


Found = TypeVar("Found")


def run(options: argparse.Namespace) -> int:
    """`verso run`."""
    named = {"scenes": options.scenes, "first_scene": options.first_scene}
    named |= {"run.workers": options.workers, "run.shard_size": options.shard_size}
    changes = [f"{key}={value}" for key, value in named.items() if value is not None]
    job = load_job(options.job, [*changes, *options.changes])
    from services.run.run_job import (  # takes seconds: a job file that is wrong is told before
        RunRequest,
        describe_plan,
        run_job,
    )

    out = options.out or f"data/{job.name}"
    absolute = out if "://" in out else str(Path(out).resolve())
    request = RunRequest(job, options.job.parent, absolute, options.address, options.retry_failed, options.metrics)
    if options.dry_run:
        print("\n".join(describe_plan(request)))
        return 0
    result = run_job(request)
    complete, answer = tell_result(out, job, result)
    return finish(options, complete, **answer)


def tell_result(out: str, job: Job, result: "RunResult") -> tuple[bool, dict[str, Any]]:
    """Prints what a run made, where, and what to do next; whether it is complete, and the answer for programs."""
    merged = result.merged
    made, failed = merged.scenes["made"], merged.scenes["intrinsic"] + merged.scenes["environmental"]
    share = failed / job.scenes
    complete = merged.complete and share <= job.run.max_failure_share
    rate = f", {result.made_now / result.seconds:.1f} scenes/s" if result.made_now else ""
    print(
        f"{plural(result.made_now, 'scene')} made now, {made} in all, {failed} failed, in {result.seconds:.1f} s{rate}"
    )
    print(f"{out}{host_place(out)}: dataset digest {merged.digest}")
    question = "select category, count(*) from scenes group by category"
    print(f"next: {command_line('report', out)} · {command_line('query', out, question)}")
    if again := merged.scenes["environmental"]:
        why = f"{plural(again, 'scene')} failed for environmental reasons: try again with --retry-failed"
        print(f"verso: {why}", file=sys.stderr)
    elif not complete:
        why = f"{share:.1%} of the scenes failed, run.max_failure_share is {job.run.max_failure_share:.1%}"
        asks = command_line("query", out, "select reason, count(*) from failures group by reason")
        print(f"verso: {why}: `{asks}` says why", file=sys.stderr)
    return complete, {"out": out, "digest": merged.digest, "scenes": merged.scenes, "seconds": result.seconds}


def pack(options: argparse.Namespace) -> int:
    """`verso pack`."""
    packed = pack_job(options.job)
    print(packed)
    return finish(options, True, job=packed)


def status(options: argparse.Namespace) -> int:
    """`verso status`."""
    from services.read.status import read_status
    from services.run.lock import shows_life

    store = _dataset(options.out)
    with explain_damage(store):
        job = require_job(store).job
        now = read_status(store, job.first_scene, job.stop_scene)
    done = now.made + sum(now.failed.values())
    print(f"{options.out}: {done} of {plural(now.asked, 'scene')} done, {now.missing} missing")
    for reason, count in sorted(now.failed.items()):
        print(f"  failed, {reason}: {count}")
    if now.scenes_per_s:
        print(f"  rate: {now.scenes_per_s:.2f} scenes/s")
    lives = now.holder is not None and shows_life(store, now.holder)
    for attempt in now.running:
        doing = "no scene in progress" if attempt.scene_id is None else f"scene {attempt.scene_id}"
        print(f"  {'running' if lives else 'was running'}: range from {attempt.start}, {doing} ({attempt.attempt})")
    if now.holder is not None:
        gone = "" if lives else ", which is gone: start the run again, what is committed is kept"
        print(f"  held by process {now.holder.pid} on {now.holder.host}{gone}")
    for line in now.lost:
        print(f"  {line}")
    print(f"  digest: {now.digest}" if now.digest else "  not merged: run the job again to finish it")
    whole = now.digest is not None and not now.missing and not now.lost
    return finish(options, whole, lives=lives, **dataclasses.asdict(now))


def verify(options: argparse.Namespace) -> int:
    """`verso verify`."""
    from services.read.verify import verify as read_back

    store = open_store(options.out)
    deep = _deep_checks() if options.independent or options.audit else ()  # before hours of reading
    if next(iter(store.files(COMMITS)), None) is None:  # it may have lost its job.yaml
        require_dataset(store)
    scenes = 0
    with suppress(VersoError):  # of a damaged job.yaml, which is told below
        scenes = record.job.scenes if (record := read_job(store)) else 0
    verdict = _with_progress(scenes, "verify", partial(read_back, store))
    for line in (*verdict.faults, *([f"and {verdict.untold} more"] if verdict.untold else [])):
        print(line)
    off = len(verdict.faults) + verdict.untold
    read = f"{plural(verdict.files, 'file')} ({verdict.bytes / 1e6:.1f} MB), {plural(verdict.scenes, 'scene')}"
    print(f"{options.out}: {read}, labels of {plural(verdict.pairs, 'pair')} derived again: {off or 'nothing'} off")
    if verdict.not_derived:
        print(f"files and tables alone were checked: {verdict.not_derived}")
    answer, faults = dataclasses.asdict(verdict), list(verdict.faults)
    for name, check, describe in deep:
        if count := getattr(options, name):
            try:
                with explain_damage(store):
                    report = _with_progress(count, name, partial(check, store, count))
            except RunError as error:
                if not faults:
                    raise
                print(f"--{name} {count} was not possible: {error}")
                continue
            print("\n".join(describe(report)))
            faults += report.faults
            answer[name] = dataclasses.asdict(report)
    return finish(options, not faults, **answer)


def _deep_checks() -> tuple[tuple[str, Callable, Callable], ...]:
    """(option, what it does, how that is told)."""
    with needs_making("verify --independent or --audit"):
        from services.read.audit import audit, describe_audit, describe_independent, verify_independently
    return (
        ("independent", verify_independently, describe_independent),
        ("audit", audit, describe_audit),
    )


def _with_progress(scenes: int, what: str, work: Callable[[Callable[[Any], None]], Found]) -> Found:
    """The result of `work`, which reports how many scenes are done and what is off as it goes."""
    with closing(ProgressLine(scenes, what)) as line:
        return work(lambda now: line.show(now.scenes, len(now.faults)))


def query(options: argparse.Namespace) -> int:
    """`verso query`."""
    from services.read.query import ask, write_rows

    with ask(_dataset(options.out), options.sql) as rows:
        wide = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        write_rows(rows, "json" if options.json else options.format, sys.stdout.buffer, wide)
    sys.stdout.flush()
    return 0


def columns(options: argparse.Namespace) -> int:
    """`verso columns`."""
    from services.read.columns_page import describe_columns, list_columns

    if not options.json:
        print("\n".join(describe_columns(options.table)))
    return finish(options, True, columns=list_columns(options.table))


def replay(options: argparse.Namespace) -> int:
    """`verso replay`."""
    from services.read.replay import replay_scene

    scene_id, store = options.scene, _dataset(options.out)
    with explain_damage(store):
        result = replay_scene(store, scene_id)
    for difference in result.differences:
        print(difference)
    how = "to the byte" if result.same_stack else "within tolerances, because this stack is not the one that made it"
    differ = f"{len(result.differences) or 'none'} differ"
    print(f"scene {scene_id}: {result.compared} files and tables compared {how}: {differ}")
    return finish(options, not result.differences, **dataclasses.asdict(result))


def _dataset(out: str) -> Store:
    """The store of an output folder. Raises OutputError where it is none."""
    return require_dataset(open_store(out))


def report(options: argparse.Namespace) -> int:
    """`verso report`."""
    from services.look.report import write_report

    began = time.monotonic()
    store = open_store(options.out)
    target = options.file or default_page(options.out)
    with explain_damage(store):
        size, made = write_report(store, options.scenes, target)
    seconds = time.monotonic() - began
    print(f"{target}: {plural(made.figures.scenes, 'scene')}, pictures of {len(made.scenes)}, {size / 1e6:.1f} MB")
    answer = {"file": str(target), "bytes": size, "seconds": round(seconds, 2), "scenes": made.figures.scenes}
    return finish(options, True, **answer, shown=[scene.scene_id for scene in made.scenes])


def serve(options: argparse.Namespace) -> int:
    """`verso serve`."""
    from services.look.live import Follower
    from services.look.server import choose_place, ended_by_signal, serving

    place = choose_place(options.host, options.port, options.token)
    follower = Follower(open_store(options.out), options.scenes)
    with ended_by_signal() as ended, serving(follower, place) as opened:
        print(f"{options.out}: {opened.address} (Ctrl-C ends it)", flush=True)
        finish(options, True, address=opened.address, port=opened.port, token=opened.token)
        sys.stdout.flush()
        follower.start()
        try:
            ended.wait()
        finally:
            follower.stop()
    return 0


def default_page(out: str) -> Path:
    """The page of a dataset: beside its folder, or here for a bucket's."""
    name = out.rstrip("/").rpartition("/")[2] or "dataset"
    return Path(f"{name}-report.html") if "://" in out else Path(out).resolve().with_name(f"{name}-report.html")
