"""Several objects that fall together, against geometry and against each on its own."""

import dataclasses

import numpy as np
import pytest
import trimesh

from schemas.errors import SettleError
from schemas.job.job import Job
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart
from schemas.scene.scene import Settled
from schemas.scene.shape import Asset
from tests.shapes import asset_of, box, table
from workers.geometry.frames import pose, rotation_about, translation
from workers.geometry.hull import convex_hull
from workers.physics.effects import called_for
from workers.physics.fall import fall
from workers.physics.settle_group import settle_together
from workers.physics.settle_single import settle_alone
from workers.physics.step import LEFT_ROOM, LEFT_TOP, Rest, settle_scene
from workers.physics.table_top import place_table
from workers.plan.step import plan_scene

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
    plan = plan_scene(Job(name="t"), 0, table(), starts[0].asset)
    plan = dataclasses.replace(plan, table=TABLE, objects=tuple(starts))
    return settle_scene(plan, physics, EffectPlan(tuple(sorted(called_for(starts, TABLE, physics))), {}))


def test_a_stack_of_two_stands_as_high_as_its_parts_and_knows_its_contacts():
    low, high = asset_of(box(0.1, 0.1, 0.04)), asset_of(box(0.06, 0.04, 0.1))
    rest = settle_together([start_of(low, 0, 0, 0.021), start_of(high, 0.01, 0, 0.092)], TABLE, PHYSICS, ALL)
    assert heights_of(rest) == pytest.approx([0.02, 0.09], abs=5e-5)
    assert [each.support_margin_mm for each in rest] == pytest.approx([50.0, 20.0], abs=0.5)
    assert max(each.equilibrium_residual for each in rest) < 1e-6
    assert max(each.penetration_mm + each.hover_gap_mm for each in rest) < 0.05
    assert {each.support for each in rest} == {"flat_top"}


def test_one_that_starts_over_the_side_of_another_falls_off_it():
    """By 6 mm more than half its width."""
    rest = settle_together([start_of(CUBE, 0, 0, 0.031), start_of(CUBE, 0.036, 0.0, 0.0925)], TABLE, PHYSICS, ALL)
    assert heights_of(rest)[0] == pytest.approx(0.03, abs=5e-5)
    assert heights_of(rest)[1] < 0.07
    assert rest[1].T_world_obj[0, 3] > 0.06


def test_objects_far_apart_settle_each_as_it_would_alone_to_the_last_bit():
    lean = rotation_about(np.array([1.0, 0, 0]), 0.2)
    starts = [start_of(CUBE, -0.3, 0.0, 0.05, lean), start_of(asset_of(box(0.1, 0.05, 0.02)), 0.3, 0.1, 0.1, lean.T)]
    rest = scene(starts)
    assert rest.called == {}
    for start, each in zip(starts, rest.settled, strict=True):
        alone = settle_alone(start, TABLE, PHYSICS)
        assert each.T_world_obj.tobytes() == alone.T_world_obj.tobytes()
        assert (each.settle_s, each.support) == (alone.settle_s, alone.support)


def test_far_apart_together_or_alone_is_the_same_within_the_simulations_gap():
    starts = [start_of(CUBE, x, 0.0, 0.04) for x in (-0.3, 0.3)]
    both = settle_together(starts, TABLE, PHYSICS, ALL)
    for start, each in zip(starts, both, strict=True):
        assert each.T_world_obj == pytest.approx(settle_alone(start, TABLE, PHYSICS).T_world_obj, abs=5e-5)


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
    starts = [start_of(CUBE, -0.3, 0.0, 0.04), start_of(CUBE, 0.669, 0.0, 0.2, rotation_about(np.eye(3)[1], 0.4))]
    assert "table_mesh" not in called_for([starts[0]], TABLE, PHYSICS)
    rest = settle_together(starts, TABLE, PHYSICS, ALL)
    assert {each.support for each in rest} == {"mesh"}
    near = [start_of(CUBE, -0.3, 0.0, 0.04), start_of(CUBE, 0.65, 0.0, 0.1)]
    assert "table_mesh" not in called_for(near, TABLE, PHYSICS)
    assert scene(near).called == {"table_mesh": LEFT_TOP}


def test_one_that_falls_off_the_table_is_named_by_its_region():
    starts = [start_of(CUBE, 0.0, 0.0, 0.04), dataclasses.replace(start_of(CUBE, 0.72, 0.0, 0.04), region_id=4)]
    with pytest.raises(SettleError, match="region 4") as caught:
        settle_together(starts, TABLE, PHYSICS, (*ALL, "table_mesh"))
    assert caught.value.reason == "left_table"


