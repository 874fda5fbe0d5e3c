"""What is let go again with the skins of its mesh: what rests stays, what does not goes, and rest is held."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart, Table
from tests.hard_cases.bodies import built_in, cube
from tests.hard_cases.drops import Y, level, table_of, turn
from tests.hard_cases.groups import put, together
from tests.kit.shapes import asset_of, box
from tests.physics.settling import settle_group
from workers.geometry.frames import motion_between, transform, translation
from workers.physics import release as module
from workers.physics.exact_rest import Rested, rest
from workers.physics.fall import Outcome
from workers.physics.placement import Placement, forms_of, place
from workers.physics.release import FAR_M, HELD, MOST_HOLDS, Drop, hold, let_go

PHYSICS = Job(name="t").physics
"""A friction of 0.7, so that a contact's is 0.49: the angle of friction is 26.1 degrees."""

HELD_M = HELD[0][2]

PLAN = EffectPlan(("dynamics", "fine_step", "object_contacts"), {})


def let_go_for(seconds: float, starts: Sequence[ObjectStart], table: Table) -> float:
    """Metres that the farthest point moves in this time."""
    rests = PHYSICS.rest.model_copy(update={"window_s": 2.0 * seconds})
    drop, placement = released(starts, table, PHYSICS.model_copy(update={"max_settle_s": seconds, "rest": rests}))
    poses = [one.T_world_obj for one in starts]
    after = let_go(drop, placement, poses)
    return max(motion_between(one.hull.vertices, *T)[0] for one, *T in zip(starts, poses, after, strict=True))


def released(starts: Sequence[ObjectStart], table: Table, physics=PHYSICS) -> tuple[Drop, Placement]:
    poses = [one.T_world_obj for one in starts]
    placement = place(starts, poses, forms_of(starts), table, physics.friction**2)
    return Drop(tuple(starts), table, physics, PLAN), placement


def overhanging(by_m: float) -> tuple[tuple[ObjectStart, ...], Table]:
    """A plank of 120 mm on a cube of 50: its centre of mass so far beyond the cube's edge."""
    table = level()
    plank = put(asset_of(box(0.12, 0.04, 0.02)), table, 0.05, (0.025 + by_m, 0.0))
    return together(table, [put(cube(0.05), table, 0.0), plank]).starts, table


def test_a_plank_stays_with_its_centre_of_mass_a_millimetre_inside_an_edge_and_falls_with_it_outside():
    assert let_go_for(0.5, *overhanging(-0.001)) < HELD_M
    assert let_go_for(0.5, *overhanging(0.001)) > FAR_M


def leaning(degrees: float) -> tuple[tuple[ObjectStart, ...], Table]:
    """A cube on the side of a ramp that falls by so much, with a second one at its upper end."""
    ramp = box(0.6, 0.3, 0.02, (0.0, 0.0, -0.01))
    ramp.apply_transform(np.block([[turn(Y, degrees), np.zeros((3, 1))], [0.0, 0.0, 0.0, 1.0]]))
    table = table_of(ramp, box(0.05, 0.05, 0.02, (0.0, 0.4, 0.3)))
    shift = table.mesh.vertices[:8].mean(axis=0) - ramp.vertices.mean(axis=0)
    up = turn(Y, degrees) @ np.array([0.0, 0.0, 0.025])
    starts = []
    for along_m in (-0.1, 0.1):
        start = put(cube(0.05), table, 0.0, R=turn(Y, degrees))
        centre = shift + turn(Y, degrees) @ np.array([along_m, 0.0, 0.0]) + up
        T = translation(*(centre - start.T_world_obj[:3, 3])) @ start.T_world_obj
        starts.append(dataclasses.replace(start, T_world_obj=T))
    return together(table, starts).starts, table


def test_cubes_stay_on_a_ramp_a_degree_below_the_angle_of_friction_and_slide_on_one_a_degree_above():
    assert let_go_for(0.3, *leaning(25.1)) < HELD_M
    assert let_go_for(0.3, *leaning(27.1)) > FAR_M


def test_a_small_cube_in_a_hollow_stays_where_exact_rest_puts_it():
    """In a bowl, whose parts and whose hull would push it out."""
    table = level()
    bowl = put(built_in("bowl"), table, 0.0)
    inner = float(transform(bowl.T_world_obj, bowl.asset.shape.vertices)[:, 2].max()) - table.top.height_m
    starts = together(table, [bowl, put(cube(0.02), table, inner + 0.002)]).starts
    settled = settle_group(starts, table, PHYSICS)
    at = [dataclasses.replace(one, T_world_obj=rest.T_world_obj) for one, rest in zip(starts, settled, strict=True)]
    assert let_go_for(0.25, at, table) < 1e-4
    lifted = dataclasses.replace(at[1], T_world_obj=translation(0.0, 0.0, 3e-4) @ at[1].T_world_obj)
    assert let_go_for(0.25, [at[0], lifted], table) > 1e-4


