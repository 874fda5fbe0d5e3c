"""The metrics of a run, as Prometheus reads them."""

import contextlib
import urllib.error
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

import services.run.run_job
from schemas.errors import MachineError
from schemas.job.job import Job
from services.merge.merge import merge
from services.run.metrics import Counts, Meter, serve
from services.run.ray_cluster import private_ray
from services.run.run_job import RunRequest, run_job
from tests.kit.network import free_port
from tests.services.bench.small_job import SMALL


@pytest.fixture
def place() -> str:
    return f"127.0.0.1:{free_port()}"


def scrape(place: str) -> dict[tuple[str, ...], float]:
    """Values by name and labels other than the job."""
    with urllib.request.urlopen(f"http://{place}/metrics", timeout=5) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    found = {}
    for family in families:
        for sample in family.samples:
            others = [value for label, value in sorted(sample.labels.items()) if label != "job"]
            found[sample.name, *others] = sample.value
            assert sample.labels["job"] == "mugs"
    return found


def test_what_is_counted_is_served(place):
    meter = Meter("mugs")
    with serve(meter, place):
        assert scrape(place)["verso_phase", "planning"] == 1.0
        meter.show(
            Counts(
                asked=100,
                made=40,
                failed={"intrinsic: left_table": 3},
                lost={"memory": 1},
                seconds={"settle": 1.5, 'a "stage"\n': 2.0},
                commits=4,
                in_flight=7,
                slots=2,
                since=1.8e9,
                phase="making",
            )
        )
        found = scrape(place)
    assert found["verso_scenes_asked",] == 100
    assert found["verso_scenes_made_total",] == 40
    assert found["verso_scenes_failed_total", "intrinsic: left_table"] == 3
    assert found["verso_workers_lost_total", "memory"] == 1
    assert found["verso_stage_seconds_total", "settle"] == 1.5
    assert found["verso_stage_seconds_total", 'a "stage"\n'] == 2.0
    assert (found["verso_commits_total",], found["verso_ranges_in_flight",], found["verso_slots",]) == (4, 7, 2)
    assert found["verso_making_since_timestamp_seconds",] == 1.8e9
    assert (found["verso_phase", "making"], found["verso_phase", "planning"]) == (1.0, 0.0)


def test_the_port_is_closed_afterwards_and_none_is_opened_unasked(place):
    with serve(Meter("mugs"), place):
        scrape(place)
    with pytest.raises(urllib.error.URLError):
        scrape(place)
    with serve(Meter("mugs"), None), pytest.raises(urllib.error.URLError):
        scrape(place)


def test_a_port_that_is_taken_or_an_address_of_another_machine_is_told(place):
    with (
        serve(Meter("mugs"), place),
        pytest.raises(MachineError, match=r"in use.*another port"),
        serve(Meter("b"), place),
    ):
        pass
    with pytest.raises(MachineError, match=r"192\.0\.2\.1"), serve(Meter("mugs"), "192.0.2.1:9464"):
        pass


@pytest.mark.ray
@pytest.mark.minute
def test_a_run_serves_what_it_has_made_and_how_long_each_stage_took(tmp_path, monkeypatch, place):
    seen = {}

    def look_then_merge(*args):
        seen.update(scrape(place))
        return merge(*args)

    monkeypatch.setattr(services.run.run_job, "merge", look_then_merge)
    job = Job.model_validate({**SMALL, "name": "mugs", "scenes": 5})
    request = RunRequest(job, tmp_path, str(tmp_path / "out"), metrics=place)
    with private_ray(1) as slots:
        result = run_job(request, contextlib.nullcontext(slots))
    assert seen["verso_phase", "merging"] == 1.0
    failed = sum(value for key, value in seen.items() if key[0] == "verso_scenes_failed_total")
    assert seen["verso_scenes_made_total",] == result.made_now > 0
    assert seen["verso_scenes_made_total",] + failed == seen["verso_scenes_asked",] == job.scenes
    assert seen["verso_commits_total",] == -(-job.scenes // job.range_size)
    assert seen["verso_stage_seconds_total", "physics"] > 0.0
    assert seen["verso_ranges_in_flight",] == 0
