"""The coordinator: gives shards to Ray, a limited number at a time, reads every report and counts attempts and deaths.

Ray tells at once of a worker whose connection was reset. Of one behind a network that was cut it says nothing until TCP
gives up, a quarter of an hour later, although it counts the node as dead after one minute: so lost nodes are looked for here.
"""

import logging
import pickle
import signal
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import ray
from ray.exceptions import NodeDiedError, OutOfMemoryError, RayError, RayTaskError

from schemas.dataset.commit import Span
from schemas.dataset.layout import commit_path, staging_path
from schemas.dataset.shard import Blame, Reason, ShardReport
from schemas.errors import CommitConflict, RunError, VersoError, command_line
from services.run.machine import Process, send
from services.run.progress import Tally, log_event, say
from services.run.ray_cluster import LOOK_EVERY_S, Slots, alive_nodes, on_node
from services.run.watchdog import AttemptName, Sight, end_worker_here, find_own_workers, scenes_in_progress, watch
from services.run.worker_entry import Pattern, enter_shard
from workers.store.attempt import TIMED_OUT, attempts_at, blamed_scene, host_part, retry_of_attempt, sweep_attempt
from workers.store.commit import read_record
from workers.store.ledger import read_summary
from workers.store.store import Store

NODE_PATIENCE = 5
"""A node that is lost is seldom the scene's fault: so many times more of them than of other deaths are borne."""

EXPLANATIONS: dict[Reason, str] = {
    "time": "the scene took longer than run.scene_timeout_s: raise it, then run with --retry-failed",
    "memory": "the worker ran out of memory each time: use fewer workers, then run with --retry-failed",
    "killed": "the worker was killed or crashed in this scene each time: see OUT/_logs, then run with --retry-failed",
}
"""The stored detail of an environmental failure."""


class Deaths:
    """The deaths of a run's workers, by the scene that they died in, or by the range where they had begun none."""

    def __init__(self, attempts: int) -> None:
        self._attempts = attempts
        self._counts: Counter[tuple[bool, str, int]] = Counter()
        self._blamed: dict[int, Blame] = {}

    def count(
        self,
        start: int,
        scene: int | None,
        reason: Reason,
        message: str,
        with_node: bool = False,
        timed_out: bool = False,
    ) -> None:
        """Counts a death with the range from `start`, in `scene` if it had begun one; `with_node`: its whole node was lost.

        Blames the scene after too many, and at once where the worker computed until its time was up (`timed_out`): it would
        compute the same again. Raises RunError where workers die before they begin one.
        """
        place = (with_node, "range", start) if scene is None else (with_node, "scene", scene)
        self._counts[place] += 1
        deaths = self._counts[place]
        if not (timed_out and scene is not None) and deaths < self._attempts * (NODE_PATIENCE if with_node else 1):
            return
        if scene is None:
            raise RunError(
                f"the worker for the scenes from {start} died {deaths} times before it began one or while it committed "
                f"({reason}: {message}): see `verso doctor`"
            )
        self._blamed[scene] = Blame(scene_id=scene, reason=reason, detail=EXPLANATIONS[reason], attempts=deaths)

    def blamed_in(self, spans: Iterable[Span]) -> tuple[Blame, ...]:
        """Scenes of these ranges that are not to be tried again."""
        return tuple(self._blamed[scene] for span in spans for scene in span.scene_ids if scene in self._blamed)


def count_under_way(shards: Iterable[tuple[Span, ...]], in_progress: Mapping[int, int | None]) -> int:
    """How many scenes of these shards are made: ranges before the last one in progress, and scenes before the one in progress.

    in_progress: the scene that a worker makes now by the start of its range; None between scenes, which counts as none of it. A
    range whose commit is under way is there too, while the next one is made.
    """
    total = 0
    for spans in shards:
        made = before = 0
        for span in spans:
            if span.start in in_progress:
                scene_id, ids = in_progress[span.start], span.scene_ids
                made = before + (ids.index(scene_id) if scene_id is not None and scene_id in ids else 0)
            before += span.count
        total += made
    return total