def test_a_lid_on_level_ground_stands_on_the_corners_of_its_rim_and_what_is_within_it_meets_none_of_them():
    table = level()
    walls = [box(0.005, 0.1, 0.03, (x, 0.0, 0.015)) for x in (-0.05, 0.05)]
    walls += [box(0.1, 0.005, 0.03, (0.0, y, 0.015)) for y in (-0.05, 0.05)]
    lid = put(asset_of(*walls, box(0.105, 0.105, 0.01, (0.0, 0.0, 0.035))), table, 0.0)
    starts = together(table, [lid, put(asset_of(box(0.02, 0.02, 0.03 - FAR_M)), table, 0.0)]).starts
    assert let_go_for(0.1, starts, table) < HELD_M
    lifted = dataclasses.replace(starts[0], T_world_obj=translation(0.0, 0.0, 1e-4) @ starts[0].T_world_obj)
    assert let_go_for(0.1, [lifted, starts[1]], table) == pytest.approx(1e-4, abs=HELD_M)


def hanging() -> tuple[tuple[ObjectStart, ...], Table]:
    """A cube of 50 mm in a slot of 50 mm, 20 mm above its floor, and one that lies beside the slot."""
    walls = [box(0.02, 0.3, 0.1, (x, 0.0, 0.05)) for x in (-0.035, 0.035)]
    table = table_of(box(0.4, 0.4, 0.03, (0.0, 0.0, -0.015)), *walls)
    floor = float(np.sort(np.unique(np.round(table.mesh.vertices[:, 2], 9)))[1]) - table.top.height_m
    starts = [put(cube(0.05), table, floor + 0.02), put(cube(0.05), table, floor, (0.12, 0.0))]
    return together(table, starts).starts, table


def test_what_friction_could_hold_but_does_not_is_balanced_and_falls_when_it_is_let_go(monkeypatch):
    """Walls that squeeze the cube hard enough would hold it, and nothing squeezes it."""
    starts, table = hanging()
    drop, placement = released(starts, table)
    poses = [one.T_world_obj for one in starts]
    rested = rest(placement.things, poses, placement.forms[-1].surface, placement.friction)
    assert rested.still and np.abs(np.subtract(rested.poses, poses)).max() < 1e-6
    assert let_go_for(0.25, starts, table) > FAR_M
    assert not hold(drop, placement, poses).still


def beside(gap_m: float) -> tuple[tuple[ObjectStart, ...], Table]:
    """A cube on another, and a third so far beside them."""
    table = level()
    upright = [
        put(cube(0.05), table, 0.0),
        put(cube(0.05), table, 0.05),
        put(cube(0.05), table, 0.0, (0.05 + gap_m, 0.0)),
    ]
    return together(table, upright).starts, table


@pytest.mark.parametrize(
    ("gap_m", "all_of_them", "aslant"),
    [(2.5 * FAR_M, [(0, 1), (2,)], []), (1.5 * FAR_M, [(0, 1, 2)], [(0, 1, 2)])],
)
def test_what_cannot_meet_is_let_go_on_its_own_and_what_stands_on_level_faces_alone_need_not_be_held(
    gap_m, all_of_them, aslant, monkeypatch
):
    starts, table = beside(gap_m)
    drop, placement = released(starts, table)
    poses, seen = [one.T_world_obj for one in starts], []

    def told(drop, placement, poses, far_m, level_rate):
        seen.append(tuple(starts.index(one) for one in drop.starts))
        assert placement.starts == drop.starts and len(poses) == len(drop.starts)
        return Outcome(tuple(poses), 0.0, 0.1, rested=True)

    monkeypatch.setattr(module, "_let_go", told)
    let_go(drop, placement, poses)
    assert seen == all_of_them
    seen.clear()
    assert hold(drop, placement, poses).still
    assert seen == aslant


@pytest.mark.parametrize("slips", [0, 1, MOST_HOLDS - 1, MOST_HOLDS])
def test_what_slips_comes_to_rest_where_it_went_until_it_stays(slips, monkeypatch):
    """The upper of two cubes slips by twice the bound along x, so many times; it is let go from there the next time."""
    table = level()
    starts = together(table, [put(cube(0.05), table, 0.0), put(cube(0.04), table, 0.05)]).starts
    drop, placement = released(starts, table)
    left, seen = [slips], []

    def slip(_drop, _placement, poses, _far_m, level):
        assert not level
        seen.append(poses[1][0, 3])
        left[0] -= 1
        by_m = 2.0 * HELD_M if left[0] >= 0 else 0.5 * HELD_M
        return poses[0], translation(by_m, 0.0, 0.0) @ poses[1]

    monkeypatch.setattr(module, "let_go", slip)
    held = hold(drop, placement, [one.T_world_obj for one in starts])
    assert held.still == (slips < MOST_HOLDS)
    assert held.poses[1][0, 3] == pytest.approx(2.0 * HELD_M * slips, abs=1e-9)
    assert seen == pytest.approx([2.0 * HELD_M * k for k in range(min(slips + 1, MOST_HOLDS))], abs=1e-9)


def test_what_never_comes_to_exact_rest_is_not_let_go(monkeypatch):
    starts, table = beside(0.1)
    drop, placement = released(starts, table)
    far = tuple(translation(1.0, 0.0, 0.0) @ one.T_world_obj for one in starts)
    monkeypatch.setattr(module, "rest", lambda *_: Rested(far, False, 160))
    monkeypatch.setattr(module, "let_go", lambda *_, **__: pytest.fail("let go"))
    held = hold(drop, placement, [one.T_world_obj for one in starts])
    assert held.poses is far and not held.still
