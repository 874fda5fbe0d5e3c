"""Mechanical energy of a drop, which friction and impacts may only take away."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest

from schemas.base import Array
from schemas.job import Job
from schemas.shape import Asset
from schemas.sources import ProceduralSource
from tests.physics.room import G, physics
from tests.shapes import asset_of, box, table
from workers.assets.procedural.make import make_asset
from workers.geometry.frames import invert, rotation_from_quaternion, transform
from workers.geometry.hull import convex_hull
from workers.scene.bullet import Body, drop
from workers.scene.plan import draw_start
from workers.scene.settle import _body_frame
from workers.scene.support import place_table

TABLE = place_table(table())
SEEDS = 20
WATCHED_S = 1.2
SHARE = 1e-3
"""Of the energy that the drop sets free."""
LIFT_M = 2e-5
"""Height that the rise would lift the body by."""

CATEGORIES = ("box", "can", "bottle", "mug")
STARTS = ("upright", "tumbled")


def asset_for(category: str, index: int) -> Asset:
    if category == "box":
        return asset_of(box(0.1, 0.08, 0.2))
    return make_asset(category, ProceduralSource(source="procedural"), index, 600.0)


@dataclass(frozen=True)
class Rise:
    """The most that energy rises above its running minimum: over the bound, and as a height."""

    over_bound: float
    lift_m: float


@functools.cache
def worst_rise(category: str, start: str, seed: int, rate_hz: int) -> Rise:
    asset = asset_for(category, seed)
    job = Job.model_validate({"name": "t", "seed": seed, "start": {"pose": start}})
    energy = energies(asset, draw_start(job, seed, asset, TABLE).T_world_obj, rate_hz)
    rise = float((energy - np.minimum.accumulate(energy)).max())
    weight = asset.mass.mass_kg * G
    return Rise(rise / max(SHARE * (energy[0] - energy[-1]), LIFT_M * weight), rise / weight)


def energies(asset: Asset, T_world_obj: Array, rate_hz: int) -> Array:
    """[steps] joules: kinetic and potential energy after every step, from the release on.

    In the air semi-implicit Euler only loses energy, g^2 h / 2 a second and kilogram, so that no rise is its own.
    """
    T_obj_body, moments = _body_frame(asset.mass)
    vertices = convex_hull(asset.shape.vertices).vertices
    body = Body(asset.mass.mass_kg, moments, transform(invert(T_obj_body), vertices))
    found = []
    with drop(body, T_world_obj @ T_obj_body, TABLE.top.height_m, physics(step_hz=rate_hz), 1) as world:
        for _ in range(round(WATCHED_S * rate_hz)):
            (x, quaternion), (v, w) = world.pose(), world.velocity()
            spin = rotation_from_quaternion(np.array(quaternion)).T @ np.array(w)
            found.append(body.mass_kg * (np.dot(v, v) / 2 + G * x[2]) + float(moments @ (spin * spin)) / 2)
            world.advance()
    return np.array(found)


@pytest.mark.xfail(
    reason="at 960 Hz 73 of these 160 drops rise further, by up to 0.42 mm of height and 7.7 times the bound: Bullet "
    "closes a fifth of what bodies overlap in each step (contactERP), and they keep the speed that it gives them",
)
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_energy_never_rises_above_its_running_minimum(category, start, record_figure):
    rises = [worst_rise(category, start, seed, 960) for seed in range(SEEDS)]
    missed = sum(rise.over_bound > 1.0 for rise in rises)
    record_figure(f"energy, {category} {start}: drops that rise too far", "missed", missed, 0)
    record_figure(
        f"energy, {category} {start}: worst rise over its bound", "missed", max(r.over_bound for r in rises), 1
    )
    record_figure(f"energy, {category} {start}: worst rise, um", "missed", max(r.lift_m for r in rises) * 1e6)
    assert missed == 0


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_what_energy_rises_by_shrinks_with_the_step(category, start, record_figure):
    """A step goes too deep by a step's way at most: the first order, 0.8 of which twenty drops show."""
    coarse, fine = (
        float(np.mean([worst_rise(category, start, seed, rate).lift_m for seed in range(SEEDS)]))
        for rate in (960, 3840)
    )
    found = math.log(coarse / fine, 4)
    record_figure(f"energy, {category} {start}: order of the mean rise in the step", "passed", found, 0.8)
    assert found > 0.8
