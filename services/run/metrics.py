"""What a run counts, served to Prometheus while it runs. Edge: the one file that opens a port for it."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from schemas.errors import MachineError

PHASES = ("planning", "making", "merging", "done")


@dataclass(frozen=True)
class Counts:
    """The state of a run at one moment.

    `failed` by `kind: reason`; `lost`: workers by the cause of their death; `seconds`: of the workers by stage;
    `in_flight`: ranges given to Ray; `slots`: shards that may run at once; `since`: when the making began, seconds since
    1970; `phase`: one of `PHASES`.
    """

    asked: int = 0
    made: int = 0
    failed: Mapping[str, int] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    commits: int = 0
    in_flight: int = 0
    slots: int = 0
    since: float = 0.0
    phase: str = "planning"


class Meter(Collector):
    """The latest counts of one job, as metrics with the label `job`."""

    def __init__(self, job: str) -> None:
        self._job = job
        self._counts = Counts()  # replaced as a whole: the thread that serves sees one state or the next

    def show(self, counts: Counts) -> None:
        """Replaces what is served."""
        self._counts = counts

    def enter(self, phase: str) -> None:
        """Another phase, with the numbers as they are."""
        self._counts = replace(self._counts, phase=phase)

    def collect(self) -> Iterable[Metric]:
        """The metrics of one scrape."""
        now = self._counts
        gauges = {
            "verso_scenes_asked": ("Scenes that this run was to make.", now.asked),
            "verso_ranges_in_flight": ("Ranges given to Ray and not reported.", now.in_flight),
            "verso_slots": ("Shards that may run at once.", now.slots),
            "verso_making_since_timestamp_seconds": ("When the making began.", now.since),
        }
        counters = {
            "verso_scenes_made": ("Scenes made and committed in this run.", now.made),
            "verso_commits": ("Ranges committed in this run.", now.commits),
        }
        for name, (what, value) in gauges.items():
            yield _family(GaugeMetricFamily(name, what, labels=["job"]), {(self._job,): value})
        for name, (what, value) in counters.items():
            yield _family(CounterMetricFamily(name, what, labels=["job"]), {(self._job,): value})
        yield self._by("verso_scenes_failed", "Scenes that could not be made.", "reason", now.failed)
        yield self._by("verso_workers_lost", "Workers that died, by cause.", "reason", now.lost)
        yield self._by("verso_stage_seconds", "Time of the workers in each stage.", "stage", now.seconds)
        phases: dict[tuple[str, ...], float] = {(self._job, phase): float(phase == now.phase) for phase in PHASES}
        yield _family(GaugeMetricFamily("verso_phase", "1 for what the run does now.", labels=["job", "phase"]), phases)

    def _by(self, name: str, what: str, label: str, values: Mapping[str, float]) -> Metric:
        family = CounterMetricFamily(name, what, labels=["job", label])
        return _family(family, {(self._job, key): value for key, value in sorted(values.items())})


def _family(
    family: CounterMetricFamily | GaugeMetricFamily, values: Mapping[tuple[str, ...], float]
) -> CounterMetricFamily | GaugeMetricFamily:
    for labels, value in values.items():
        family.add_metric(list(labels), value)
    return family


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
