"""MuJoCo as a referee: what rests stays, what does not falls, and what stands for each object is told."""

import dataclasses

import numpy as np
import pytest

from schemas.scene.scene import Settled
from services.read.referee import Held, describe_held, hold_scene
from tests.hard_cases.bodies import built_in, cube
from tests.hard_cases.drops import level
from tests.hard_cases.groups import Group, put, stack, together, tray
from tests.physics.settling import PHYSICS, scene_of


def held(group: Group, *moved: tuple[float, float, float]) -> Held | None:
    """The group held from where it starts, its objects moved first."""
    pytest.importorskip("mujoco")
    settled = []
    for start, by in zip(group.starts, moved, strict=True):
        T = np.array(start.T_world_obj)
        T[:3, 3] += by
        settled.append(Settled(T, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, "mesh"))
    return hold_scene(scene_of(group.starts, group.table), settled, PHYSICS)


def test_two_cubes_that_rest_stay_to_some_micrometres():
    found = held(stack(cube(0.05), cube(0.05)), (0.0, 0.0, -0.0005), (0.0, 0.0, -0.001))
    assert found is not None
    assert found.moved_mm < 0.02 and found.turned_deg < 0.01
    assert found.scenes == 1 and found.shapes == {"as meshes, being convex": 2}


def test_a_cube_in_the_air_falls_by_its_height():
    found = held(stack(cube(0.05)), (0.0, 0.0, 0.0995))
    assert found is not None and found.moved_mm == pytest.approx(100.0, abs=0.1)


def test_a_cube_beyond_the_edge_of_another_falls():
    found = held(stack(cube(0.05), cube(0.05)), (0.0, 0.0, -0.0005), (0.03, 0.0, -0.001))
    assert found is not None and found.moved_mm > 10.0


def test_a_mug_is_held_as_its_parts():
    group = together(level(), [put(built_in("mug"), level(), 0.0)])
    found = held(group, (0.0, 0.0, 0.0))
    assert found is not None and found.moved_mm < 0.02
    assert found.shapes == {"as parts from their making, not being convex": 1}


def test_a_table_that_is_not_convex_is_not_held():
    table = tray()
    assert held(together(table, [put(cube(0.05), table, 0.0)]), (0.0, 0.0, 0.0)) is None


def test_held_scenes_join_to_the_larger_motion_and_the_sum_of_shapes():
    one, other = (Held(x, 1.0 - x, 1, {"a": 1}) for x in (0.25, 0.75))
    assert one.join(other) == Held(0.75, 0.75, 2, {"a": 2})
    assert dataclasses.asdict(one)["shapes"] == {"a": 1}


def test_the_line_of_an_audit_says_the_figures_and_what_was_held_or_that_nothing_was():
    line = describe_held(Held(0.0123, 0.5, 3, {"as meshes, being convex": 4}))
    assert "held 3 scenes for 1 s: moved at most 0.0123 mm, turned at most 0.50000 degrees" in line
    assert "(4 objects as meshes, being convex)" in line
    assert "not installed" in describe_held(None) and "not convex" in describe_held(Held())
