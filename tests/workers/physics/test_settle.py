"""Several objects that fall together, against geometry and against each on its own.

From release to rest, against mechanics in closed form. Keys that choose what falls and whether it is corrected: each
does what it says, and the defaults stay as they were.
"""

import dataclasses

import numpy as np
import pytest
import trimesh

from schemas.errors import SettleError
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart, Settled
from schemas.scene.shape import Asset, Mesh
from tests.kit.shapes import asset_of, box, table
from tests.physics.settling import effects_of, recheck, scene_of, settle_group, settle_single
from workers.geometry.frames import pose, rotation_about, translation
from workers.geometry.hull import convex_hull
from workers.physics import settle
from workers.physics.effects import called_for
from workers.physics.exact_rest import Rested
from workers.physics.fall import FINEST, fall
from workers.physics.settle import (
    LEFT_ROOM,
    LEFT_TOP,
    RECHECK_RATE,
    RECHECK_S,
    Rest,
    release_again,
    settle_scene,
)
from workers.physics.support import place_table
from workers.scene.plan import SceneChance, draw_scene

PHYSICS = Job(name="t").physics
TABLE = place_table(table())
TOP = TABLE.top.height_m
ALL = ("dynamics", "fine_step", "object_contacts", "rolling_friction")
CUBE = asset_of(box(0.06, 0.06, 0.06))


def start_of(asset: Asset, x: float, y: float, z: float, R=None) -> ObjectStart:
    T = pose(np.eye(3) if R is None else R, np.array([x, y, TOP + z]))
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, T, 0, False)


def heights_of(rest: tuple[Settled, ...]) -> list[float]:
    return [float(each.T_world_obj[2, 3]) - TOP for each in rest]


def scene(starts: list[ObjectStart], physics=PHYSICS) -> Rest:
    """With what the scene calls for from its start."""
    return settle_scene(scene_of(starts, TABLE), physics, effects_of(starts, TABLE, physics))


def test_a_stack_of_two_stands_as_high_as_its_parts_and_knows_its_contacts():
    low, high = asset_of(box(0.1, 0.1, 0.04)), asset_of(box(0.06, 0.04, 0.1))
    rest = settle_group([start_of(low, 0, 0, 0.021), start_of(high, 0.01, 0, 0.092)], TABLE, PHYSICS, ALL)
    assert heights_of(rest) == pytest.approx([0.02, 0.09], abs=5e-5)
    assert [each.support_margin_mm for each in rest] == pytest.approx([50.0, 20.0], abs=0.5)
    assert max(each.equilibrium_residual for each in rest) < 1e-6
    assert max(each.penetration_mm + each.hover_gap_mm for each in rest) < 0.05
    assert {each.support for each in rest} == {"flat_top"}


def test_objects_far_apart_settle_each_as_it_would_alone_to_the_last_bit():
    lean = rotation_about(np.array([1.0, 0, 0]), 0.2)
    starts = [start_of(CUBE, -0.3, 0.0, 0.05, lean), start_of(asset_of(box(0.1, 0.05, 0.02)), 0.3, 0.1, 0.1, lean.T)]
    rest = scene(starts)
    assert rest.called == {}
    for start, each in zip(starts, rest.settled, strict=True):
        alone = settle_single(start, TABLE, PHYSICS)
        assert each.T_world_obj.tobytes() == alone.T_world_obj.tobytes()
        assert (each.settle_s, each.support) == (alone.settle_s, alone.support)


def test_contacts_are_called_for_after_all_where_a_ball_rolls_towards_another_object():
    """On facets of a coarse ball, let go above one of its edges: it rolls off by more than its room of 12 mm."""
    ball = asset_of(trimesh.creation.icosphere(subdivisions=2, radius=0.05))
    smooth = PHYSICS.model_copy(update={"rolling_friction": 0.0})
    R = rotation_about(np.array([0.0, 1.0, 0.0]), 0.1)
    apart = 0.05 + 0.05 + 2 * 0.012
    starts = [start_of(ball, 0, 0, 0.3, R), start_of(ball, apart, 0, 0.3, R)]
    assert "object_contacts" not in called_for(starts, TABLE, smooth)
    rest = scene(starts, smooth)
    assert rest.called == {"object_contacts": LEFT_ROOM}


