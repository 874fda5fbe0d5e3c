"""A shard: ranges of scenes made one after another in one process, each committed while the next is made.

A commit computes little and waits long: for a disk to flush, or for an object store to take and copy archives. So it
runs in a thread of its own. One range at a time is committed, in order, and nothing else of a worker runs in two
threads.
"""

import contextlib
import faulthandler
import os
import socket
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from itertools import takewhile
from pathlib import PurePath
from typing import IO

import workers.assets.builtin.make  # noqa: F401  so that its loops are compiled with the others
from schemas.dataset.commit import Span, summarize
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE, LOG_FOLDER, staging_path
from schemas.dataset.shard import Blame, Fingerprint, JobChange, ShardOrder, ShardReport, SpanReport
from schemas.errors import FingerprintError, SceneError, VersoError
from schemas.job.captures import UNNAMED
from schemas.job.views import Tier
from schemas.scene.scene import SceneOutput
from workers.assets.catalogue import Catalogue
from workers.geometry.jit import compile_planned
from workers.render.raster.context import require_device
from workers.render.raster.gbuffer import Renderer
from workers.render.tiers import require_tier
from workers.scene.chance import SceneChance
from workers.scene.context import WorkerContext, open_worker
from workers.scene.draw.plan import choose_assets, choose_category
from workers.scene.make_scene import make_scene
from workers.scene.rows import failed_scene, record_scene, timing_row
from workers.shard.fingerprint import take_fingerprint
from workers.shard.framing import require_framed
from workers.stopwatch import Stopwatch
from workers.store.attempt import TIMED_OUT, Attempt, begin_attempt
from workers.store.local import open_store
from workers.store.store import Store


class LostScene(SceneError):
    """A scene that ended in an error nobody expected, or that its workers died in. `--retry-failed` makes it again."""

    stage = "worker"
    kind = "environmental"


def explain(error: Exception) -> LostScene:
    """The row of a scene that ended in this error."""
    if isinstance(error, MemoryError):
        message = "a worker had too little memory for this scene: use fewer workers, then run with --retry-failed"
        return LostScene("memory", f"{message} ({describe(error)})")
    return LostScene("bug", f"{describe(error)}: report this, then run with --retry-failed")


