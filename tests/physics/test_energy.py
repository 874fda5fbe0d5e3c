"""Mechanical energy of a drop, which friction and impacts may only take away."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pybullet
import pytest

from schemas.base import Array
from schemas.job import Job
from schemas.scene import ObjectStart
from schemas.shape import Asset
from schemas.sources import ProceduralSource
from tests.physics.room import G, physics
from tests.shapes import asset_of, box, table
from workers.assets.procedural.make import make_asset
from workers.geometry.frames import rotation_from_quaternion
from workers.scene import bullet
from workers.scene.bullet import World
from workers.scene.fall import body_frame
from workers.scene.plan import draw_start
from workers.scene.settle import settle
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
def worst_rise(category: str, start: str, seed: int, refine: int = 1) -> Rise:
    asset = asset_for(category, seed)
    job = Job.model_validate({"name": "t", "seed": seed, "start": {"pose": start}})
    weight, rises = asset.mass.mass_kg * G, []
    for energy in energies(draw_start(job, seed, asset, TABLE), refine):
        rise = float((energy - np.minimum.accumulate(energy)).max())
        rises.append(Rise(rise / max(SHARE * (energy[0] - energy[-1]), LIFT_M * weight), rise / weight))
    return max(rises, key=lambda rise: rise.over_bound)


def energies(start: ObjectStart, refine: int) -> list[Array]:
    """[steps] joules: kinetic and potential energy after every step of each fall of a settling as it is in production.

    In the air semi-implicit Euler only loses energy, g^2 h / 2 a second and kilogram, so that no rise is its own.
    """
    mass, falls = start.asset.mass, list[list[float]]()
    _, moments = body_frame(mass)

    class Watched(World):
        """Steps one at a time, and looks at the energy after each."""

        def advance(self) -> None:
            for _ in range(self.steps):
                pybullet.stepSimulation(physicsClientId=self.client)
                (x, quaternion), (v, w) = self.pose(), self.velocity()
                spin = rotation_from_quaternion(np.array(quaternion)).T @ np.array(w)
                falls[-1].append(mass.mass_kg * (np.dot(v, v) / 2 + G * x[2]) + float(moments @ (spin * spin)) / 2)

        def pace(self, step_hz: float, repair: float = bullet.REPAIR) -> None:
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=1.0 / step_hz, numSubSteps=0, contactERP=repair, physicsClientId=self.client
            )

    def begin(*of: Any) -> World:
        falls.append([])
        return Watched(*of)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bullet, "World", begin)
        settle(start, TABLE, physics(step_hz=960 * refine, way_mm=0.1 / refine))
    return [np.array(energy) for energy in falls]


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_energy_never_rises_above_its_running_minimum(category, start, record_figure):
    rises = [worst_rise(category, start, seed) for seed in range(SEEDS)]
    missed = sum(rise.over_bound > 1.0 for rise in rises)
    record_figure(f"energy, {category} {start}: drops that rise too far", "passed", missed, 0)
    record_figure(
        f"energy, {category} {start}: worst rise over its bound", "passed", max(r.over_bound for r in rises), 1
    )
    record_figure(f"energy, {category} {start}: worst rise, um", "passed", max(r.lift_m for r in rises) * 1e6)
    assert missed == 0


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_what_energy_rises_by_shrinks_with_the_step(category, start, record_figure):
    """A step goes too deep by a step's way at most: the first order, 0.8 of which twenty drops show."""
    coarse, fine = (
        float(np.mean([worst_rise(category, start, seed, refine).lift_m for seed in range(SEEDS)])) for refine in (1, 4)
    )
    found = math.log(coarse / fine, 4)
    record_figure(f"energy, {category} {start}: order of the mean rise in the step", "passed", found, 0.8)
    assert found > 0.8
