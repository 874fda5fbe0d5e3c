"""The coordinator: gives shards to Ray, a limited number at a time, reads every report and counts the attempts."""

import logging
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import ray
from ray.exceptions import OutOfMemoryError, RayError, RayTaskError

from schemas.dataset.commit import CommitSummary, Span
from schemas.dataset.layout import commit_path, staging_path
from schemas.dataset.shard import Blame, Reason, ShardOrder, ShardReport
from schemas.errors import CommitConflict, RunError, VersoError
from services.run.progress import log_event
from workers.assets.catalogue import Catalogue
from workers.pipeline.run_shard import TIMED_OUT, run_shard
from workers.store.attempt import attempts_at, blamed_scene
from workers.store.ledger import read_summary
from workers.store.store import Store

POLL_S = 0.5
"""Time of one wait for reports: Ctrl-C is seen at least this often."""

EXPLANATIONS: dict[Reason, str] = {
    "time": "the scene took longer than run.scene_timeout_s each time: raise it, then run with --retry-failed",
    "memory": "the worker ran out of memory each time: use fewer workers, then run with --retry-failed",
    "killed": "the worker was killed or crashed in this scene each time: see OUT/_logs, then run with --retry-failed",
}
"""The stored detail of an environmental failure."""


@dataclass
class Tally:
    """The results of a run so far; changed by the coordinator alone."""

    asked: int
    made: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    conflicts: list[str] = field(default_factory=list)
    commits: list[CommitSummary] = field(default_factory=list)
    """Those of this run that nobody has taken yet."""
    shard_wall_s: float = 0.0
    shard_cpu_s: float = 0.0

    @property
    def done(self) -> int:
        """Scenes made or failed."""
        return self.made + self.failed.total()

    def add(self, report: ShardReport) -> None:
        """Counts one shard's report."""
        self.shard_wall_s += report.wall_s
        self.shard_cpu_s += report.cpu_s
        for span in report.spans:
            if span.conflict:
                self.conflicts.append(span.conflict)
            self.made += span.made
            self.failed.update(span.failed)
            self.commits += [span.commit] if span.commit else []

    def take_commits(self) -> list[CommitSummary]:
        """The commits since the last call."""
        commits, self.commits = self.commits, []
        return commits


@dataclass(frozen=True)
class Limits:
    """At most `in_flight` shards given to Ray at once, `attempts` at a range, and `failures` failed scenes."""

    in_flight: int
    attempts: int
    failures: int


_run_shard = ray.remote(num_cpus=1, max_retries=0)(run_shard)