def describe(error: BaseException) -> str:
    """One line: the kind of error, its first line, and where in the code it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" at {PurePath(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    said = next(iter(str(error).splitlines()), "")[:200]
    return f"{type(error).__name__}{f': {said}' if said else ''}{where}"


def name_scene(context: WorkerContext, scene_id: int) -> str:
    """The scene with its category and the instances in it, as far as they can be drawn, or the capture and its folder."""
    drawn = ""
    if context.job.captures is not None:
        folders = context.job.captures.folders
        return f"capture {scene_id}{f' ({folders[scene_id]})' if scene_id < len(folders) else ''}"
    with contextlib.suppress(Exception):  # what failed may be the draw itself
        objects, table = choose_assets(context.job, context.catalogue, SceneChance(context.job.seed, scene_id))
        each = ", ".join(f"{ref.category} {ref.instance_id}" for ref in objects)
        drawn = f" ({each}, on table {table.instance_id})"
    return f"scene {scene_id}{drawn}"


def keep_traceback(store: Store, scene_id: int, error: BaseException) -> str:
    """Writes the traceback beside the logs; where it is, for the end of a sentence."""
    key = f"{LOG_FOLDER}/scene-{scene_id}.txt"
    try:
        store.put(key, "".join(traceback.format_exception(error)).encode(), durable=False)
    except Exception:  # a log must not end the scene's range
        return ""
    return f"; the traceback is in {store.name}/{key}"


def run_shard(order: ShardOrder, catalogue: Catalogue, is_over: Callable[[], bool] = lambda: False) -> ShardReport:
    """Make and commit every range of the order; once `is_over`, no further one is begun, and the report has fewer.

    A scene that cannot be made is a row; errors of the stack propagate. Raises InputError before it writes anything where
    the folder is new and no scene can be framed.
    """
    begun, cpu = time.perf_counter(), time.process_time()
    require_tier(order.job.drawn)
    compile_planned()
    context = open_worker(order.job, catalogue)
    note = require_device(context.renderer.name, order.job.run.device, context.renderer.choice)
    fingerprint = _fingerprint(context.renderer, order.job.drawn.tier)
    store = open_store(order.out)
    if order.job_change is not None and store.size(JOB_FILE) is None:
        require_framed(order.job, catalogue)  # with loops that are compiled, which processes share among them
        store.put(JOB_FILE, order.job_change.after.encode())
    _join_stack(store, fingerprint, order)
    order = order.model_copy(update={"terms": order.terms.model_copy(update={"fingerprint": fingerprint.digest})})
    total = Stopwatch()
    reports = run_ranges(context, store, order, takewhile(lambda span: not is_over(), order.spans), total)
    return ShardReport(
        spans=reports,
        seconds=total.seconds,
        wall_s=time.perf_counter() - begun,
        cpu_s=time.process_time() - cpu,
        fingerprint=fingerprint,
        host=socket.gethostname(),
        pid=os.getpid(),
        note=note,
    )


def run_ranges(
    context: WorkerContext, store: Store, order: ShardOrder, spans: Iterable[Span], total: Stopwatch
) -> tuple[SpanReport, ...]:
    """Make these ranges and commit each while the next is made; `total` gets the time that is waited for commits.

    A range that cannot be committed raises once the next is made, which then is not committed either. No commit is under
    way afterwards, also where this raises.
    """
    commits: list[Future[SpanReport]] = []
    with ThreadPoolExecutor(1, "commit") as thread:
        for span in spans:
            commit = _make_range(context, store, order, span, total)
            with total.stage("commit"):
                for before in commits[-1:]:
                    before.result()
            commits.append(thread.submit(commit))
        with total.stage("commit"):
            return tuple(commit.result() for commit in commits)


def _make_range(
    context: WorkerContext, store: Store, order: ShardOrder, span: Span, total: Stopwatch
) -> Callable[[], SpanReport]:
    """The commit of one range, which is written. A scene that ends in an error nobody expected is a row too, and is reported."""
    blamed = {blame.scene_id: blame for blame in order.blamed}
    attempt = begin_attempt(store, span, order.terms, order.label)
    failed: Counter[str] = Counter()
    bugs: list[str] = []
    with _traceback_file(store, attempt) as tracebacks:
        for scene_id in span.scene_ids:
            try:
                output = _attempt_scene(context, attempt, scene_id, tracebacks, total, blamed.get(scene_id))
            except LostScene as error:
                where = keep_traceback(store, scene_id, error.__cause__ or error)
                bugs.append(f"{name_scene(context, scene_id)}: {error.detail}{where}")
                output = failed_scene(scene_id, _category(context, scene_id), error)
                attempt.add_scene(output)
            failed.update(f"{row['kind']}: {row['reason']}" for row in output.rows.get("failures", ()))
    attempt.end_scenes()
    return partial(_commit, attempt, order.job_change, dict(failed), tuple(bugs))


def _commit(
    attempt: Attempt, job_change: JobChange | None, failed: dict[str, int], bugs: tuple[str, ...]
) -> SpanReport:
    """Commit a range with its failures by `kind: reason`. Raises as `Attempt.commit`."""
    result, span = attempt.commit(job_change), attempt.span
    return SpanReport(
        start=span.start,
        stop=span.stop,
        retry=span.retry,
        won=result.won,
        conflict=result.conflict,
        made=len(span.scene_ids) - sum(failed.values()),
        failed=failed,
        bugs=bugs,
        commit=summarize(result.record),
    )


def _attempt_scene(
    context: WorkerContext,
    attempt: Attempt,
    scene_id: int,
    tracebacks: IO[str],
    total: Stopwatch,
    blame: Blame | None,
) -> SceneOutput:
    """One scene, made or refused, and written. Raises LostScene; then nothing of it is written."""
    if blame is not None:  # not begun, so that no worker dies in it
        category = _category(context, scene_id)
        output = failed_scene(scene_id, category, LostScene(blame.reason, blame.detail), blame.attempts)
        attempt.add_scene(output)
        return output
    attempt.begin_scene(scene_id)
    try:
        with _time_limit(context.job.run.scene_timeout_s, tracebacks):
            output = run_scene(context, scene_id, total)
    except VersoError:
        raise
    except Exception as error:
        raise explain(error) from error
    try:
        with total.stage("write"):
            attempt.add_scene(output)
    except (ValueError, TypeError, KeyError) as error:  # checked before the first byte is written
        raise explain(error) from error
    return output


def run_scene(context: WorkerContext, scene_id: int, total: Stopwatch) -> SceneOutput:
    """One scene, or one capture: made, or a row that says why not."""
    stopwatch = Stopwatch()
    try:
        output = _make_output(context, scene_id, stopwatch)
        category = str(output.rows["scenes"][0]["category"])
    except SceneError as error:
        category = _category(context, scene_id)
        output = failed_scene(scene_id, category, error)
    total.add(stopwatch)
    return replace(output, rows={**output.rows, "timings": [timing_row(scene_id, category, stopwatch)]})


def _make_output(context: WorkerContext, scene_id: int, stopwatch: Stopwatch) -> SceneOutput:
    if context.job.captures is None:
        return record_scene(context, make_scene(context, scene_id, stopwatch), stopwatch)
    from workers.capture.make_capture import run_capture  # loads what scenes have no use for

    return run_capture(context, scene_id, stopwatch)


def _category(context: WorkerContext, scene_id: int) -> str:
    """The category of a scene before it is made; a capture in a folder may turn out to have another."""
    captures = context.job.captures
    if captures is not None and captures.folders:
        return UNNAMED
    chance = SceneChance(context.job.seed, scene_id)
    if context.catalogue.scenes is None:
        return choose_category(context.job, chance)
    try:
        return choose_assets(context.job, context.catalogue, chance)[0][0].category
    except SceneError:
        return UNNAMED


@lru_cache(maxsize=1)  # a process has one job and, at a time, one renderer
def _fingerprint(renderer: Renderer, tier: Tier) -> Fingerprint:
    return take_fingerprint(renderer, tier)


def _join_stack(store: Store, mine: Fingerprint, order: ShardOrder) -> None:
    """The first worker of a dataset writes its fingerprint down; every other must have the same, if the job is strict.

    `order.terms.fingerprint` is the digest that the commits have, or on a cluster the driver: it holds without the file too.
    """
    wanted = order.terms.fingerprint
    if wanted not in ("", mine.digest):
        theirs = _written_down(store)
        raise _foreign(mine, theirs if theirs and theirs.digest == wanted else None, wanted)
    if store.size(FINGERPRINT_FILE) is None:
        store.put_if_absent(FINGERPRINT_FILE, mine.model_dump_json(indent=1).encode())
    elif wanted and mine != _written_down(store):
        store.put(FINGERPRINT_FILE, mine.model_dump_json(indent=1).encode())  # it was damaged, or another's
    theirs = Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE))
    if order.terms.fingerprint_mode == "strict" and mine != theirs:
        raise _foreign(mine, theirs, theirs.digest)


def _foreign(mine: Fingerprint, theirs: Fingerprint | None, digest: str) -> FingerprintError:
    """The error for a stack that is not the dataset's, which has this `digest`; `theirs` is None where it is not known."""
    message = f": {'; '.join(mine.differences(theirs))}" if theirs else ""
    remedy = mine.remedies(theirs) if theirs else "use the same stack (the image is one)"
    return FingerprintError(
        f"the stack on {socket.gethostname()} has fingerprint {mine.digest[:12]}, the dataset's is {digest[:12]}{message}. To "
        f"go on, {remedy}; or set run.fingerprint: record"
    )


def _written_down(store: Store) -> Fingerprint | None:
    try:
        return Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE))
    except (FileNotFoundError, ValueError):
        return None


@contextmanager
def _traceback_file(store: Store, attempt: Attempt) -> Iterator[IO[str]]:
    """The file for a hung worker's traceback, in the attempt's folder, where the coordinator looks."""
    if store.root is None or attempt.fenced:
        yield sys.stderr
        return
    path = store.root / staging_path(attempt.span.start, attempt.name) / TIMED_OUT
    with open(path, "w", encoding="utf-8") as file:
        yield file


@contextmanager
def _time_limit(seconds: float, tracebacks: IO[str]) -> Iterator[None]:
    """Kills this process if the block takes longer.

    PyBullet and GL hold the interpreter's lock while they work: only a watchdog in C can end a worker that hangs there.
    """
    faulthandler.dump_traceback_later(seconds, exit=True, file=tracebacks)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
