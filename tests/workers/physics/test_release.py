"""What the simulator is told of a scene: the size of steps, and the settings of the effects that the plan runs.

What is let go again with the skins of its mesh: what rests stays, what does not goes, and rest is held.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart, Table
from schemas.scene.shape import Asset
from tests.hard_cases.bodies import built_in, cube
from tests.hard_cases.drops import Y, level, table_of, turn
from tests.hard_cases.groups import put, together, tray
from tests.kit.shapes import asset_of, box, table
from tests.physics.settling import recheck_group, settle_group
from workers.geometry.frames import motion_between, pose, translation
from workers.geometry.hull import convex_hull
from workers.physics import release as module
from workers.physics.fall import LOOK_STEPS, SAMPLE_STEPS, fall
from workers.physics.placement import Placement, forms_of, place
from workers.physics.release import (
    DOUBTFUL_RISE,
    FAR_M,
    HELD,
    KNOWN_RISE,
    MANY,
    MOST_HOLDS,
    MOST_RISE,
    PACES,
    PACES_MANY,
    PACES_TOGETHER,
    Drop,
    hold,
    let_go,
    release,
)
from workers.physics.support import place_table

PHYSICS = Job(name="t").physics
TABLE = place_table(table())
TOP = TABLE.top.height_m
ALL = ("dynamics", "fine_step", "object_contacts", "rolling_friction")
CUBE = asset_of(box(0.06, 0.06, 0.06))


def start_of(asset: Asset, x: float, y: float, z: float, R=None) -> ObjectStart:
    T = pose(np.eye(3) if R is None else R, np.array([x, y, TOP + z]))
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, T, 0, False)


@pytest.mark.parametrize(
    ("height_m", "side_m", "travel_m"), [(0.02, 0.06, 2e-3), (1.5, 0.06, 3e-3), (0.3, 0.006, 3e-4)]
)
def test_steps_are_as_fine_as_the_highest_fall_and_the_thinnest_object_ask(height_m, side_m, travel_m, monkeypatch):
    """For several 2 mm, or 0.002 of the fall if that is more, or 0.05 of the thinnest if that is less."""
    seen = []

    def told(*arguments, **more):
        seen.append(arguments[4])
        return fall(*arguments, **more)

    monkeypatch.setattr("workers.physics.release.fall", told)
    small = asset_of(box(side_m, side_m, side_m))
    starts = [start_of(CUBE, 0, 0, 0.031), start_of(small, 0.2, 0.0, height_m + side_m / 2)]
    settle_group(starts, TABLE, PHYSICS, ALL)
    assert [(steps.base_hz, pytest.approx(steps.max_travel_m)) for steps in seen] == [(PHYSICS.step_hz, travel_m)]


def falls_of(drop: Drop, rises: list[float], monkeypatch) -> list[tuple[float, int]]:
    """(rate over the job's, steps between looks) of one fall after the other, when energy rises by these shares of its bound."""
    falls, left = [], iter(rises)

    def risen(*given, **more):
        falls.append((given[4].base_hz / PHYSICS.step_hz, given[4].looked))
        return dataclasses.replace(fall(*given, **more), rise=next(left))

    monkeypatch.setattr("workers.physics.release.fall", risen)
    release(drop, True, drop.ways[0])
    return falls


BRIEF = PHYSICS.model_copy(update={"max_settle_s": 0.01})
ALONE = Drop((start_of(CUBE, 0, 0, 0.031),), TABLE, BRIEF, EffectPlan(("dynamics", "fine_step"), {}))


def test_what_gains_energy_falls_again_in_shorter_steps_until_it_gains_none(monkeypatch):
    both = dataclasses.replace(ALONE, starts=(start_of(CUBE, -0.2, 0, 0.031), start_of(CUBE, 0.2, 0, 0.031)))
    looked = [(pace.rate, LOOK_STEPS) for pace in PACES]
    together = [(pace.rate, SAMPLE_STEPS) for pace in PACES_TOGETHER]
    assert falls_of(ALONE, [0.99 * DOUBTFUL_RISE], monkeypatch) == looked[:1]
    assert falls_of(ALONE, [1.01 * KNOWN_RISE] * 2 + [0.0], monkeypatch) == looked[:3]
    assert falls_of(ALONE, [1.01 * KNOWN_RISE] * 9, monkeypatch) == looked
    assert falls_of(both, [0.99 * MOST_RISE], monkeypatch) == together[:1]
    assert falls_of(both, [1.01 * MOST_RISE] * 9, monkeypatch) == together
    assert falls_of(many_mugs(), [1.01 * MOST_RISE] * 9, monkeypatch) == [(PACES_MANY[0].rate, SAMPLE_STEPS)]


def many_mugs() -> Drop:
    starts = tuple(start_of(built_in("mug"), 0.2 * k - 0.3, 0.0, 0.06) for k in range(MANY))
    return Drop(starts, TABLE, BRIEF, EffectPlan(("dynamics", "fine_step", "object_contacts", "decomposition"), {}))


@pytest.mark.parametrize("gap_m", [0.0001, 0.0002, 0.00046])
def test_a_cube_beside_a_wall_that_is_let_go_again_keeps_all_four_of_its_corners_on_the_floor(gap_m):
    """Bullet keeps four contacts of two bodies, chosen for their area, up to millimetres away; those of a wall count."""
    table = tray()
    aside = turn(np.array([0.0, 0.0, 1.0]), 0.0785)
    wall_m = 0.025 * (math.cos(math.radians(0.0785)) + math.sin(math.radians(0.0785))) - 0.15
    beside, other = (
        put(cube(0.05), table, 0.0, (0.1187, wall_m + gap_m), aside),
        put(cube(0.05), table, 0.0, (0.118, -0.06)),
    )
    group = together(table, [beside, other])
    settled = settle_group(group.starts, table, PHYSICS)
    motions = recheck_group(group.starts, settled, table, PHYSICS)
    assert max(mm for mm, _ in motions) < 0.01
    assert max(degrees for _, degrees in motions) < 0.001


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


def beside(gap_m: float) -> tuple[tuple[ObjectStart, ...], Table]:
    """A cube on another, and a third so far beside them."""
    table = level()
    upright = [
        put(cube(0.05), table, 0.0),
        put(cube(0.05), table, 0.05),
        put(cube(0.05), table, 0.0, (0.05 + gap_m, 0.0)),
    ]
    return together(table, upright).starts, table


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