def hosts_of(store: Store, label: str, spans: Iterable[Span]) -> set[str]:
    """The hosts whose workers have begun these ranges, by what they left: attempts with this label, and commits by them."""
    names = []
    for span in spans:
        names += [(span.start, name) for name in attempts_at(store, span.start)]
        record = read_record(store, span.start, span.retry)
        names += [(span.start, record.attempt)] if record is not None else []
    return {AttemptName(start, name).host for start, name in names if label in name}


POLL_S = 0.5
"""Time of one wait for reports: Ctrl-C is seen at least this often."""

MOST_LOOKED_AT = 32
"""Shards in flight up to which the notes of their workers are read after every wait. Of more, reports come often enough."""


@dataclass(frozen=True)
class Limits:
    """The shards given to Ray at once, at most `attempts` at a range, and at most `failures` failed scenes.

    `num_gpus` is the part of a GPU that each shard asks Ray for; 0: none.
    """

    slots: Slots
    attempts: int
    failures: int
    num_gpus: float = 0.0


_end_worker = ray.remote(num_cpus=0, max_retries=0)(end_worker_here)


def _shard_task(env_vars: Mapping[str, str], num_gpus: float) -> Any:
    """The task that makes a shard, as Ray's remote function; a new one asks for workers of its own."""
    # Ray would end a process after each task with a GPU, unless max_calls is given
    on_gpu: dict[str, Any] = {"num_gpus": num_gpus, "max_calls": 0} if num_gpus else {}
    task = ray.remote(num_cpus=1, max_retries=0, **on_gpu)(enter_shard)
    return task.options(runtime_env={"env_vars": dict(env_vars)}) if env_vars else task


