"""What rests stays where it is in another engine, and what does not falls."""

import pytest

from tests.hard_cases.bodies import built_in, cube
from tests.hard_cases.drops import level
from tests.hard_cases.groups import Group, put, stack, together, tray
from tests.judge.referee import hold_scene
from tests.physics.settling import PHYSICS, scene_of
from workers.geometry.frames import translation


def held(group: Group, *moved_m: tuple[float, float, float]) -> tuple[float, float] | None:
    """Motion, mm, and turn, degrees, of the group held from where it starts, its objects moved first."""
    poses = [translation(*by) @ start.T_world_obj for start, by in zip(group.starts, moved_m, strict=True)]
    return hold_scene(scene_of(group.starts, group.table), poses, PHYSICS)


@pytest.mark.minute
def test_what_rests_stays_to_some_micrometres_and_what_does_not_falls():
    cubes = stack(cube(0.05), cube(0.05))
    moved_mm, turned_deg = held(cubes, (0.0, 0.0, -0.0005), (0.0, 0.0, -0.001))
    assert moved_mm < 0.02 and turned_deg < 0.01
    assert held(stack(cube(0.05)), (0.0, 0.0, 0.0995))[0] == pytest.approx(100.0, abs=0.1)  # in the air
    assert held(cubes, (0.0, 0.0, -0.0005), (0.03, 0.0, -0.001))[0] > 10.0  # beyond the edge
    assert held(together(level(), [put(built_in("mug"), level(), 0.0)]), (0.0, 0.0, 0.0))[0] < 0.02
    table = tray()  # not convex
    assert held(together(table, [put(cube(0.05), table, 0.0)]), (0.0, 0.0, 0.0)) is None