def test_the_mesh_is_called_for_after_all_where_one_of_two_leaves_the_flat_top():
    """Of several that fall together it is told by where they come to rest: here a third of a cube is beyond the edge."""
    starts = [start_of(CUBE, -0.3, 0.0, 0.04), start_of(CUBE, 0.69, 0.0, 0.04)]
    assert "table_mesh" not in called_for([starts[0]], TABLE, PHYSICS)
    rest = settle_group(starts, TABLE, PHYSICS, ALL)
    assert {each.support for each in rest} == {"mesh"}
    assert rest[1].support_margin_mm == pytest.approx(10.0, abs=0.5)
    near = [start_of(CUBE, -0.3, 0.0, 0.04), start_of(CUBE, 0.65, 0.0, 0.1)]
    assert "table_mesh" not in called_for(near, TABLE, PHYSICS)
    assert scene(near).called == {"table_mesh": LEFT_TOP}


@pytest.mark.parametrize(("deep_m", "refused"), [(0.059, True), (0.002, True), (5e-5, False), (-1e-4, False)])
def test_objects_that_begin_inside_one_another_are_refused_and_not_thrown_apart(deep_m, refused):
    starts = [start_of(CUBE, 0, 0, 0.031), dataclasses.replace(start_of(CUBE, 0.06 - deep_m, 0.0, 0.031), region_id=4)]
    if refused:
        with pytest.raises(SettleError, match=f"regions 3 and 4 begin {deep_m * 1e3:.2f} mm") as caught:
            settle_group(starts, TABLE, PHYSICS, ALL)
        assert caught.value.reason == "objects_overlap"
    else:
        rest = settle_group(starts, TABLE, PHYSICS, ALL)
        assert rest[1].T_world_obj[0, 3] == pytest.approx(0.06 - deep_m, abs=1e-3)


def test_the_same_starts_give_the_same_bits_whatever_was_simulated_before():
    starts = [start_of(CUBE, 0, 0, 0.031), start_of(CUBE, 0.01, 0.005, 0.12, rotation_about(np.eye(3)[2], 0.5))]
    first = settle_group(starts, TABLE, PHYSICS, ALL)
    settle_single(start_of(CUBE, 0, 0, 0.3, rotation_about(np.eye(3)[0], 0.7)), TABLE, PHYSICS)
    second = settle_group(starts, TABLE, PHYSICS, ALL)
    assert [a.T_world_obj.tobytes() for a in first] == [b.T_world_obj.tobytes() for b in second]


def test_the_forces_of_a_pile_prove_its_balance():
    """Of every object they add to its weight, and two that touch press one another alike."""
    starts = [start_of(CUBE, 0.012 * k, 0.007 * (-1) ** k, 0.04 + 0.1 * k) for k in range(4)]
    rest = settle_group(starts, TABLE, PHYSICS, ALL)
    for each in rest:
        force = sum(contact.force for contact in each.contacts)
        assert force == pytest.approx([0, 0, CUBE.mass.mass_kg * 9.81], abs=1e-6)
        assert each.equilibrium_residual < 1e-6 and each.penetration_mm < 1e-6 and each.hover_gap_mm < 1e-6


def test_what_exact_rest_does_not_hold_is_refused(monkeypatch):
    """An object 0.02 mm above the table: the gate, whatever brought it there."""
    T = start_of(CUBE, 0, 0, 0.03 + 2e-5).T_world_obj
    monkeypatch.setattr(settle, "rest", lambda things, *_: Rested((T,), True, 0))
    with pytest.raises(
        SettleError, match=r"unsupported: it came to rest 0.020 mm from anything, with 100.0% of its weight"
    ):
        settle_single(start_of(CUBE, 0, 0, 0.03 + 2e-5), TABLE, PHYSICS)


