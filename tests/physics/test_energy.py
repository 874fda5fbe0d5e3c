"""Mechanical energy of a drop, which friction and impacts may only take away."""

import functools
import math
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import SettleError
from schemas.job.assets import ProceduralSource
from schemas.job.job import Job
from schemas.scene.shape import Asset
from tests.hard_cases.bodies import cube
from tests.hard_cases.groups import dominoes, pile, stack
from tests.kit.shapes import asset_of, box, table
from tests.physics.energy import Rise, watched, worst_of
from tests.physics.population import try_scene
from tests.physics.room import PHYSICS, G, physics
from tests.physics.settling import settle_group, settle_single
from workers.assets.builtin.make import make_asset
from workers.assets.catalogue import open_catalogue
from workers.physics.support import place_table
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import draw_start

TABLE = place_table(table())
SEEDS = 20
WATCHED_S = 1.2
CATEGORIES = ("box", "can", "bottle", pytest.param("mug", marks=pytest.mark.minute))
STARTS = ("upright", "tumbled")


def asset_for(category: str, index: int) -> Asset:
    if category == "box":
        return asset_of(box(0.1, 0.08, 0.2))
    return make_asset(category, ProceduralSource(source="procedural"), index, 600.0)


@functools.cache
def worst_rise(category: str, start: str, seed: int, refine: int = 1) -> Rise:
    asset = asset_for(category, seed)
    job = Job.model_validate({"name": "t", "seed": seed, "start": {"pose": start}})
    drawn = draw_start(job.start, SceneChance(job.seed, seed), asset, TABLE)
    with watched([asset]) as falls, suppress(SettleError):  # that it rests is another test's
        settle_single(
            drawn,
            TABLE,
            physics(step_hz=PHYSICS.step_hz * refine, max_step_travel_mm=PHYSICS.max_step_travel_mm / refine),
        )
    return worst_of(falls(), asset.mass.mass_kg * G)


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


GROUPS = {
    "pile of six": lambda: pile(6),
    "stack of five": lambda: stack(*[cube(0.05)] * 5),
    "six dominoes": lambda: dominoes(6, 14.0),
}


@pytest.mark.minute
@pytest.mark.parametrize("make", GROUPS.values(), ids=GROUPS)
def test_the_energy_of_all_that_falls_together_never_rises_above_its_running_minimum(make, request, record_figure):
    group = make()
    assets = [start.asset for start in group.starts]
    settings = physics()
    with watched(assets) as falls:
        settle_group(group.starts, group.table, settings)
    rise = worst_of(falls(), sum(asset.mass.mass_kg for asset in assets) * G)
    name = f"energy, {request.node.callspec.id}"
    record_figure(f"{name}: worst rise over its bound", "passed", rise.over_bound, 1)
    record_figure(f"{name}: worst rise, um", "passed", rise.lift_m * 1e6)
    assert rise.over_bound <= 1.0


SPINS = [(0.0, 0.0, 50.0), (30.0, 40.0, 0.0), (0.0, 0.0, 200.0), (0.0, 160.0, 120.0)]
"""Angular velocities, rad/s."""


@pytest.mark.parametrize("spin", SPINS)
@pytest.mark.parametrize("category", ["box", "can"])
def test_what_spins_when_it_is_let_go_gains_no_energy(category, spin, record_figure):
    """The energy that is set free is the spin's too."""
    asset = asset_for(category, 0)
    start = draw_start(Job(name="t").start, SceneChance(0, 0), asset, TABLE)
    with watched([asset], spin) as falls, suppress(SettleError):  # some leave the table, and some spin for too long
        settle_single(start, TABLE, physics(max_settle_s=1.0))
    rise = worst_of(falls(), asset.mass.mass_kg * G)
    record_figure(f"energy, {category} spun by {spin} rad/s: worst rise over its bound", "passed", rise.over_bound, 1)
    assert rise.over_bound <= 1.0


@pytest.mark.parametrize(("scene_id", "what"), [(385, "bottle on its side"), (334, "bowl that falls onto its rim")])
def test_what_rolls_gains_no_energy_from_contact_to_contact(scene_id, what, record_figure):
    """Tumbled scenes of the population: what Bullet found of them by turns was pushed up fast."""
    job = Job.model_validate({"name": "population", "seed": 0, "start": {"pose": "tumbled"}})
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    rise = try_scene(job, catalogue, scene_id, again=False).rise
    record_figure(f"energy, {what}: worst rise over its bound", "passed", rise, 1)
    assert rise <= 1.0


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
