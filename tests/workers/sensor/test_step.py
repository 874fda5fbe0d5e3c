"""Scenes made with every sensor effect on: what is stored still follows from what is stored."""

import contextlib
from pathlib import Path

import pytest

from services.job.read import validate_job
from services.read.query import query
from services.read.verify import verify
from services.run.ray_cluster import Slots, private_ray
from services.run.step import RunRequest, run_job
from tests.services.run.test_step import SMALL
from workers.store.local import LocalStore

EVERY = {
    "depth_noise": {},
    "distortion": {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.001},
    "rgb_noise": {},
    "exposure": {},
}


@pytest.mark.ray
def test_a_dataset_with_every_effect_on_verifies_and_says_what_ran(tmp_path):
    job = validate_job({**SMALL, "scenes": 4, "sensor": EVERY}, "test")
    with private_ray(1):
        run_job(RunRequest(job, Path(), str(tmp_path / "noisy")), contextlib.nullcontext(Slots(1, 1)))
    store = LocalStore(tmp_path / "noisy")
    verdict = verify(store, lambda _: None)
    assert verdict.faults == []
    assert verdict.pairs == 4
    for row in query(store, "select * from scenes").to_pylist():
        assert {f"sensor_{name}" for name in EVERY} <= set(row["effects"])