def start_at(asset, T) -> ObjectStart:
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, T, 0, False)


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


def test_what_is_let_go_again_is_watched_to_the_end_however_still_it_stands(monkeypatch):
    start, watched = start_at(asset_of(box(0.1, 0.08, 0.2)), translation(0.0, 0.0, TOP + 0.11)), []
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


@pytest.mark.parametrize("rate", [RECHECK_RATE, FINEST])
@pytest.mark.parametrize(
    ("x_m", "up_m", "least_mm", "most_mm"),
    [(0.0, 0.0, 0.0, 1e-3), (0.0, 1.5e-4, 0.14, 0.16), (0.699, 0.0, 0.0, 1e-3), (0.701, 0.0, 0.2, 0.5)],
    ids=["on the table", "0.15 mm above it", "1 mm inside an overhang", "1 mm outside"],
)
def test_what_is_let_go_again_shows_whether_it_rested(x_m, up_m, least_mm, most_mm, rate):
    """A cube of 60 mm on a top that ends at 0.7 m; what tips is stopped once its centre of mass went 0.2 mm."""
    asset = asset_of(box(0.06, 0.06, 0.06))
    rest = settle_single(start_at(asset, translation(0.0, 0.0, TOP + 0.03)), TABLE, PHYSICS)
    T = translation(x_m, 0.0, TOP + 0.03 + up_m)
    moved_mm, _ = recheck(start_at(asset, T), dataclasses.replace(rest, T_world_obj=T), TABLE, PHYSICS, rate)
    assert least_mm <= moved_mm <= most_mm


def test_an_object_whose_frame_is_far_from_its_centre_of_mass_falls_the_same_way():
    here = asset_of(box(0.1, 0.08, 0.2))
    shifted = asset_of(box(0.1, 0.08, 0.2, (0.3, -0.2, 0.1)))
    R = rotation_about(np.array([0, 1.0, 0]), 0.05)
    a = settle_single(start_at(here, pose(R, np.array([0, 0, TOP + 0.12]))), TABLE, PHYSICS)
    offset = translation(-0.3, 0.2, -0.1)
    b = settle_single(
        start_at(shifted, pose(R, np.array([0, 0, TOP + 0.12])) @ offset),
        TABLE,
        PHYSICS,
    )
    # Two roundings of one drop that bounces on an edge differ by some tenths of a milliradian, and not by decimetres.
    assert b.T_world_obj @ np.linalg.inv(offset) == pytest.approx(a.T_world_obj, abs=2e-3)


def test_an_object_that_does_not_rest_in_time_says_how_fast_it_still_is():
    asset = asset_of(trimesh.creation.icosphere(subdivisions=2, radius=0.05))
    hurried = PHYSICS.model_copy(update={"max_settle_s": 0.1})
    with pytest.raises(SettleError, match=r"mm/s after 0\.1 s") as caught:
        settle_single(start_at(asset, translation(0, 0, TOP + 0.2)), TABLE, hurried)
    assert caught.value.reason == "not_at_rest"


def test_a_table_finer_than_the_simulator_takes_is_a_failure_with_its_counts():
    """PyBullet itself stops with `createCollisionShape failed`, which would end the worker."""
    asset = asset_of(box(0.1, 0.08, 0.2))
    many = np.tile(TABLE.mesh.vertices, (131_073 // len(TABLE.mesh.vertices) + 1, 1))
    uneven = dataclasses.replace(TABLE.top, convex=False)
    fine = dataclasses.replace(TABLE, mesh=Mesh(many, TABLE.mesh.faces), top=uneven)
    with pytest.raises(SettleError, match="takes 131072 and 174762") as error:
        settle_single(start_at(asset, translation(0.0, 0.0, TOP + 0.13)), fine, PHYSICS)
    assert error.value.reason == "table_too_fine"
