"""Ranges that are committed while the next one is made.

A commit computes little and waits long: for a disk to flush, or for an object store to take and copy archives. So it runs in a
thread of its own. One range at a time is committed, in order, and nothing else of a worker runs in two threads.
"""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType

from schemas.dataset.commit import summarize
from schemas.dataset.shard import JobChange, SpanReport
from workers.store.attempt import Attempt


@dataclass(frozen=True, eq=False)
class MadeRange:
    """A range whose scenes are all written: its failures by `kind: reason`, and scenes that ended in an unexpected error."""

    attempt: Attempt
    failed: Mapping[str, int]
    bugs: tuple[str, ...]

    def commit(self, job_change: JobChange | None) -> SpanReport:
        """Commit it. Raises as `Attempt.commit`."""
        result, span = self.attempt.commit(job_change), self.attempt.span
        return SpanReport(
            start=span.start,
            stop=span.stop,
            retry=span.retry,
            won=result.won,
            conflict=result.conflict,
            made=len(span.scene_ids) - sum(self.failed.values()),
            failed=dict(self.failed),
            bugs=self.bugs,
            commit=summarize(result.record),
        )


class Committer:
    """Commits one range while the next is made. A context: at its end no commit is under way, also where its block raises."""

    def __init__(self, job_change: JobChange | None) -> None:
        self._job_change = job_change
        self._thread = ThreadPoolExecutor(1, "commit")
        self._under_way: Future[SpanReport] | None = None
        self.reports: list[SpanReport] = []
        """Of the ranges whose commits were waited for, in order."""

    def begin(self, made: MadeRange) -> None:
        """Begin to commit a range, after the commit before it. Raises what that one raised; then this one is not begun."""
        self.wait()
        self._under_way = self._thread.submit(made.commit, self._job_change)

    def wait(self) -> None:
        """Wait for the commit that is under way. Raises what it raised."""
        if self._under_way is not None:
            ended, self._under_way = self._under_way, None
            self.reports.append(ended.result())

    def __enter__(self) -> "Committer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown()
