"""Sensing of one view: each effect runs because the plan runs it; a dataset with every effect on verifies."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from schemas.job.views import Images, SensorEffects
from schemas.scene.scene import EffectPlan
from schemas.scene.view import Camera, Intrinsics, View
from services.job.job_file import validate_job
from services.read.query import query
from services.read.verify import verify
from services.run.ray_cluster import Slots, private_ray
from services.run.run_job import RunRequest, run_job
from tests.services.run.test_run_job import SMALL
from workers.geometry.colour import decode_codes
from workers.scene.sensor import SensorChance, planned_effects, sense_view
from workers.store.local import LocalStore

EVERY = {
    "depth_noise": {},
    "distortion": {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.001},
    "rgb_noise": {},
    "exposure": {},
}

NAMES = tuple(f"sensor_{name}" for name in EVERY)


def exact_view() -> View:
    """A wall that recedes, with a step in it, in grey stripes."""
    k = Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
    depth = np.tile(np.linspace(6_000, 8_000, 64).astype(np.uint16), (48, 1))
    depth[:, 40:] += 3_000
    rgb = np.repeat(np.tile(np.arange(20, 148, 2, dtype=np.uint8), (48, 1))[..., None], 3, axis=2)
    return View("input", 0, 0, Camera(k, np.eye(4)), rgb, depth, np.where(depth > 9_000, 2, 3).astype(np.uint8), ())


def sensed(names: tuple[str, ...], **branches: object) -> View:
    """The view as the sensors store it, with these effects in the plan and always the same chance."""
    chance = SensorChance(*(np.random.default_rng(seed) for seed in (1, 2, 3)))
    sensor = SensorEffects.model_validate({**EVERY, **branches})
    return sense_view(sensor, Images(), exact_view(), chance, EffectPlan(names, {}))


@pytest.mark.parametrize("name", EVERY)
def test_an_effect_that_is_withdrawn_is_not_applied_although_the_job_has_its_numbers(name):
    others = tuple(other for other in NAMES if other != f"sensor_{name}")
    full, less, off = sensed(NAMES), sensed(others), sensed(NAMES, **{name: None})
    assert np.array_equal(less.rgb, off.rgb) and np.array_equal(less.depth, off.depth)
    assert np.array_equal(full.depth, less.depth) == (name != "depth_noise")
    assert np.array_equal(full.rgb, less.rgb) == (name == "depth_noise")
    assert full.region.tobytes() == less.region.tobytes() == exact_view().region.tobytes()


def test_one_effect_in_the_plan_does_what_its_number_says_and_nothing_else():
    """One stop doubles linear light; lens, noise and depth noise, which the job has too, do not act."""
    seen, exact = sensed(("sensor_exposure",), exposure={"stops": [1.0, 1.0]}), exact_view()
    assert np.array_equal(seen.depth, exact.depth)
    light, before = decode_codes(seen.rgb), decode_codes(exact.rgb)
    assert np.abs(light - np.minimum(2.0 * before, 1.0)).max() < 0.006


def test_without_any_effect_in_the_plan_the_view_is_the_same():
    exact, chance = exact_view(), SensorChance(*(np.random.default_rng(seed) for seed in (1, 2, 3)))
    sensor = SensorEffects.model_validate(EVERY)
    assert sense_view(sensor, Images(), exact, chance, EffectPlan((), {})) is exact
    assert planned_effects(sensor, EffectPlan((), {})) == SensorEffects()


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
