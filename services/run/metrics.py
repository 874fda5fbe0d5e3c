"""What a run has come to so far, and how Prometheus reads it. Edge: the one file that opens a port for it."""

import contextlib
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
from typing import Any

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from schemas.dataset.commit import CommitSummary
from schemas.dataset.shard import ShardReport
from schemas.errors import MachineError

PHASES = ("planning", "making", "merging", "done")

Counts = Mapping[str, Any]
"""The state of a run at one moment: numbers, or by a label numbers, by the names of `METRICS`."""


METRICS = (
    (GaugeMetricFamily, "verso_scenes_asked", "asked", "", "Scenes that this run was to make."),
    (GaugeMetricFamily, "verso_ranges_in_flight", "in_flight", "", "Ranges given to Ray and not reported."),
    (GaugeMetricFamily, "verso_slots", "slots", "", "Shards that may run at once."),
    (GaugeMetricFamily, "verso_making_since_timestamp_seconds", "since", "", "When the making began."),
    (CounterMetricFamily, "verso_scenes_made", "made", "", "Scenes made and committed in this run."),
    (CounterMetricFamily, "verso_commits", "ranges", "", "Ranges committed in this run."),
    (CounterMetricFamily, "verso_scenes_failed", "failed", "reason", "Scenes that could not be made."),
    (CounterMetricFamily, "verso_workers_lost", "lost", "reason", "Workers that died, by cause."),
    (CounterMetricFamily, "verso_stage_seconds", "seconds", "stage", "Time of the workers in each stage."),
    (GaugeMetricFamily, "verso_phase", "phases", "phase", "1 for what the run does now."),
)
"""Kind, name, the name in `Tally.counts`, the label by which it is counted or nothing, and what it is."""


class Meter(Collector):
    """The latest counts of one job, as metrics with the label `job`."""

    def __init__(self, job: str) -> None:
        self._job = job
        self._counts: Counts = Tally(0, since=0.0).counts(
            0
        )  # replaced as a whole: who serves sees one state or the next
        self.enter("planning")

    def show(self, counts: Counts) -> None:
        """Replaces what is served, as `Tally.counts` has it."""
        self._counts = counts

    def enter(self, phase: str) -> None:
        """Another phase, with the numbers as they are."""
        self._counts = {**self._counts, "phases": {each: float(each == phase) for each in PHASES}}

    def collect(self) -> Iterable[Metric]:
        """The metrics of one scrape."""
        for kind, name, counted, label, what in METRICS:
            values = self._counts[counted]
            family = kind(name, what, labels=["job", *([label] if label else [])])
            for key, value in sorted(values.items()) if label else [("", values)]:
                family.add_metric([self._job, *([key] if label else [])], value)
            yield family


@contextlib.contextmanager
def serve(meter: Meter, place: str | None) -> Iterator[None]:
    """Serves the metrics at `place`, HOST:PORT, while the block runs; nothing without a place.

    Who reaches the port may read them. Raises MachineError where it cannot be opened.
    """
    if place is None:
        yield
        return
    host, _, port = place.rpartition(":")
    registry = CollectorRegistry()
    registry.register(meter)
    try:
        server, thread = start_http_server(int(port), host.strip("[]"), registry)
    except OSError as error:
        raise MachineError(
            f"--metrics {place}: {error.strerror or error}: choose another port, or an address of this machine"
        ) from error
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@dataclass
class Tally:
    """The results of a run so far; changed by the coordinator alone."""

    asked: int
    made: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    conflicts: list[str] = field(default_factory=list)
    commits: list[CommitSummary] = field(default_factory=list)
    """Those of this run that nobody has taken yet."""
    lost: Counter[str] = field(default_factory=Counter)
    """Workers that died, by cause."""
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Of the workers, by stage."""
    ranges: int = 0
    """Those committed."""
    since: float = field(default_factory=time.time)
    """When the run began to make scenes, seconds since 1970."""
    under_way: int = 0
    """Scenes that workers have made and not reported, as far as their notes tell."""
    in_flight: int = 0
    """Ranges given to Ray and not reported."""
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
        for stage, seconds in report.seconds.items():
            self.seconds[stage] += seconds
        for span in report.spans:
            if span.conflict:
                self.conflicts.append(span.conflict)
            self.made += span.made
            self.failed.update(span.failed)
            if span.commit:
                self.add_commit(span.commit)

    def add_commit(self, commit: CommitSummary) -> None:
        """Counts a range that was committed, and keeps it until it is taken."""
        self.commits.append(commit)
        self.ranges += 1

    def take_commits(self) -> list[CommitSummary]:
        """The commits since the last call."""
        commits, self.commits = self.commits, []
        return commits

    def counts(self, slots: int) -> Counts:
        """What a run that makes scenes in so many slots counts, as it is served: copies, because the run goes on."""
        names = ("asked", "made", "failed", "lost", "seconds", "ranges", "in_flight", "since")
        phases = {each: float(each == "making") for each in PHASES}
        return {**{name: copy(getattr(self, name)) for name in names}, "slots": slots, "phases": phases}