class Coordinator:
    """The state of a run: the shards that run, those to run again, and how often workers died.

    `order` is the pattern of every shard's order, `catalogue` that of its assets.
    """

    def __init__(self, store: Store, order: ShardOrder, catalogue: Catalogue, limits: Limits, tally: Tally) -> None:
        self._store = store
        self._order = order.model_copy(update={"label": uuid.uuid4().hex[:8]})
        self._catalogue = ray.put(catalogue)
        self._limits = limits
        self._tally = tally
        self._again: deque[tuple[Span, ...]] = deque()
        self._running: dict[ray.ObjectRef, tuple[Span, ...]] = {}
        self._deaths: Counter[tuple[str, int]] = Counter()
        """By ("scene", id), or ("range", start) where no scene was begun."""
        self._blamed: dict[int, Blame] = {}

    def run(self, shards: Iterator[tuple[Span, ...]], progress: Callable[[Tally], None] = lambda tally: None) -> None:
        """Makes every range of every shard.

        Raises CommitConflict where two attempts made other bytes, RunError where a worker cannot be kept alive or too
        many scenes fail. On KeyboardInterrupt, committed ranges stay and running shards are ended.
        """
        try:
            while self._fill_slots(shards):
                ready, _ = ray.wait(list(self._running), num_returns=1, timeout=POLL_S)
                for ref in ready:
                    self._collect(ref, self._running.pop(ref))
                progress(self._tally)
        except BaseException:
            self._cancel()
            raise

    def _fill_slots(self, shards: Iterator[tuple[Span, ...]]) -> bool:
        """Gives shards to Ray while there is room; False where nothing is left to wait for."""
        while len(self._running) < self._limits.in_flight:
            spans = self._again.popleft() if self._again else next(shards, None)
            if spans is None:
                break
            blamed = tuple(self._blamed[scene] for span in spans for scene in span.scene_ids if scene in self._blamed)
            order = self._order.model_copy(update={"spans": spans, "blamed": blamed})
            self._running[_run_shard.remote(order, self._catalogue)] = spans
        return bool(self._running)

    def _cancel(self) -> None:
        """Ends running shards; what is not committed is made again by the next run."""
        for ref in self._running:
            ray.cancel(ref, force=True)
        if self._running:
            ray.wait(list(self._running), num_returns=len(self._running), timeout=5.0)

    def _collect(self, ref: "ray.ObjectRef", spans: tuple[Span, ...]) -> None:
        try:
            report: ShardReport = ray.get(ref)
        except RayTaskError as error:
            if isinstance(error.cause, VersoError):
                raise error.cause from error
            raise RunError(f"a worker raised an error that is a bug:\n{error}") from error
        except RayError as error:
            return self._handle_death(spans, error)
        self._tally.add(report)
        for span in report.spans:
            log_event("range committed", range=span.start, **span.model_dump(include={"stop", "won", "made", "failed"}))
        if self._tally.conflicts:
            raise CommitConflict(self._tally.conflicts[0])
        if self._tally.failed.total() > self._limits.failures:
            reasons = ", ".join(f"{count} x {reason}" for reason, count in self._tally.failed.most_common(3))
            raise RunError(
                f"{self._tally.failed.total()} of {self._tally.asked} scenes have failed ({reasons}), which is more than "
                'run.max_failure_share allows: see `verso query OUT "select * from failures"`'
            )

    def _handle_death(self, spans: tuple[Span, ...], error: RayError) -> None:
        """Counts the ranges that a dead worker committed, then gives out the others again, one by one."""
        left = list(spans)
        while left and self._store.size(commit_path(left[0].start, left[0].retry)) is not None:
            summary = read_summary(self._store, left[0].start, left[0].retry)
            self._tally.made += summary.made
            self._tally.failed.update(kind for _, kind, _ in summary.failed)
            self._tally.commits.append(summary)
            left.pop(0)
        if left:
            self._count_death(left[0], error)
        self._again.extend((span,) for span in left)

    def _count_death(self, span: Span, error: RayError) -> None:
        """Counts a death against the scene in progress. Raises RunError where workers die before they begin a scene."""
        scene, timed_out = self._find_evidence(span)
        reason: Reason = "time" if timed_out else "memory" if isinstance(error, OutOfMemoryError) else "killed"
        message = " ".join(str(error).split())[:300]
        log_event("worker lost", logging.WARNING, range=span.start, scene=scene, reason=reason, error=message)
        key = ("range", span.start) if scene is None else ("scene", scene)
        self._deaths[key] += 1
        deaths = self._deaths[key]
        if deaths < self._limits.attempts:
            return
        if scene is None:
            raise RunError(
                f"the worker for the scenes from {span.start} died {deaths} times before it began one "
                f"({message}): see `verso doctor`"
            )
        self._blamed[scene] = Blame(scene_id=scene, reason=reason, detail=EXPLANATIONS[reason], attempts=deaths)

    def _find_evidence(self, span: Span) -> tuple[int | None, bool]:
        """The scene in progress when a worker of this run died, and whether its time was up; removes its attempt."""
        for name in attempts_at(self._store, span.start):
            if self._order.label not in name:
                continue
            scene = blamed_scene(self._store, span.start, name)
            timed_out = bool(self._store.size(f"{staging_path(span.start, name)}/{TIMED_OUT}"))
            self._store.remove_tree(staging_path(span.start, name))
            if scene is not None:
                return scene, timed_out
        return None, False
