"""How fine steps are, the fall that is not simulated, and the shape that the simulator is given."""

import math

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from schemas.scene.scene import ObjectStart
from schemas.scene.shape import Asset, Mesh
from tests.shapes import asset_of, box
from workers.geometry.frames import (
    pose,
    quaternion_from_rotation,
    rotation_about,
    transform,
    translation,
    uniform_rotation,
)
from workers.geometry.hull import convex_hull
from workers.physics.bullet import GRAVITY_M_S2, SLOP_M, Body
from workers.physics.fall import FINEST, SKIPPED_TO_M, Faller, Pace, as_pose, fall, make_faller

PHYSICS = Job(name="t").physics
Z = np.array([0.0, 0.0, 1.0])
MARGIN_M = PHYSICS.margin_mm / 1e3
COARSE = Pace(PHYSICS.step_hz, math.inf)
UP = np.array([0.0, 0.0, 1.0])

SHAPES = {
    "box": box(0.1, 0.08, 0.2),
    "cylinder": trimesh.creation.cylinder(0.04, 0.2, sections=48),
    "cone": trimesh.creation.cone(0.05, 0.1, sections=32),
    "tilted box": box(0.1, 0.02, 0.05).apply_transform(
        pose(uniform_rotation(np.random.default_rng(5)), np.array([0.3, -0.2, 0.1]))
    ),
    "ball": trimesh.creation.icosphere(subdivisions=2, radius=0.05),
}


def start_of(asset: Asset, T=None) -> ObjectStart:
    return ObjectStart(asset, convex_hull(asset.shape.vertices), 3, np.eye(4) if T is None else T, 0, False)


def faller_of(name: str) -> tuple[ObjectStart, Faller]:
    start = start_of(asset_of(SHAPES[name]))
    return start, make_faller(start, PHYSICS, rolls=False)


@pytest.mark.parametrize(
    ("speed_m_s", "times"), [(0.0, 1), (0.0959, 1), (0.0961, 2), (0.19, 2), (0.2, 4), (0.7, 8), (1.0, 16), (500.0, 16)]
)
def test_steps_are_shorter_by_powers_of_two_until_none_goes_further_than_the_way_and_never_more_than_sixteen(
    speed_m_s, times
):
    """0.1 mm a step at 960 Hz is 0.096 m/s."""
    assert Pace(960.0, 1e-4).rate(speed_m_s) == 960.0 * times
    assert FINEST == 16


def test_without_a_way_steps_stay_as_long_as_they_are():
    assert COARSE.rate(1e9) == PHYSICS.step_hz


@pytest.mark.parametrize("free_m", [0.0, 0.05, 0.3])
def test_the_part_of_a_fall_that_is_not_simulated_is_exact_and_the_rest_half_a_step_ahead(free_m):
    """Semi-implicit Euler is g t h / 2 ahead after the time t (Hairer, Lubich, Wanner 2006, I.1)."""
    start = start_of(asset_of(SHAPES["box"]), translation(0.0, 0.0, 2.0))
    faller = make_faller(start, PHYSICS, rolls=False)
    motion = fall([faller], [start.T_world_obj], 0.0, PHYSICS, COARSE, 0.4, free_m)
    skipped_s = math.sqrt(2.0 * max(0.0, free_m - SKIPPED_TO_M) / GRAVITY_M_S2)
    ahead = GRAVITY_M_S2 * (motion.seconds - skipped_s) / PHYSICS.step_hz / 2
    fallen = 2.0 - motion.poses[0][2, 3]
    assert fallen == pytest.approx(GRAVITY_M_S2 * motion.seconds**2 / 2 + ahead, abs=1e-9)
    assert 0.4 <= motion.seconds <= 0.4 + 8.0 / PHYSICS.step_hz
    assert motion.poses[0][:3, :3] == pytest.approx(np.eye(3), abs=1e-12)


@pytest.mark.parametrize("height_m", [0.03, 0.3])
def test_what_falls_freely_lands_when_half_g_t_squared_says(height_m):
    start = start_of(asset_of(SHAPES["box"]), translation(0.0, 0.0, 0.1 + height_m))
    motion = fall([make_faller(start, PHYSICS, rolls=False)], [start.T_world_obj], 0.0, PHYSICS, COARSE, 8.0, height_m)
    landed = math.sqrt(2.0 * height_m / GRAVITY_M_S2)
    window, looks = PHYSICS.rest.window_s, 4 * 8 / PHYSICS.step_hz
    assert motion.rested
    assert landed + window <= motion.seconds <= landed + window + looks
    assert motion.poses[0][2, 3] == pytest.approx(0.1, abs=2e-5)


@pytest.mark.parametrize("name", SHAPES)
def test_the_shape_with_its_margin_lies_in_the_hull_and_touches_its_planes_but_for_the_slop(name):
    """Of a body and a ball about each of its points, the support function is the body's plus the ball's radius."""
    start, faller = faller_of(name)
    vertices = transform(faller.T_obj_body, faller.body.parts[0])
    rng = np.random.default_rng(0)
    for normals, tight in ((start.hull.normals, True), (rng.standard_normal((500, 3)), False)):
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        inside = (start.hull.vertices @ normals.T).max(axis=0) - (vertices @ normals.T).max(axis=0)
        beyond = faller.body.margin_m - SLOP_M - inside
        assert beyond.max() < 1e-9
        assert not tight or beyond.min() > -1e-9
    assert faller.body.margin_m == pytest.approx(MARGIN_M)


