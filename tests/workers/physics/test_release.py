"""What the simulator is told of a scene: the size of steps, and the settings of the effects that the plan runs."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart
from schemas.scene.shape import Asset
from tests.hard_cases.bodies import built_in, cube, rod
from tests.hard_cases.drops import X, turn
from tests.hard_cases.groups import put, stack, together, tray
from tests.kit.shapes import asset_of, box, table
from tests.physics.settling import recheck_group, settle_group
from workers.geometry.frames import pose
from workers.geometry.hull import convex_hull
from workers.physics.fall import FINEST, LOOK_STEPS, SAMPLE_STEPS, fall
from workers.physics.release import (
    CROWD,
    DOUBTFUL_RISE,
    KNOWN_RISE,
    MANY,
    MOST_RISE,
    PACES,
    PACES_MANY,
    PACES_TOGETHER,
    Drop,
    Pace,
    release,
    settings_of,
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


def seconds_to_rest(start: ObjectStart, names: tuple[str, ...], **changes) -> float:
    physics = PHYSICS.model_copy(update={"max_settle_s": 3.0, **changes})
    return release(Drop((start,), TABLE, physics, EffectPlan(names, {})), True, PACES).seconds


def test_a_cube_bounces_only_where_the_plan_runs_restitution():
    """From 0.2 m a restitution of 0.64 between the two makes it bounce for longer than the fall took."""
    start = start_of(CUBE, 0.0, 0.0, 0.23)
    still = seconds_to_rest(start, ("dynamics", "fine_step"))
    assert seconds_to_rest(start, ("dynamics", "fine_step"), restitution=0.8) == still
    assert seconds_to_rest(start, ("dynamics", "fine_step", "restitution"), restitution=0.8) > still + 0.202


def test_a_can_is_braked_against_rolling_only_where_the_plan_runs_rolling_friction():
    start = start_of(rod(0.033, 0.12, 360), 0.0, 0.0, 0.08, turn(X, 60) @ turn(np.array([0.0, 1.0, 0.0]), 20))
    rolling = ("dynamics", "fine_step", "rolling_friction")
    assert seconds_to_rest(start, rolling, rolling_friction=0.005) < 3.0
    assert seconds_to_rest(start, rolling[:2], rolling_friction=0.005) >= 3.0


def test_objects_as_boxes_keep_the_height_of_their_lowest_point_together_as_alone():
    """A tilted can's box reaches lower than the can: let go 1 mm above the table it would begin within the top."""
    tilted = turn(X, 40) @ turn(np.array([0.0, 0.0, 1.0]), 45)
    can = rod(0.03, 0.1)
    low = float((can.shape.vertices @ tilted.T)[:, 2].min())
    starts = [start_of(can, x, 0.0, 0.001 - low, tilted) for x in (-0.1, 0.1)]
    physics = PHYSICS.model_copy(update={"collision": "box", "max_settle_s": 0.01})
    plan = EffectPlan(("dynamics", "fine_step"), {})
    both = release(Drop(tuple(starts), TABLE, physics, plan), True, PACES_TOGETHER)
    alone = [release(Drop((start,), TABLE, physics, plan), True, PACES) for start in starts]
    for beside, one in zip(both.poses, alone, strict=True):
        assert beside[2, 3] == pytest.approx(one.poses[0][2, 3], abs=1e-4)


def falls_of(drop: Drop, rises: list[float], monkeypatch) -> list[tuple[float, int]]:
    """(rate over the job's, steps between looks) of one fall after the other, when energy rises by these shares of its bound."""
    falls, left = [], iter(rises)

    def risen(*given, **more):
        falls.append((given[4].base_hz / PHYSICS.step_hz, given[4].looked))
        return dataclasses.replace(fall(*given, **more), rise=next(left))

    monkeypatch.setattr("workers.physics.release.fall", risen)
    release(drop, True, drop.ways[0])
    return falls


def test_a_pace_has_its_share_of_the_rest_window_and_of_the_rest_speed():
    rest, other = PHYSICS.rest, settings_of(ALONE, Pace(window=0.1, speed=10.0)).rest
    assert other.window_s == pytest.approx(0.1 * rest.window_s)
    assert (other.speed_mm_s, other.spin_rad_s) == pytest.approx((10.0 * rest.speed_mm_s, 10.0 * rest.spin_rad_s))


@pytest.mark.parametrize("count", [MANY, CROWD - 1, CROWD, 100])
def test_a_crowd_falls_in_the_finest_steps_at_once_whatever_it_is_of(count):
    for drop in (ALONE, many_mugs()):
        paces = itertools.chain(*dataclasses.replace(drop, starts=ALONE.starts * count).ways)
        assert all(pace.rate == FINEST for pace in paces) == (count >= CROWD)


def test_a_tall_stack_rests_where_not_all_of_an_impulse_is_kept_and_sways_where_it_is():
    """Each of twenty-five cubes falls onto the one below, the highest by 12.5 mm, and slips by 0.1 mm at most."""
    group, physics = stack(*[cube(0.05)] * 25), PHYSICS.model_copy(update={"max_settle_s": 0.4})
    drop = Drop(group.starts, group.table, physics, EffectPlan(("dynamics", "fine_step", "object_contacts"), {}))
    paces = [dataclasses.replace(PACES_TOGETHER[-1], speed=1.0, kept=kept) for kept in (1.0, 0.85)]
    ends = [release(drop, True, (pace,)) for pace in paces]
    assert [end.rested for end in ends] == [False, True] and PACES_TOGETHER[-1].kept == 0.85
    moved = [T[:2, 3] - start.T_world_obj[:2, 3] for T, start in zip(ends[1].poses, group.starts, strict=True)]
    assert np.linalg.norm(moved, axis=1).max() < 5e-4


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


def test_a_doubtful_drop_is_looked_at_after_each_step_before_it_falls_in_shorter_ones(monkeypatch):
    first, second = ((pace.rate, LOOK_STEPS) for pace in PACES[:2])
    again = (PACES[0].rate, 1)
    assert falls_of(ALONE, [1.01 * DOUBTFUL_RISE, 0.99 * KNOWN_RISE], monkeypatch) == [first, again]
    assert falls_of(ALONE, [1.01 * DOUBTFUL_RISE, 1.01 * KNOWN_RISE, 0.0], monkeypatch) == [first, again, second]


def test_looks_at_the_energy_change_nothing_of_a_drop(monkeypatch):
    start = start_of(CUBE, 0.0, 0.0, 0.1, turn(X, 40) @ turn(np.array([0.0, 1.0, 0.0]), 25))
    drop = Drop((start,), TABLE, PHYSICS, EffectPlan(("dynamics", "fine_step"), {}))
    seldom = release(drop, True, PACES[:1])
    monkeypatch.setattr("workers.physics.release.LOOK_STEPS", 1)
    often = release(drop, True, PACES[:1])
    assert np.array_equal(often.poses[0], seldom.poses[0]) and often.seconds == seldom.seconds
    assert often.rise >= seldom.rise


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