@pytest.mark.parametrize(("deep_m", "refused"), [(0.059, True), (0.002, True), (5e-5, False), (-1e-4, False)])
def test_objects_that_begin_inside_one_another_are_refused_and_not_thrown_apart(deep_m, refused):
    starts = [start_of(CUBE, 0, 0, 0.031), dataclasses.replace(start_of(CUBE, 0.06 - deep_m, 0.0, 0.031), region_id=4)]
    if refused:
        with pytest.raises(SettleError, match=f"regions 3 and 4 begin {deep_m * 1e3:.2f} mm") as caught:
            settle_together(starts, TABLE, PHYSICS, ALL)
        assert caught.value.reason == "objects_overlap"
    else:
        rest = settle_together(starts, TABLE, PHYSICS, ALL)
        assert rest[1].T_world_obj[0, 3] == pytest.approx(0.06 - deep_m, abs=1e-3)


@pytest.mark.parametrize(("height_m", "side_m", "way_m"), [(0.02, 0.06, 5e-5), (0.3, 0.06, 6e-4), (0.3, 0.006, 3e-4)])
def test_steps_are_as_fine_as_the_highest_fall_and_the_thinnest_object_ask(height_m, side_m, way_m, monkeypatch):
    """0.05 mm, or 0.002 of the fall if that is more, or 0.05 of the thinnest if that is less."""
    seen = []

    def told(*arguments):
        seen.append(arguments[4])
        return fall(*arguments)

    monkeypatch.setattr("workers.physics.settle_group.fall", told)
    small = asset_of(box(side_m, side_m, side_m))
    starts = [start_of(CUBE, 0, 0, 0.031), start_of(small, 0.2, 0.0, height_m + side_m / 2)]
    settle_together(starts, TABLE, PHYSICS, ALL)
    assert [(pace.slowest_hz, pytest.approx(pace.way_m)) for pace in seen] == [(PHYSICS.step_hz, way_m)]


def test_what_does_not_rest_in_time_says_so():
    hurried = PHYSICS.model_copy(update={"max_settle_s": 0.1})
    with pytest.raises(SettleError) as caught:
        settle_together([start_of(CUBE, 0, 0, 0.04), start_of(CUBE, 0, 0, 0.2)], TABLE, hurried, ALL)
    assert caught.value.reason == "not_at_rest"


def test_the_same_starts_give_the_same_bits_whatever_was_simulated_before():
    starts = [start_of(CUBE, 0, 0, 0.031), start_of(CUBE, 0.01, 0.005, 0.12, rotation_about(np.eye(3)[2], 0.5))]
    first = settle_together(starts, TABLE, PHYSICS, ALL)
    settle_alone(start_of(CUBE, 0, 0, 0.3, rotation_about(np.eye(3)[0], 0.7)), TABLE, PHYSICS)
    second = settle_together(starts, TABLE, PHYSICS, ALL)
    assert [a.T_world_obj.tobytes() for a in first] == [b.T_world_obj.tobytes() for b in second]


def test_an_object_hollow_to_the_side_takes_another_in_only_in_parts():
    """A U on its side, 60 mm open, with a cube of 40 mm let go within it: a hull would throw it out."""
    walls = [box(0.1, 0.1, 0.01, (0, 0, z)) for z in (0.005, 0.085)]
    back = box(0.01, 0.1, 0.07, (-0.045, 0, 0.045))
    hollow = asset_of(*walls, back)
    starts = [start_of(hollow, 0, 0, 0.0005), start_of(asset_of(box(0.04, 0.04, 0.04)), 0.01, 0, 0.0315)]
    assert "decomposition" in called_for(starts, TABLE, PHYSICS)
    rest = scene(starts)
    assert heights_of(rest.settled)[1] == pytest.approx(0.03, abs=5e-5)


def test_an_origin_away_from_the_centre_of_mass_changes_nothing():
    shifted = asset_of(box(0.06, 0.06, 0.06, (0.2, -0.1, 0.05)))
    offset = translation(-0.2, 0.1, -0.05)
    low, high = start_of(CUBE, 0, 0, 0.031), start_of(CUBE, 0.01, 0, 0.0925)
    there = dataclasses.replace(start_of(shifted, 0, 0, 0), T_world_obj=high.T_world_obj @ offset)
    rest = settle_together([low, there], TABLE, PHYSICS, ALL)
    back = rest[1].T_world_obj @ np.linalg.inv(offset)
    assert back[2, 3] - TOP == pytest.approx(0.09, abs=5e-5)
    assert back[:2, 3] == pytest.approx([0.01, 0.0], abs=1e-3)
