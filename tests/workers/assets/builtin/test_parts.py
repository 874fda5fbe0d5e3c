"""Cutting a solid into parts: nothing opens, normals and texture coordinates are where they belong."""

import math

import numpy as np
import pytest

from schemas.scene.shape import Material
from tests.workers.assets.oracles import welded
from workers.assets.builtin.parts import Surface, cut_into_parts, turn_about_z
from workers.assets.builtin.solid import lathe, union
from workers.assets.builtin.sweeps import bevelled_profile, prism

PLAIN, PICTURE = Material(), Material(texture=np.zeros((2, 2, 3), dtype=np.uint8))


def cylinder(surface=(0, 1, 2), count=32):
    return lathe(np.array([[0, 0], [0.1, 0], [0.1, 0.4], [0, 0.4]]), surface, count)


def named(*wraps, **more):
    pairs = [(PLAIN, "cylinder") if wrap == "none" else (PICTURE, wrap) for wrap in wraps]
    return [Surface(f"s{k}", *pair, **more) for k, pair in enumerate(pairs)]


def test_parts_share_the_very_same_points_so_that_together_they_are_closed():
    shape = cut_into_parts(cylinder(), named("none", "none", "none"), np.array([0.0, 0, 0.2]), 0.7)
    assert [part.name for part in shape.parts] == ["s0", "s1", "s2"]
    whole = welded(shape)
    assert whole.is_watertight
    assert shape.bounds == pytest.approx(np.array([[-0.07, -0.07, -0.14], [0.07, 0.07, 0.14]]))


def test_a_surface_that_nothing_has_makes_no_part():
    shape = cut_into_parts(cylinder((0, 2, 0)), named("none", "none", "none"), np.zeros(3), 1.0)
    assert [part.name for part in shape.parts] == ["s0", "s2"]


def test_normals_of_a_wall_point_away_from_the_axis_and_of_a_lid_up():
    base, wall, lid = cut_into_parts(cylinder(), named("none", "none", "none"), np.zeros(3), 1.0).parts
    radial = wall.vertices * [1, 1, 0] / 0.1
    assert wall.normals == pytest.approx(radial, abs=1e-12)
    assert lid.normals == pytest.approx(np.tile([0, 0, 1.0], (len(lid.vertices), 1)))
    assert base.normals == pytest.approx(np.tile([0, 0, -1.0], (len(base.vertices), 1)))


def test_a_cylinder_is_wrapped_once_with_a_seam_and_no_smear():
    wraps = named("none", "cylinder", "none", low=0.0, high=0.4)
    base, wall, _ = cut_into_parts(cylinder(), wraps, np.zeros(3), 1.0).parts
    assert base.uv is None  # its material has no texture
    assert wall.uv.min(axis=0) == pytest.approx([0, 0])
    assert wall.uv.max(axis=0) == pytest.approx([1, 1])
    across = wall.uv[wall.faces][:, :, 0]
    assert np.ptp(across, axis=1) == pytest.approx(np.full(64, 1 / 32), abs=1e-9)  # no face goes back over the picture
    angle = np.arctan2(wall.vertices[:, 1], wall.vertices[:, 0]) / (2 * np.pi)
    assert np.exp(2j * np.pi * wall.uv[:, 0]) == pytest.approx(np.exp(2j * np.pi * angle), abs=1e-9)
    assert len(wall.vertices) == 64 + 2


def test_a_plane_is_laid_by_its_two_vectors():
    wrap = {"origin": (-0.1, -0.1, 0.0), "across": (0.2, 0.0, 0.0), "up": (0.0, 0.2, 0.0)}
    lid = cut_into_parts(cylinder(), named("none", "none", "plane", **wrap), np.zeros(3), 1.0).parts[2]
    assert lid.uv == pytest.approx((lid.vertices[:, :2] + 0.1) / 0.2)


@pytest.mark.parametrize(("grain", "sides"), [(0, {0: 1, 1: 0, 2: 0}), (2, {0: 2, 1: 2, 2: 0})])
def test_grain_runs_along_its_axis_on_every_side(grain, sides):
    solid = prism(bevelled_profile(0.3, 0.01), (0.4, 0.2), 0.01, [0] * 5)
    part = cut_into_parts(solid, named("box", size=0.4, grain=grain), np.zeros(3), 1.0).parts[0]
    corners = part.vertices[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    low = solid.vertices.min(axis=0)
    for axis, along in sides.items():
        flat = np.abs(normals[:, axis]) / np.linalg.norm(normals, axis=1) > 0.999
        index = part.faces[flat]
        assert part.uv[index][:, :, 0] == pytest.approx((part.vertices[index][:, :, along] - low[along]) / 0.4)


def test_a_joined_solid_is_still_closed_after_cutting():
    joined = union([cylinder((0, 0, 0)), cylinder((1, 1, 1)).moved(x=0.05, z=0.1)])
    shape = cut_into_parts(joined, named("box", "cylinder"), np.array([0.1, 0.2, 0.3]), 3.3)
    assert welded(shape).is_watertight
    assert welded(shape).volume > 0


def test_arrays_are_read_only():
    part = cut_into_parts(cylinder(), named("none", "cylinder", "none"), np.zeros(3), 1.0).parts[1]
    for array in (part.vertices, part.faces, part.normals, part.uv):
        assert not array.flags.writeable


def test_turns_are_the_angles_that_python_finds():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(size=(5000, 2)), [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1]]])
    points = np.concatenate([points, points * [1.0, 1e-9], points * [1e-9, 1.0], [[0.0, 0.0], [1.0, -1e-17]]])
    turns = np.array([turn_about_z(x, y) for x, y in points.tolist()])
    expected = np.array([math.atan2(y, x) / (2 * math.pi) % 1.0 for x, y in points.tolist()])
    assert np.abs((turns - expected + 0.5) % 1.0 - 0.5).max() < 1.1e-14
    assert turns.min() >= 0.0 and turns.max() < 1.0
    assert turns[5000:5007].tolist() == [0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75]