def test_a_plate_thinner_than_four_margins_gets_a_margin_of_a_quarter_of_its_thickness():
    start = start_of(asset_of(box(0.2, 0.2, 0.0002)))
    faller = make_faller(start, PHYSICS, rolls=False)
    assert faller.body.margin_m == pytest.approx(0.0002 / 4 + SLOP_M)
    half = transform(faller.T_obj_body, faller.body.parts[0])[:, 2].max()
    assert half == pytest.approx(0.0001 - 0.0002 / 4, abs=1e-8)


def test_parts_become_parts_of_one_body_with_one_margin_about_the_centre_of_mass_of_all():
    legs = [box(0.02, 0.1, 0.1, (x, 0, 0.05)) for x in (-0.09, 0.09)]
    top = box(0.2, 0.1, 0.001, (0, 0, 0.1005))
    start = start_of(asset_of(*legs, top))
    faller = make_faller(start, PHYSICS, rolls=False, cut=[np.asarray(m.vertices) for m in (*legs, top)])
    assert len(faller.body.parts) == 3
    assert faller.body.margin_m == pytest.approx(MARGIN_M)  # the board's millimetre is ten margins
    for part, mesh in zip(faller.body.parts, (*legs, top), strict=True):
        back = transform(faller.T_obj_body, part)
        inset = faller.body.margin_m - SLOP_M
        assert back.min(axis=0) == pytest.approx(mesh.bounds[0] + inset, abs=2e-8)
        assert back.max(axis=0) == pytest.approx(mesh.bounds[1] - inset, abs=2e-8)
    far = np.linalg.norm(start.hull.vertices - start.asset.mass.com, axis=1).max()
    assert faller.reach_m == pytest.approx(far)


def test_a_thin_part_makes_the_margin_of_all_smaller():
    thin = box(0.2, 0.1, 0.0002, (0, 0, 0.1001))
    start = start_of(asset_of(box(0.2, 0.1, 0.1, (0, 0, 0.05)), thin))
    cut = [np.asarray(box(0.2, 0.1, 0.1, (0, 0, 0.05)).vertices), np.asarray(thin.vertices)]
    faller = make_faller(start, PHYSICS, rolls=False, cut=cut)
    assert faller.body.margin_m == pytest.approx(0.0002 / 4 + SLOP_M)
    thick = transform(faller.T_obj_body, faller.body.parts[0])  # made smaller by as little as the thin one
    assert thick.min(axis=0) == pytest.approx(np.array([-0.1, -0.05, 0.0]) + 0.0002 / 4, abs=2e-8)


def test_a_watch_ends_the_fall_and_says_which_it_was():
    start = start_of(asset_of(SHAPES["box"]), translation(0.0, 0.0, 1.0))
    faller = make_faller(start, PHYSICS, rolls=False)
    watches = (lambda motion: False, lambda motion: motion[0][2] < 0.9)
    motion = fall([faller], [start.T_world_obj], 0.0, PHYSICS, COARSE, 8.0, 0.0, watches)
    assert (motion.happened, motion.rested) == (1, False)
    assert 0.9 - 8 * 2.0 / PHYSICS.step_hz <= motion.poses[0][2, 3] < 0.9
    after = motion.speed_m_s - math.sqrt(2 * GRAVITY_M_S2 * 0.1)
    assert 0.0 <= after <= 9 * GRAVITY_M_S2 / PHYSICS.step_hz  # it looks every eight steps


def test_a_pose_comes_back_from_its_quaternion():
    T = pose(uniform_rotation(np.random.default_rng(2)), np.array([0.1, 0.2, 0.3]))
    quaternion = quaternion_from_rotation(T[:3, :3])
    assert as_pose(((0.1, 0.2, 0.3), tuple(quaternion))) == pytest.approx(T, abs=1e-12)


def bevelled(heading: int) -> Mesh:
    """Level up to x = 0, from there down by 22 degrees and by 63, turned about z by so many quarters."""
    x, z = np.array([-0.5, 0.0, 0.004, 0.006]), np.array([0.0, 0.0, -0.0016, -0.0055])
    vertices = np.stack([np.repeat(x, 2), np.tile([-0.5, 0.5], 4), np.repeat(z, 2)], axis=1)
    faces = np.concatenate([2 * k + np.array([[0, 2, 3], [0, 3, 1]]) for k in range(3)])
    return Mesh(transform(pose(rotation_about(Z, heading * math.pi / 2), np.zeros(3)), vertices), faces)


@pytest.mark.parametrize("inside_m", [0.0005, 0.001, 0.0015, 0.002])
@pytest.mark.parametrize("heading", range(4))
def test_a_corner_that_comes_down_beside_an_edge_of_a_mesh_does_not_sink_in(heading, inside_m):
    """A hundredth of a millimetre is what Bullet leaves: the steps that foresee a contact end at it."""
    corners = 0.08 * np.concatenate([np.eye(3), -np.eye(3)])
    faller = Faller(Body(0.3, np.full(3, 4e-4), (corners,), 1e-4), np.eye(4), 0.08)
    start = rotation_about(Z, heading * math.pi / 2) @ np.array([-inside_m, 0.013, 0.0801 + 0.005])
    pace = Pace(PHYSICS.step_hz, PHYSICS.max_step_travel_mm / 1e3)
    end = fall([faller], [translation(*start)], bevelled(heading), PHYSICS, pace, 0.04, 0.005)
    lowest = transform(end.poses[0], corners)[:, 2].min() - 1e-4
    assert end.seconds > 0.035
    assert -1.3e-5 < lowest < 1e-5
