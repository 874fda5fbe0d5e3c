"""The coordinator over simulated nodes."""

import os
from pathlib import Path

import pytest
from ray._common.utils import get_ray_address_file

from services.bench.simulated import compare, describe, measure_simulated, simulated_nodes, sleeping
from services.job.job_file import validate_job
from tests.services.bench.small_job import SMALL
from tests.services.run.test_coordinator import spans

KEYS = {"nodes", "shard_s", "overhead", "start_s", "shards_per_s", "coordinator_ms"}


def test_a_sleeping_worker_reports_what_it_was_given():
    import pickle
    from types import SimpleNamespace

    order = pickle.dumps(SimpleNamespace(spans=spans(0, 2, 8)))
    made = sleeping(0.0)(None, order, b"")
    assert [(span.start, span.stop, span.made) for span in made.spans] == [(0, 2, 2), (2, 4, 2), (8, 10, 2)]


def test_the_overhead_is_of_the_shards_between_a_short_and_a_long_run():
    """2 and 12 shards of 0.5 s on 4 slots, 0.8 s to begin, 0.05 s more for each."""
    figures = compare((0.8 + 2 * 0.55, 0.3 + 8 * 0.002), (0.8 + 12 * 0.55, 0.3 + 48 * 0.002), 4, 0.5)
    assert figures == pytest.approx({"overhead": 0.1, "start_s": 0.8, "shards_per_s": 4 / 0.55, "coordinator_ms": 2.0})


def test_a_lap_is_a_line():
    lap = {"nodes": 16, "shard_s": 2.0, "overhead": 0.031, "start_s": 0.84, "shards_per_s": 7.7, "coordinator_ms": 1.25}
    assert describe({"simulated": [lap]})[-1].split() == [
        "16",
        "2.0",
        "s",
        "3.1%",
        "0.84",
        "s",
        "7.7",
        "1.25",
        "ms/shard",
    ]


@pytest.mark.minute
@pytest.mark.ray
def test_two_nodes_take_the_time_of_their_shards_at_least(tmp_path):
    (lap,) = measure_simulated(validate_job(SMALL, "test"), tmp_path, [2], [0.4])
    assert set(lap) == KEYS
    assert lap["nodes"] == 2 and lap["overhead"] > 0.0 and 0.0 < lap["shards_per_s"] <= 2 / 0.4
    assert lap["coordinator_ms"] > 0.0


@pytest.mark.minute
@pytest.mark.ray
def test_no_process_stays_when_the_nodes_are_ended():
    before = set(os.listdir("/proc"))
    with simulated_nodes(2):
        during = {pid for pid in set(os.listdir("/proc")) - before if pid.isdigit() and b"raylet" in command(pid)}
    assert len(during) >= 3
    assert not [pid for pid in during if b"raylet" in command(pid)]


def test_nothing_tells_others_to_join_them():
    """Ray notes the address of a cluster where every later `ray.init()` of the machine looks, and fails without that folder."""
    note = Path(get_ray_address_file(None))
    before = note.read_text() if note.exists() else None
    with simulated_nodes(1):
        assert (note.read_text() if note.exists() else None) == before


def command(pid: str) -> bytes:
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return file.read()
    except OSError:
        return b""
