"""What long work tells: a bar on a terminal, soon a line a minute elsewhere, JSON lines in OUT/_logs, counts for Prometheus."""

import argparse
import json
import logging
import logging.handlers
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from schemas.dataset.commit import CommitSummary
from schemas.dataset.layout import LOG_FOLDER
from schemas.dataset.shard import ShardReport
from schemas.errors import MachineError, describe_seconds, needs_making
from services.run.supervisor import tell
from workers.store.file_system import refuse_link_out

if TYPE_CHECKING:
    from prometheus_client.core import Metric

FIRST_LINES_S = (3.0, 8.0, 15.0, 30.0)
"""Seconds after which a log has its first lines; then one every `LINE_EVERY_S`."""

LINE_EVERY_S = 60.0
USUAL_COLUMNS, USUAL_ROWS = 80, 24
"""Size of a terminal that tells none: tqdm draws nothing in one without rows."""

LOG_BYTES = 4 * 2**20
LOG_FILES = 5

_events = logging.getLogger("verso.events")
_events.propagate = False


class ProgressLine:
    """Shows on standard error how many scenes, or other units, are done out of those asked, at what rate, and the time left."""

    def __init__(self, asked: int, what: str, unit: str = "scene") -> None:
        self._asked, self._what, self._unit = asked, what, unit
        self._bar = None
        if sys.stderr.isatty():
            columns = os.get_terminal_size(sys.stderr.fileno()).columns or USUAL_COLUMNS
            self._bar = tqdm(total=asked, unit=unit, desc=what, file=sys.stderr, ncols=columns, nrows=USUAL_ROWS)
        self._begun, self._next_s = time.monotonic(), FIRST_LINES_S[0]

    def expect(self, asked: int) -> None:
        """Sets the number to be done, where more is known than at first."""
        self._asked = asked
        if self._bar is not None:
            self._bar.total = asked

    def show(self, done: int, failed: int | None = None) -> None:
        """Shows the number done, and `failed` where failures are counted: `9 of 20 scenes, 1 failed, 0.4 scenes/s, 28 s left`."""
        if self._bar is not None:
            self._bar.n = done
            self._bar.set_postfix({} if failed is None else {"failed": failed}, refresh=True)
            return
        passed_s = time.monotonic() - self._begun
        if passed_s >= self._next_s:
            soon = (second for second in FIRST_LINES_S if second > passed_s)
            self._next_s = next(soon, (passed_s // LINE_EVERY_S + 1) * LINE_EVERY_S)
            parts = [f"{done} of {self._asked} {self._unit}s", *([] if failed is None else [f"{failed} failed"])]
            if done:
                left_s = max(0, self._asked - done) * passed_s / done
                parts += [f"{done / passed_s:.1f} {self._unit}s/s", f"{describe_seconds(left_s)} left"]
            print(f"{self._what}: {', '.join(parts)}", file=sys.stderr)

    def close(self) -> None:
        """Ends the bar."""
        if self._bar is not None:
            self._bar.close()


@contextmanager
def show_counts(of: str, unit: str = "file") -> Iterator[Callable[[str, int, int], None]]:
    """Within the block, what comes back shows numbers of several kinds: it takes the kind, how many are done, and of how many."""
    lines = dict[str, ProgressLine]()

    def watch(what: str, done: int, asked: int) -> None:
        if what not in lines:
            lines[what] = ProgressLine(asked, f"{of} {what}", unit)
        lines[what].expect(asked)
        lines[what].show(done)

    try:
        yield watch
    finally:
        for line in lines.values():
            line.close()


def say(line: str) -> None:
    """Prints a message while a bar may be shown."""
    tqdm.write(f"verso: {line}", file=sys.stderr)


@contextmanager
def event_log(out: Path | None) -> Iterator[None]:
    """Within the block `log_event` writes to OUT/_logs/verso.jsonl, rotated; nowhere without an `out` on a disk."""
    if out is None:
        yield
        return
    folder = out / LOG_FOLDER
    refuse_link_out(out, f"{LOG_FOLDER}/verso.jsonl")
    folder.mkdir(parents=True, exist_ok=True)
    tell(logs=str(folder))
    handler = logging.handlers.RotatingFileHandler(
        folder / "verso.jsonl", maxBytes=LOG_BYTES, backupCount=LOG_FILES - 1
    )
    _events.addHandler(handler)
    _events.setLevel(logging.INFO)
    try:
        yield
    finally:
        _events.removeHandler(handler)
        handler.close()


def log_event(event: str, level: int = logging.INFO, **fields: Any) -> None:
    """Writes one event as a JSON line: job, range, scene and attempt where they apply."""
    if not _events.handlers:
        return
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    _events.log(
        level, json.dumps({"time": stamp, "level": logging.getLevelName(level).lower(), "event": event, **fields})
    )


# ------------------------------------------------------------------------------------------------ counts

Counts = Mapping[str, Any]
"""The state of a run at one moment: numbers, or by a label numbers, by the names of `METRICS`."""

PHASES = ("planning", "making", "merging", "done")

METRICS = (
    ("gauge", "verso_scenes_asked", "asked", "", "Scenes that this run was to make."),
    ("gauge", "verso_ranges_in_flight", "in_flight", "", "Ranges given to Ray and not reported."),
    ("gauge", "verso_slots", "slots", "", "Shards that may run at once."),
    ("gauge", "verso_making_since_timestamp_seconds", "since", "", "When the making began."),
    ("counter", "verso_scenes_made", "made", "", "Scenes made and committed in this run."),
    ("counter", "verso_commits", "ranges", "", "Ranges committed in this run."),
    ("counter", "verso_scenes_failed", "failed", "reason", "Scenes that could not be made."),
    ("counter", "verso_workers_lost", "lost", "reason", "Workers that died, by cause."),
    ("counter", "verso_stage_seconds", "seconds", "stage", "Time of the workers in each stage."),
    ("gauge", "verso_phase", "phases", "phase", "1 for what the run does now."),
)
"""Kind, name, the name in `Tally.counts`, the label by which it is counted or nothing, and what it is."""


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
    seconds: dict[str, float] = field(default_factory=dict)
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
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
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
        return {**{name: copy(getattr(self, name)) for name in names}, "slots": slots}


class Meter:
    """The latest counts of one job, as a collector of metrics with the label `job`."""

    def __init__(self, job: str) -> None:
        self._job = job
        self._phase = PHASES[0]
        self._counts = Tally(0, since=0.0).counts(0)

    def show(self, counts: Counts) -> None:
        """Replaces what is served, as `Tally.counts` has it: scenes are being made."""
        self._counts, self._phase = counts, "making"

    def enter(self, phase: str) -> None:
        """Another phase, with the numbers as they are."""
        self._phase = phase

    def collect(self) -> Iterator["Metric"]:
        """The metrics of one scrape."""
        with needs_making("--metrics"):
            from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        counts = {**self._counts, "phases": {phase: float(phase == self._phase) for phase in PHASES}}
        for kind, name, counted, label, what in METRICS:
            family = GaugeMetricFamily if kind == "gauge" else CounterMetricFamily
            metric = family(name, what, labels=["job", *([label] if label else [])])
            for key, value in sorted(counts[counted].items()) if label else [("", counts[counted])]:
                metric.add_metric([self._job, *([key] if label else [])], value)
            yield metric


@contextmanager
def serve(meter: Meter, place: str | None) -> Iterator[None]:
    """Serves the metrics at `place`, HOST:PORT, while the block runs; nothing without a place.

    Who reaches the port may read them. Raises MachineError where it cannot be opened.
    """
    if place is None:
        yield
        return
    with needs_making("--metrics"):  # those who read datasets may not have it
        from prometheus_client import CollectorRegistry, start_http_server

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


def finish(options: argparse.Namespace, ok: bool, /, **answer: Any) -> int:
    """The exit code of a command; prints what `--json` asks for: one object in the last line."""
    if options.json:
        print(json.dumps({"ok": ok, **answer}))
    return 0 if ok else 1
