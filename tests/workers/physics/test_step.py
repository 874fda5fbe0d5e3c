"""From release to rest, against mechanics in closed form."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from schemas.errors import SettleError
from schemas.job.assets import ProceduralSource
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart
from schemas.scene.shape import Mesh
from tests.kit.shapes import asset_of, box, shape_of, table
from tests.physics.population import draw
from tests.physics.settling import effects_of, recheck, scene_of, settle_single
from workers.assets.builtin.make import make_asset
from workers.assets.catalogue import open_catalogue
from workers.geometry.frames import angle_between, pose, rotation_about, transform, translation
from workers.geometry.hull import convex_hull
from workers.physics.fall import FINEST, fall
from workers.physics.settle import RECHECK_RATE, RECHECK_S, Rest, recheck_scene, release_again
from workers.physics.support import place_table, vertical_gap
from workers.scene.plan import SceneChance, draw_scene, draw_start

PHYSICS = Job(name="t").physics
TABLE = place_table(table())
TOP = TABLE.top.height_m


def start_of(asset, T) -> ObjectStart:
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, T, 0, False)


def gap_of(asset, settled) -> float:
    return vertical_gap(Mesh(transform(settled.T_world_obj, asset.shape.vertices), asset.shape.faces), TABLE.mesh)


def test_a_box_dropped_flat_stands_where_it_fell():
    asset = asset_of(box(0.1, 0.08, 0.2))
    R = rotation_about(np.array([0, 0, 1.0]), 0.4)
    rest = settle_single(start_of(asset, pose(R, np.array([0.1, -0.1, TOP + 0.13]))), TABLE, PHYSICS)
    assert rest.T_world_obj[:3, 3] == pytest.approx([0.1, -0.1, TOP + 0.1], abs=1e-3)
    assert rest.T_world_obj[2, 3] == pytest.approx(TOP + 0.1, abs=1e-12)
    assert angle_between(rest.T_world_obj[:3, :3], R) < 0.01
    assert rest.support == "flat_top"
    assert rest.support_margin_mm == pytest.approx(40.0, abs=0.1)
    # It falls for sqrt(2 h / g), and then stands on a steady face for a fifth of the window.
    fall = math.sqrt(2 * 0.03 / 9.81)
    assert fall + 0.05 <= rest.settle_s < fall + 0.05 + 0.1


def test_a_box_dropped_on_its_edge_ends_on_a_face():
    asset = asset_of(box(0.1, 0.1, 0.1))
    T = pose(rotation_about(np.array([1.0, 0, 0]), math.pi / 4 + 0.03), np.array([0, 0, TOP + 0.1]))
    rest = settle_single(start_of(asset, T), TABLE, PHYSICS)
    axes = np.abs(rest.T_world_obj[2, :3])
    assert np.sort(axes) == pytest.approx([0, 0, 1], abs=1e-9)
    assert abs(gap_of(asset, rest)) < 1e-12


@pytest.mark.parametrize("seed", range(12))
def test_tumbled_cylinders_rest_on_a_face_with_their_centre_above_it_and_do_not_move_again(seed):
    asset = asset_of(trimesh.creation.cylinder(0.04, 0.2))
    job = Job.model_validate({"name": "t", "seed": seed, "start": {"pose": "tumbled"}})
    plan = draw_scene(job, SceneChance(job.seed, seed), table(), asset)
    rest = settle_single(plan.objects[0], plan.table, PHYSICS)
    assert rest.penetration_mm < 1e-9
    assert rest.hover_gap_mm < 1e-9
    assert rest.support_margin_mm > 1.0
    assert recheck(plan.objects[0], rest, plan.table, PHYSICS)[0] < 0.1


@pytest.mark.parametrize("scene_id", [5, 11, 18, 23])
def test_a_bottle_that_rolling_friction_held_on_an_edge_rolls_onto_a_face_and_not_for_ever(scene_id):
    asset = make_asset("bottle", ProceduralSource(source="procedural"), 822319, 600.0)
    job = Job.model_validate({"name": "t", "seed": 2024, "start": {"pose": "tumbled"}})
    start = draw_start(job.start, SceneChance(job.seed, scene_id), asset, TABLE)
    rest = settle_single(start, TABLE, PHYSICS)
    assert rest.support == "flat_top"
    assert rest.support_margin_mm > 0.0
    assert recheck(start, rest, TABLE, PHYSICS)[0] < 0.1


@pytest.mark.minute
def test_a_mug_on_a_mesh_that_rolling_friction_held_out_of_balance_tips_on(tmp_path):
    """Its centre of mass was half a millimetre beyond its contacts, and went on from there at a third of a mm/s."""
    job = Job.model_validate({"name": "t", "start": {"pose": "tumbled"}})
    plan = draw(job, open_catalogue(job.assets, tmp_path, tuple(job.categories)), 360)
    effects = effects_of(plan.objects, plan.table, job.physics)
    names = {*effects.ran, "table_mesh", "decomposition"}
    rest = settle_single(plan.objects[0], plan.table, job.physics, names)
    assert rest.support == "mesh"
    assert rest.support_margin_mm > 1.0 and rest.equilibrium_residual < 1e-3
    moved_mm, turned_deg = recheck(plan.objects[0], rest, plan.table, job.physics)
    assert moved_mm < 0.1 and turned_deg < 0.1


def test_what_is_let_go_again_is_watched_to_the_end_however_still_it_stands(monkeypatch):
    start, watched = start_of(asset_of(box(0.1, 0.08, 0.2)), translation(0.0, 0.0, TOP + 0.11)), []
    rest = settle_single(start, TABLE, PHYSICS)

    def told(*arguments, **more):
        watched.append(fall(*arguments, **more))
        return watched[-1]

    monkeypatch.setattr("workers.physics.release.fall", told)
    recheck(start, rest, TABLE, PHYSICS)
    plan = draw_scene(Job(name="t"), SceneChance(0, 0), table(), start.asset)
    plan = dataclasses.replace(plan, objects=(start,), table=TABLE)
    release_again(plan, [rest], PHYSICS, EffectPlan(("dynamics", "fine_step"), {}), 0.5)
    assert [each.seconds for each in watched] == pytest.approx([RECHECK_S, 0.5], abs=1e-3)


def test_a_single_object_on_level_ground_alone_is_let_go_again_in_a_quarter_of_the_finest_steps(monkeypatch):
    rates = []

    def told(bodies, poses, ground, physics, steps, *rest, **more):
        rates.append(steps.base_hz / PHYSICS.step_hz)
        return fall(bodies, poses, ground, physics, steps, *rest, **more)

    monkeypatch.setattr("workers.physics.release.fall", told)
    asset, at = asset_of(box(0.06, 0.06, 0.06)), [translation(x_m, 0.0, TOP + 0.03) for x_m in (0.0, 0.06, 0.699)]
    starts = [start_of(asset, T) for T in at]
    one = settle_single(start_of(asset, at[0]), TABLE, PHYSICS)
    for numbers in ((0,), (2,), (0, 1)):
        own, rests = [starts[n] for n in numbers], tuple(dataclasses.replace(one, T_world_obj=at[n]) for n in numbers)
        recheck_scene(scene_of(own, TABLE), Rest(rests), PHYSICS, EffectPlan(("dynamics", "fine_step"), {}))
    assert rates == [RECHECK_RATE, FINEST, FINEST], "on the top, at its edge, two that touch"


@pytest.mark.parametrize("rate", [RECHECK_RATE, FINEST])
@pytest.mark.parametrize(
    ("x_m", "up_m", "least_mm", "most_mm"),
    [(0.0, 0.0, 0.0, 1e-3), (0.0, 1.5e-4, 0.14, 0.16), (0.699, 0.0, 0.0, 1e-3), (0.701, 0.0, 0.2, 0.5)],
    ids=["on the table", "0.15 mm above it", "1 mm inside an overhang", "1 mm outside"],
)
def test_what_is_let_go_again_shows_whether_it_rested(x_m, up_m, least_mm, most_mm, rate):
    """A cube of 60 mm on a top that ends at 0.7 m; what tips is stopped once its centre of mass went 0.2 mm."""
    asset = asset_of(box(0.06, 0.06, 0.06))
    rest = settle_single(start_of(asset, translation(0.0, 0.0, TOP + 0.03)), TABLE, PHYSICS)
    T = translation(x_m, 0.0, TOP + 0.03 + up_m)
    moved_mm, _ = recheck(start_of(asset, T), dataclasses.replace(rest, T_world_obj=T), TABLE, PHYSICS, rate)
    assert least_mm <= moved_mm <= most_mm


def test_the_same_start_gives_the_same_bits():
    asset = asset_of(trimesh.creation.icosphere(subdivisions=1, radius=0.06))
    plan = draw_scene(
        Job.model_validate({"name": "t", "start": {"pose": "tumbled"}}), SceneChance(0, 4), table(), asset
    )
    first, second = (settle_single(plan.objects[0], plan.table, PHYSICS) for _ in range(2))
    assert np.array_equal(first.T_world_obj, second.T_world_obj)
    assert first.settle_s == second.settle_s


def test_an_object_whose_frame_is_far_from_its_centre_of_mass_falls_the_same_way():
    here = asset_of(box(0.1, 0.08, 0.2))
    shifted = asset_of(box(0.1, 0.08, 0.2, (0.3, -0.2, 0.1)))
    R = rotation_about(np.array([0, 1.0, 0]), 0.05)
    a = settle_single(start_of(here, pose(R, np.array([0, 0, TOP + 0.12]))), TABLE, PHYSICS)
    offset = translation(-0.3, 0.2, -0.1)
    b = settle_single(start_of(shifted, pose(R, np.array([0, 0, TOP + 0.12])) @ offset), TABLE, PHYSICS)
    # Two roundings of one drop that bounces on an edge differ by some tenths of a milliradian, and not by decimetres.
    assert b.T_world_obj @ np.linalg.inv(offset) == pytest.approx(a.T_world_obj, abs=2e-3)


def test_an_object_over_the_edge_is_dropped_on_the_real_mesh_and_falls_where_it_must():
    asset = asset_of(box(0.1, 0.1, 0.1))
    stands = settle_single(start_of(asset, translation(0.7 - 0.02, 0.0, TOP + 0.055)), TABLE, PHYSICS)
    assert stands.support == "mesh"
    assert stands.T_world_obj[0, 3] == pytest.approx(0.68, abs=2e-3)
    with pytest.raises(SettleError) as caught:
        settle_single(start_of(asset, translation(0.7 + 0.01, 0.0, TOP + 0.055)), TABLE, PHYSICS)
    assert caught.value.reason == "left_table"


@pytest.mark.parametrize(("side", "stays"), [(0.1, True), (0.065, True), (0.055, False)])
def test_an_object_over_a_hole_rests_on_its_rim_if_it_is_larger(side, stays):
    sides = [box(0.67, 1.4, 0.03, (x, 0, 0.7)) for x in (-0.365, 0.365)] + [
        box(0.06, 0.67, 0.03, (0, y, 0.7)) for y in (-0.365, 0.365)
    ]
    holed = place_table(dataclasses.replace(table(), shape=shape_of(*sides)))
    top = holed.top.height_m
    start = start_of(asset_of(box(side, side, 0.05)), translation(0.0, 0.0, top + 0.03))
    if stays:
        rest = settle_single(start, holed, PHYSICS)
        assert rest.T_world_obj[:3, 3] == pytest.approx([0.0, 0.0, top + 0.025], abs=2e-5)
        assert rest.support_margin_mm > 1e3 * (side - 0.001) / 2
    else:
        with pytest.raises(SettleError) as caught:
            settle_single(start, holed, PHYSICS)
        assert caught.value.reason == "left_table"


def test_an_object_that_does_not_rest_in_time_says_how_fast_it_still_is():
    asset = asset_of(trimesh.creation.icosphere(subdivisions=2, radius=0.05))
    hurried = PHYSICS.model_copy(update={"max_settle_s": 0.1})
    with pytest.raises(SettleError, match=r"mm/s after 0\.1 s") as caught:
        settle_single(start_of(asset, translation(0, 0, TOP + 0.2)), TABLE, hurried)
    assert caught.value.reason == "not_at_rest"


def test_a_placed_object_is_not_simulated_and_not_moved():
    asset = asset_of(box(0.1, 0.1, 0.1))
    start = dataclasses.replace(start_of(asset, translation(0.1, 0.2, TOP + 0.05)), placed=True)
    rest = settle_single(start, TABLE, PHYSICS)
    assert rest.support == "placed"
    assert rest.settle_s == 0.0
    assert np.array_equal(rest.T_world_obj, start.T_world_obj)


def test_a_table_finer_than_the_simulator_takes_is_a_failure_with_its_counts():
    """PyBullet itself stops with `createCollisionShape failed`, which would end the worker."""
    asset = asset_of(box(0.1, 0.08, 0.2))
    many = np.tile(TABLE.mesh.vertices, (131_073 // len(TABLE.mesh.vertices) + 1, 1))
    uneven = dataclasses.replace(TABLE.top, convex=False)
    fine = dataclasses.replace(TABLE, mesh=Mesh(many, TABLE.mesh.faces), top=uneven)
    with pytest.raises(SettleError, match="takes 131072 and 174762") as error:
        settle_single(start_of(asset, translation(0.0, 0.0, TOP + 0.13)), fine, PHYSICS)
    assert error.value.reason == "table_too_fine"
