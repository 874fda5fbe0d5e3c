"""Which effects of motion a scene calls for, what a table offers to stand on, and how an object stands, in closed form."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from schemas.errors import StartError
from schemas.scene.scene import ObjectStart
from schemas.scene.shape import Asset, Mesh
from tests.hard_cases.bodies import ball, built_in, cube, rod
from tests.hard_cases.drops import level, table_of, turn
from tests.kit.contacts import box as box_mesh
from tests.kit.contacts import mesh_of
from tests.kit.shapes import asset_of, box, shape_of
from tests.physics.settling import PHYSICS, start_at
from workers.geometry.frames import angle_between, pose, rotation_about, transform, translation
from workers.geometry.hull import convex_hull
from workers.physics.effects import AT_REST, PREDICATES, called_for, is_convex, is_round, rooms_m
from workers.physics.support import (
    find_table_top,
    place_table,
    sample_elevation,
    snap_to_face,
    split_by_side,
    support_height,
    vertical_gap,
)

TABLE = level()
CUBE = cube(0.1)
X = np.array([1.0, 0.0, 0.0])


def start_of(asset: Asset, x: float = 0.0, y: float = 0.0, placed: bool = False) -> ObjectStart:
    return start_at(asset, translation(x, y, TABLE.top.height_m + 0.2), placed=placed)


def test_what_rests_on_a_stretch_that_it_rolls_over_is_round():
    """A prism of n sides climbs by 1 / cos(180 / n degrees) over an edge: 15 % for a hexagon, 2 % for sixteen sides."""
    R = rotation_about(np.array([0.6, 0.0, 0.8]), 0.7)
    for asset, expected in (
        (CUBE, False),
        (asset_of(box(0.1, 0.1, 0.1).subdivide().subdivide()), False),  # hundreds of triangles in six planes
        (rod(0.03, 0.1, 6), False),
        (rod(0.03, 0.1, 16), True),
        (rod(0.03, 0.1, 64), True),
        (asset_of(trimesh.creation.cone(0.03, 0.1, sections=32)), True),
        (ball(0.05, 2), True),
    ):
        assert is_round(convex_hull(asset.shape.vertices @ R.T), R @ asset.mass.com) == expected


def test_what_fills_its_hull_is_convex():
    for asset, expected in (
        (CUBE, True),
        (ball(0.05, 3), True),
        (asset_of(box(0.1, 0.1, 0.02, (0, 0, -0.01)), box(0.02, 0.1, 0.1, (-0.04, 0, 0.05))), False),
        (dataclasses.replace(CUBE, volume_m3=None), False),
        (dataclasses.replace(CUBE, volume_m3=0.999e-3), False),
    ):
        assert is_convex(start_of(asset)) == expected


def test_rooms_are_half_of_what_lies_between_the_balls_that_objects_may_turn_in():
    """Cubes of 0.1 m turn in balls of 0.0866 m; one of 0.2 m in one of 0.1732 m."""
    half = 0.05 * math.sqrt(3.0)
    starts = [start_of(CUBE), start_of(CUBE, 0.3, 0.4), start_of(cube(0.2), 0.0, -0.2)]
    near, far, mixed = (0.2 - 3 * half) / 2, (0.5 - 2 * half) / 2, (math.hypot(0.3, 0.6) - 3 * half) / 2
    assert rooms_m(starts) == pytest.approx([near, min(far, mixed), near])
    assert rooms_m(starts[:1]) == [math.inf]
    assert rooms_m(starts[:2]) == pytest.approx([far, far])


NEEDED = {
    "dynamics": ([start_of(CUBE)], [start_of(CUBE, placed=True)]),
    "table_mesh": ([start_of(CUBE, 0.66)], [start_of(CUBE, 0.6)]),
    "object_contacts": ([start_of(CUBE), start_of(CUBE, 0.19)], [start_of(CUBE), start_of(CUBE, 0.2)]),
    "decomposition": ([start_of(built_in("mug"), 0.66)], [start_of(built_in("mug"), 0.0)]),
    "fine_step": ([start_of(CUBE)], [start_of(CUBE, placed=True)]),
    "rolling_friction": ([start_of(CUBE), start_of(built_in("can"), 0.3)], [start_of(CUBE), start_of(CUBE, 0.3)]),
}


def test_an_effect_is_called_for_by_a_scene_that_needs_it_and_not_by_one_that_does_not():
    for name, (needs, does_not) in NEEDED.items():
        assert name in called_for(needs, TABLE, PHYSICS), name
        assert name not in called_for(does_not, TABLE, PHYSICS), name
        assert PREDICATES[name](does_not, TABLE, PHYSICS)  # and says why


def test_nothing_is_called_for_where_everything_is_placed_and_all_of_it_where_one_is_not():
    placed, free = start_of(CUBE, placed=True), start_of(CUBE, 0.66)
    assert called_for([placed, dataclasses.replace(placed)], TABLE, PHYSICS) == frozenset()
    assert {PREDICATES[name]([placed], TABLE, PHYSICS) for name in PREDICATES} == {AT_REST}
    assert {"dynamics", "table_mesh", "fine_step"} <= called_for([placed, free], TABLE, PHYSICS)


def test_a_table_with_a_rim_is_called_for_wherever_things_start():
    rim = [box(0.02, 1.4, 0.05, (x, 0, 0.025)) for x in (-0.69, 0.69)]
    tray = table_of(box(1.4, 1.4, 0.03, (0, 0, -0.015)), *rim)
    assert "table_mesh" in called_for([start_of(CUBE)], tray, PHYSICS)
    tilted = dataclasses.replace(start_of(CUBE), T_world_obj=pose(turn(X, 29.0), np.zeros(3)))
    assert "table_mesh" not in called_for([tilted], TABLE, PHYSICS)


# ---------------------------------------------------------------------------------------------- tables

SLAB = box_mesh((2, 2, 0.1))


def test_vertical_distances_are_known_and_no_point_on_a_shared_edge_is_missed():
    assert np.isfinite(sample_elevation(np.array([[0.3, 0.3], [0.0, 0.0], [1.0, 1.0]]), SLAB)).all()
    for gap in (-0.003, 0.0, 0.02):
        globe = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
        globe.apply_translation([0.2, 0.1, 0.05 - globe.bounds[0, 2] + gap])
        assert vertical_gap(mesh_of(globe), SLAB) == pytest.approx(gap, abs=1e-12)


def test_the_top_is_the_top_and_not_a_shelf_or_a_rim_and_a_table_without_a_level_face_is_refused():
    shelf, slab = box(1.0, 1.0, 0.02, (0, 0, 0.3)), box(1.2, 0.8, 0.03, (0.1, 0, 0.7))
    top = find_table_top(shape_of(shelf, slab, box(0.02, 0.8, 0.1, (0.69, 0, 0.765))))
    assert top.height_m == pytest.approx(0.715)
    assert top.centre == pytest.approx([0.1, 0.0])
    assert not top.convex  # the rim stands above it
    slope = box(1, 1, 0.1).apply_transform(trimesh.transformations.rotation_matrix(0.3, [1, 0.2, 0]))
    with pytest.raises(StartError) as caught:
        find_table_top(shape_of(slope))
    assert caught.value.reason == "no_table_top"


def test_the_support_is_the_highest_thing_below_also_between_the_points():
    both = mesh_of(trimesh.util.concatenate([box(1, 1, 0.02, (0, 0, -0.01)), box(0.02, 0.02, 0.1, (0, 0, 0.05))]))
    around = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    heights = [support_height(around + away, both) for away in (0.0, 0.3, 5.0)]
    assert heights == [pytest.approx(0.1), pytest.approx(0.0), -np.inf]


def test_the_sides_of_a_mesh_have_each_of_its_faces_once_and_one_direction_each():
    mesh = place_table(asset_of(box(0.4, 0.4, 0.03), box(0.02, 0.4, 0.1, (0.19, 0, 0.065)))).mesh
    flat = Mesh(mesh.vertices, np.concatenate([mesh.faces, [[0, 0, 1]]]).astype(np.int32))  # and one without area
    sides = [each.vertices[each.faces] for each in split_by_side(flat)]
    assert len(sides) == 6
    for corners in sides:
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        assert normals == pytest.approx(np.tile(normals[0], (len(normals), 1)))
    every, whole = (
        sorted(map(tuple, each.reshape(-1, 9))) for each in (np.concatenate(sides), mesh.vertices[mesh.faces])
    )
    assert every == whole


# ---------------------------------------------------------------------------------------------- standing


def test_a_slightly_tilted_cube_is_turned_flat_about_its_centre():
    hull = convex_hull(CUBE.shape.vertices)
    for tilt in (0.0, 0.001, -0.01, 0.019):
        T = pose(rotation_about(X, tilt), np.array([0.3, 0.2, 0.9]))
        snapped = snap_to_face(T, hull, np.zeros(3))
        assert snapped is not None
        assert np.sort(transform(snapped, hull.vertices)[:, 2])[:4] == pytest.approx(0.85, abs=1e-12)
        assert snapped[:3, 3] == pytest.approx(T[:3, 3], abs=1e-15)
        assert angle_between(T[:3, :3], snapped[:3, :3]) == pytest.approx(abs(tilt), abs=1e-12)


def test_a_face_without_the_centre_of_mass_over_it_is_not_chosen():
    """The small face's side is at 0.05."""
    slab = convex_hull(box(0.1, 0.1, 0.3).vertices)
    assert snap_to_face(np.eye(4), slab, np.array([0.08, 0.0, 0.0])) is None
    assert snap_to_face(np.eye(4), slab, np.array([0.04, 0.0, 0.0])) == pytest.approx(np.eye(4))
