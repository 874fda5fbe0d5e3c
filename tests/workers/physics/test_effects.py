"""Which effects of motion a scene calls for: scenes that need each and scenes that do not."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from schemas.job.assets import ProceduralSource
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box, shape_of, table
from workers.assets.builtin.make import make_asset
from workers.geometry.frames import pose, rotation_about, translation
from workers.geometry.hull import convex_hull
from workers.physics.effects import (
    AT_REST,
    PREDICATES,
    called_for,
    is_convex,
    is_round,
    rooms_m,
)
from workers.physics.support import place_table

PHYSICS = Job(name="t").physics
TABLE = place_table(table())
TOP = TABLE.top.height_m
CUBE = asset_of(box(0.1, 0.1, 0.1))


def start_of(asset: Asset, x: float = 0.0, y: float = 0.0, placed: bool = False) -> ObjectStart:
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, translation(x, y, TOP + 0.2), 0, placed)


def vessel(category: str) -> Asset:
    return make_asset(category, ProceduralSource(source="procedural", size="metric"), 0, 600.0)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (box(0.1, 0.1, 0.1), False),
        (box(0.1, 0.1, 0.1).subdivide().subdivide(), False),  # hundreds of triangles in six planes
        (trimesh.creation.cylinder(0.03, 0.1, sections=6), False),
        (trimesh.creation.cylinder(0.03, 0.1, sections=16), True),
        (trimesh.creation.cylinder(0.03, 0.1, sections=64), True),
        (trimesh.creation.cone(0.03, 0.1, sections=32), True),
        (trimesh.creation.icosphere(subdivisions=2, radius=0.05), True),
    ],
)
def test_what_rests_on_a_stretch_that_it_rolls_over_is_round(body, expected):
    """A prism of n sides climbs by 1 / cos(180 / n degrees) over an edge: 15 % for a hexagon, 2 % for sixteen sides."""
    turned = np.asarray(body.vertices) @ rotation_about(np.array([0.6, 0.0, 0.8]), 0.7).T
    com = rotation_about(np.array([0.6, 0.0, 0.8]), 0.7) @ np.asarray(body.center_mass)
    assert is_round(convex_hull(turned), com) == expected


@pytest.mark.parametrize(
    ("asset", "expected"),
    [
        (CUBE, True),
        (asset_of(trimesh.creation.icosphere(subdivisions=3, radius=0.05)), True),
        (asset_of(box(0.1, 0.1, 0.02, (0, 0, -0.01)), box(0.02, 0.1, 0.1, (-0.04, 0, 0.05))), False),
        (dataclasses.replace(CUBE, volume_m3=None), False),
        (dataclasses.replace(CUBE, volume_m3=0.999e-3), False),
    ],
)
def test_what_fills_its_hull_is_convex(asset, expected):
    assert is_convex(start_of(asset)) == expected


def test_rooms_are_half_of_what_lies_between_the_balls_that_objects_may_turn_in():
    """Cubes of 0.1 m turn in balls of 0.0866 m; one of 0.2 m in one of 0.1732 m."""
    half = 0.05 * math.sqrt(3.0)
    starts = [start_of(CUBE), start_of(CUBE, 0.3, 0.4), start_of(asset_of(box(0.2, 0.2, 0.2)), 0.0, -0.2)]
    near, far, mixed = (0.2 - 3 * half) / 2, (0.5 - 2 * half) / 2, (math.hypot(0.3, 0.6) - 3 * half) / 2
    assert rooms_m(starts) == pytest.approx([near, min(far, mixed), near])
    assert rooms_m(starts[:1]) == [math.inf]
    assert rooms_m(starts[:2]) == pytest.approx([far, far])


def test_no_two_objects_meet_within_their_rooms_however_they_turn():
    rng = np.random.default_rng(0)
    starts = [start_of(asset_of(box(*rng.uniform(0.02, 0.2, 3))), *rng.uniform(-0.5, 0.5, 2)) for _ in range(8)]
    for a, one, room in zip(range(8), starts, rooms_m(starts), strict=True):
        for b, other, its in zip(range(8), starts, rooms_m(starts), strict=True):
            reaches = [np.linalg.norm(s.hull.vertices - s.asset.mass.com, axis=1).max() for s in (one, other)]
            between = np.linalg.norm((one.T_world_obj - other.T_world_obj)[:2, 3])
            assert a == b or between - room - its >= sum(reaches) - 1e-12


CAN = vessel("can")
MUG = vessel("mug")
FAR = 0.3
"""Metres between two objects that cannot meet: two cubes need 0.19 and a mug and a cube less."""

NEEDED = {
    "dynamics": ([start_of(CUBE)], [start_of(CUBE, placed=True)]),
    "table_mesh": ([start_of(CUBE, 0.66)], [start_of(CUBE, 0.6)]),
    "object_contacts": ([start_of(CUBE), start_of(CUBE, 0.19)], [start_of(CUBE), start_of(CUBE, 0.2)]),
    "decomposition": ([start_of(MUG, 0.66)], [start_of(MUG, 0.0)]),
    "fine_step": ([start_of(CUBE)], [start_of(CUBE, placed=True)]),
    "rolling_friction": ([start_of(CUBE), start_of(CAN, FAR)], [start_of(CUBE), start_of(CUBE, FAR)]),
}


@pytest.mark.parametrize("name", NEEDED)
def test_an_effect_is_called_for_by_a_scene_that_needs_it_and_not_by_one_that_does_not(name):
    needs, does_not = NEEDED[name]
    assert name in called_for(needs, TABLE, PHYSICS)
    assert name not in called_for(does_not, TABLE, PHYSICS)
    assert PREDICATES[name](does_not, TABLE, PHYSICS)  # and says why


def test_nothing_is_called_for_where_everything_is_placed_and_all_of_it_where_one_is_not():
    placed, free = start_of(CUBE, placed=True), start_of(CUBE, 0.66)
    assert called_for([placed, dataclasses.replace(placed)], TABLE, PHYSICS) == frozenset()
    assert {PREDICATES[name]([placed], TABLE, PHYSICS) for name in PREDICATES} == {AT_REST}
    assert {"dynamics", "table_mesh", "fine_step"} <= called_for([placed, free], TABLE, PHYSICS)


def test_a_table_with_a_rim_is_called_for_wherever_things_start():
    rim = [box(0.02, 1.4, 0.05, (x, 0, 0.025)) for x in (-0.69, 0.69)]
    tray = place_table(dataclasses.replace(table(), shape=shape_of(box(1.4, 1.4, 0.03, (0, 0, -0.015)), *rim)))
    assert "table_mesh" in called_for([start_of(CUBE)], tray, PHYSICS)
    tilted = dataclasses.replace(start_of(CUBE), T_world_obj=pose(rotation_about(np.eye(3)[0], 0.5), np.zeros(3)))
    assert "table_mesh" not in called_for([tilted], TABLE, PHYSICS)
