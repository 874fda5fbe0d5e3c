"""Several objects that fall together, against geometry and against each on its own."""

import dataclasses

import numpy as np
import pytest
import trimesh

from schemas.errors import SettleError
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, Settled
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box, table
from tests.physics.settling import effects_of, scene_of, settle_group, settle_single
from workers.geometry.frames import pose, rotation_about, translation
from workers.geometry.hull import convex_hull
from workers.physics import settle
from workers.physics.effects import called_for
from workers.physics.exact_rest import Rested
from workers.physics.settle import LEFT_ROOM, LEFT_TOP, Rest, settle_scene
from workers.physics.support import place_table

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


def test_one_that_starts_over_the_side_of_another_falls_off_it():
    """By 6 mm more than half its width."""
    rest = settle_group([start_of(CUBE, 0, 0, 0.031), start_of(CUBE, 0.036, 0.0, 0.0925)], TABLE, PHYSICS, ALL)
    assert heights_of(rest)[0] == pytest.approx(0.03, abs=5e-5)
    assert heights_of(rest)[1] < 0.07
    assert rest[1].T_world_obj[0, 3] > 0.06


def test_objects_far_apart_settle_each_as_it_would_alone_to_the_last_bit():
    lean = rotation_about(np.array([1.0, 0, 0]), 0.2)
    starts = [start_of(CUBE, -0.3, 0.0, 0.05, lean), start_of(asset_of(box(0.1, 0.05, 0.02)), 0.3, 0.1, 0.1, lean.T)]
    rest = scene(starts)
    assert rest.called == {}
    for start, each in zip(starts, rest.settled, strict=True):
        alone = settle_single(start, TABLE, PHYSICS)
        assert each.T_world_obj.tobytes() == alone.T_world_obj.tobytes()
        assert (each.settle_s, each.support) == (alone.settle_s, alone.support)


def test_far_apart_together_or_alone_is_the_same_within_the_simulations_gap():
    starts = [start_of(CUBE, x, 0.0, 0.04) for x in (-0.3, 0.3)]
    both = settle_group(starts, TABLE, PHYSICS, ALL)
    for start, each in zip(starts, both, strict=True):
        assert each.T_world_obj == pytest.approx(settle_single(start, TABLE, PHYSICS).T_world_obj, abs=5e-5)


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


def test_one_that_falls_off_the_table_is_named_by_its_region():
    starts = [start_of(CUBE, 0.0, 0.0, 0.04), dataclasses.replace(start_of(CUBE, 0.72, 0.0, 0.04), region_id=4)]
    with pytest.raises(SettleError, match="region 4") as caught:
        settle_group(starts, TABLE, PHYSICS, (*ALL, "table_mesh"))
    assert caught.value.reason == "left_table"


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


def test_what_does_not_rest_in_time_says_so():
    hurried = PHYSICS.model_copy(update={"max_settle_s": 0.1})
    with pytest.raises(SettleError) as caught:
        settle_group([start_of(CUBE, 0, 0, 0.04), start_of(CUBE, 0, 0, 0.2)], TABLE, hurried, ALL)
    assert caught.value.reason == "not_at_rest"


def test_the_same_starts_give_the_same_bits_whatever_was_simulated_before():
    starts = [start_of(CUBE, 0, 0, 0.031), start_of(CUBE, 0.01, 0.005, 0.12, rotation_about(np.eye(3)[2], 0.5))]
    first = settle_group(starts, TABLE, PHYSICS, ALL)
    settle_single(start_of(CUBE, 0, 0, 0.3, rotation_about(np.eye(3)[0], 0.7)), TABLE, PHYSICS)
    second = settle_group(starts, TABLE, PHYSICS, ALL)
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
    rest = settle_group([low, there], TABLE, PHYSICS, ALL)
    back = rest[1].T_world_obj @ np.linalg.inv(offset)
    assert back[2, 3] - TOP == pytest.approx(0.09, abs=5e-5)
    assert back[:2, 3] == pytest.approx([0.01, 0.0], abs=1e-3)


def test_what_is_set_down_in_balance_is_not_simulated_and_what_is_not_falls():
    """A cube on a cube, its middle 1 mm inside and outside of the other's edge."""
    for beyond_m, stays in ((-0.001, True), (0.001, False)):
        starts = [start_of(CUBE, 0, 0, 0.03 + 1e-5), start_of(CUBE, 0.03 + beyond_m, 0.0, 0.09 + 2e-5)]
        rest = settle_group(starts, TABLE, PHYSICS, ALL)
        assert (rest[0].settle_s == 0.0) == stays
        assert (heights_of(rest)[1] == pytest.approx(0.09, abs=1e-8)) == stays


def test_a_can_set_down_on_a_ridge_rolls_off_it():
    """Exactly balanced between two of its sides: a breath would move it."""
    can = asset_of(trimesh.creation.cylinder(0.03, 0.1, sections=24))
    lying = rotation_about(np.array([1.0, 0, 0]), np.pi / 2)
    rest = settle_single(start_of(can, 0, 0, 0.03, lying), TABLE, PHYSICS)
    assert heights_of((rest,)) == pytest.approx([0.03 * np.cos(np.pi / 24)], abs=1e-7)
    assert rest.support_margin_mm > 1.0


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