class Coordinator:
    """The state of a run: the shards that run, those to run again, and how often workers died."""

    def __init__(self, store: Store, pattern: Pattern, limits: Limits, tally: Tally) -> None:
        self._store = store
        self._order = pattern.order.model_copy(update={"label": uuid.uuid4().hex[:8]})
        self._terms = pattern.terms
        self._catalogue = ray.put(pickle.dumps(pattern.catalogue))
        self._env_vars = pattern.env_vars
        self._task = _shard_task(self._env_vars, limits.num_gpus)
        self._limits = limits
        self._tally = tally
        self._again: deque[tuple[Span, ...]] = deque()
        self._running: dict[ray.ObjectRef, tuple[Span, ...]] = {}
        self._stalled: set[ray.ObjectRef] = set()
        """Shards whose workers the watchdog ended."""
        self._notes: set[str] = set()
        """What workers said of their devices."""
        self._deaths = Deaths(limits.attempts)
        self._hosts: set[str] = set()
        self._looked_s = float("-inf")

    def run(self, shards: Iterator[tuple[Span, ...]], progress: Callable[[Tally], None] = lambda tally: None) -> None:
        """Makes every range of every shard.

        Raises CommitConflict where two attempts made other bytes, RunError where a worker cannot be kept alive or too
        many scenes fail. On KeyboardInterrupt, committed ranges stay and running shards are ended.
        """
        with watch(self._store, self._order.label, self._order.job.run.scene_timeout_s) as take_stalls:
            try:
                while self._fill_slots(shards):
                    ready, _ = ray.wait(list(self._running), num_returns=1, timeout=POLL_S)
                    for ref in ready:
                        self._collect(ref, self._running.pop(ref))
                    for attempt, sight in take_stalls():
                        self._end_stalled(attempt, sight)
                    self._tally.in_flight = sum(len(spans) for spans in self._running.values())
                    self._tally.under_way = self._count_under_way()
                    if self._env_vars and (lost := self._take_lost_hosts()):
                        self._give_up_on(lost)
                    progress(self._tally)
            finally:  # what still runs after an error is made again by the next run
                for ref in self._running:
                    ray.cancel(ref, force=True)
                if self._running:
                    ray.wait(list(self._running), num_returns=len(self._running), timeout=5.0)

    def _count_under_way(self) -> int:
        """Scenes made in shards that have not reported; 0 where a look costs much: on an object store, or of many shards."""
        if self._store.at_once > 1 or len(self._running) > MOST_LOOKED_AT:
            return 0
        scenes = scenes_in_progress(self._store, self._order.label)
        return count_under_way(self._running.values(), {attempt.start: scene for attempt, scene in scenes.items()})

    def _fill_slots(self, shards: Iterator[tuple[Span, ...]]) -> bool:
        """Gives shards to Ray while there is room; False where nothing is left to wait for."""
        room = self._limits.slots.now().in_flight
        while len(self._running) < room:
            spans = self._again.popleft() if self._again else next(shards, None)
            if spans is None:
                break
            order = self._order.model_copy(update={"spans": spans, "blamed": self._deaths.blamed_in(spans)})
            self._running[self._task.remote(self._terms, pickle.dumps(order), self._catalogue)] = spans
        return bool(self._running)

    def _collect(self, ref: "ray.ObjectRef", spans: tuple[Span, ...]) -> None:
        try:
            report: ShardReport = ray.get(ref)
        except RayTaskError as error:
            if isinstance(error.cause, VersoError):
                raise error.cause from error
            log_event("bug", logging.ERROR, range=spans[0].start, traceback=str(error))
            line = next(iter(str(error.cause).splitlines()), "")
            raise RunError(
                f"a worker raised an error that is a bug, with the scenes from {spans[0].start}: "
                f"{type(error.cause).__name__}: {line}; what is committed is kept, {self._store.name}/_logs has the traceback"
            ) from error
        except RayError as error:
            return self._handle_death(spans, error, ref in self._stalled)
        finally:
            self._stalled.discard(ref)
        self._tally.add(report)
        if report.note and report.note not in self._notes:
            self._notes.add(report.note)
            say(report.note)
        for span in report.spans:
            log_event("range committed", range=span.start, **span.model_dump(include={"stop", "won", "made", "failed"}))
            for bug in span.bugs:
                log_event("bug", logging.ERROR, range=span.start, error=bug)
                say(bug)
        if left := spans[len(report.spans) :]:
            log_event("worker drained", range=left[0].start, host=report.host)
            self._again.append(left)
        if self._tally.conflicts:
            raise CommitConflict(self._tally.conflicts[0])
        if self._tally.failed.total() > self._limits.failures:
            reasons = ", ".join(f"{count} x {reason}" for reason, count in self._tally.failed.most_common(3))
            raise RunError(
                f"{self._tally.failed.total()} of {self._tally.asked} scenes have failed ({reasons}), which is more than "
                f"run.max_failure_share allows: see `{command_line('query', self._store.name, 'select * from failures')}`"
            )

    def _take_lost_hosts(self) -> set[str]:
        """The hosts that had a node at the last look, and have none now; none where that look was just now."""
        if time.monotonic() - self._looked_s < LOOK_EVERY_S:
            return set()
        self._looked_s = time.monotonic()
        before, self._hosts = self._hosts, set(_hosts_by_node().values())
        return before - self._hosts

    def _give_up_on(self, hosts: set[str]) -> None:
        """Gives out again what workers on lost hosts had, and what no worker has begun: Ray may have sent it there."""
        log_event("nodes lost", logging.WARNING, hosts=sorted(hosts))
        say(f"lost {', '.join(sorted(hosts))}: what was in progress there is made again elsewhere")
        # A task shares its requests for workers, and some of these wait for lost hosts.
        self._task = _shard_task(self._env_vars, self._limits.num_gpus)
        for ref, spans in list(self._running.items()):
            had = hosts_of(self._store, self._order.label, spans)
            if had and not had <= hosts:
                continue
            del self._running[ref]
            ray.cancel(ref, force=True)
            if had:
                self._handle_death(spans, NodeDiedError(f"{', '.join(sorted(had))} is not in the cluster any more"))
            else:
                self._again.append(spans)

    def _end_stalled(self, attempt: AttemptName | None, sight: Sight) -> None:
        """Says that a worker shows no progress, and ends it: what follows is the same as after any other death."""
        workers = {process.pid: process for process in find_own_workers()}
        if attempt is None:
            return self._end_stopped(sight.idle_s, [worker for worker in workers.values() if worker.stopped])
        key = attempt.start, retry_of_attempt(attempt.name)
        refs = {ref for ref, spans in self._running.items() if key in [(span.start, span.retry) for span in spans]}
        if not refs:
            return
        self._stalled |= refs
        start, pid, host = attempt.start, attempt.pid, attempt.host
        log_event("worker stalled", logging.WARNING, range=start, scene=sight.scene_id, pid=pid, host=host)
        doing = "committing" if sight.scene_id is None else f"scene {sight.scene_id}"
        stopped = ", which was stopped by a signal" if pid in workers and workers[pid].stopped else ""
        say(
            f"range from {start}, {doing}: no progress for {sight.idle_s:.0f} s by process {pid} on {host}{stopped}: "
            "it is ended, and the range is made again"
        )
        if pid in workers:
            return send(workers[pid], signal.SIGKILL)
        for node, node_host in _hosts_by_node().items():
            if node_host == host:
                on_node(_end_worker, node).remote(pid)

    def _end_stopped(self, idle_s: float, stopped: list[Process]) -> None:
        """Says that no worker has begun a range for a long time, and ends those that were stopped by a signal."""
        pids = ", ".join(str(process.pid) for process in stopped)
        log_event("nothing begun", logging.WARNING, seconds=round(idle_s), stopped=pids)
        why = (
            f"process {pids} was stopped by a signal and is ended" if pids else "Ray has started none: see `ray status`"
        )
        say(f"no worker has begun a range for {idle_s:.0f} s: {why}")
        for process in stopped:
            send(process, signal.SIGKILL)

    def _handle_death(self, spans: tuple[Span, ...], error: RayError, stalled: bool = False) -> None:
        """Counts the ranges that a dead worker committed, then gives out the others again, one by one.

        Raises RunError where workers die before they begin a scene.
        """
        left = deque(spans)
        while left and self._store.size(commit_path(left[0].start, left[0].retry)) is not None:
            span = left.popleft()
            summary = read_summary(self._store, span.start, span.retry)
            self._tally.made += summary.made
            self._tally.failed.update(kind for _, kind, _ in summary.failed)
            self._tally.add_commit(summary)
        if not left:
            return
        span, scene, timed_out = self._find_evidence(left)
        reason: Reason = (
            "time" if timed_out or stalled else "memory" if isinstance(error, OutOfMemoryError) else "killed"
        )
        message = " ".join(str(error).split())[:300]
        log_event("worker lost", logging.WARNING, range=span.start, scene=scene, reason=reason, error=message)
        self._tally.lost[reason] += 1
        self._deaths.count(span.start, scene, reason, message, isinstance(error, NodeDiedError), timed_out)
        self._again.extend((span,) for span in left)

    def _find_evidence(self, left: Sequence[Span]) -> tuple[Span, int | None, bool]:
        """The range and the scene in progress when a worker of this run was lost, and whether its time was up.

        A worker has two attempts at most: one that it makes, and the one before, whose commit may be under way. Where no scene
        was in progress, the first of the ranges is named. The worker may live, behind a network that failed or while it is
        paused. So its attempts are given up: each is fenced and its record looked for once more before its files go; one that
        has won meanwhile is published.
        """
        evidence: tuple[Span, int | None, bool] = left[0], None, False
        for span in left:
            for name in attempts_at(self._store, span.start):
                if self._order.label not in name:
                    continue
                scene = blamed_scene(self._store, span.start, name)
                timed_out = bool(self._store.size(f"{staging_path(span.start, name)}/{TIMED_OUT}"))
                sweep_attempt(self._store, span.start, name, given_up=True)
                if scene is not None and evidence[1] is None:
                    evidence = span, scene, timed_out
        return evidence


def _hosts_by_node() -> dict[str, str]:
    """The host, as attempts are named, of each of the cluster's nodes, by its id."""
    return {node["NodeID"]: host_part(node["NodeManagerHostname"]) for node in alive_nodes()}
