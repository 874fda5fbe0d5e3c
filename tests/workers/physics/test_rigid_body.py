"""The shape, frame and parts of the bodies that the simulator is given."""

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box
from workers.geometry.frames import pose, rotation_about, transform, uniform_rotation
from workers.geometry.hull import convex_hull, depth_m
from workers.physics import rigid_body
from workers.physics.rigid_body import body_frame, choose_collision_shape, make_body, octants

PHYSICS = Job(name="t").physics
BOXED = PHYSICS.model_copy(update={"collision": "box"})
CAN = asset_of(trimesh.creation.cylinder(0.04, 0.12, sections=48))
TRAY = asset_of(box(0.2, 0.2, 0.05).difference(box(0.18, 0.18, 0.05).apply_translation([0, 0, 0.01])))

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


def test_one_hull_has_the_vertices_of_the_objects_hull_about_its_centre_of_mass():
    start = start_of(asset_of(SHAPES["tilted box"]))
    made = make_body(start)
    (part,) = made.parts
    assert transform(made.T_obj_body, part) == pytest.approx(start.hull.vertices, abs=1e-12)
    assert made.reach_m == pytest.approx(np.linalg.norm(start.hull.vertices - start.asset.mass.com, axis=1).max())


@pytest.mark.parametrize("name", SHAPES)
def test_the_octants_of_a_hull_lie_in_it_and_have_all_of_its_vertices(name):
    """So that the lowest point of the parts is the hull's in every direction."""
    (hull,) = make_body(start_of(asset_of(SHAPES[name]))).parts
    parts = octants(hull, depth_m(hull, convex_hull(hull).normals))
    assert len(parts) <= 8
    every = np.concatenate(parts)
    assert {tuple(point) for point in hull} <= {tuple(point) for point in every}
    faces = convex_hull(hull).normals
    assert ((every @ faces.T).max(axis=0) <= (hull @ faces.T).max(axis=0) + 1e-12).all()
    directions = np.random.default_rng(0).standard_normal((500, 3))
    assert (every @ directions.T).max(axis=0) == pytest.approx((hull @ directions.T).max(axis=0), abs=1e-15)


@pytest.mark.parametrize("size", [(0.1, 0.1, 0.1), (0.2, 0.1, 1e-4)])
def test_every_octant_has_a_volume_even_that_of_a_plate_with_one_corner(size):
    (hull,) = make_body(start_of(asset_of(box(*size)))).parts
    for part in octants(hull, min(size) / 2):
        spread = np.linalg.svd(part - part.mean(axis=0), compute_uv=False)
        assert spread.min() > 0.1 * min(size)


def test_only_a_hull_that_meets_level_ground_alone_is_cut():
    start, none = start_of(CAN), EffectPlan((), {})
    assert len(rigid_body.build_body(start, PHYSICS, none, level=True).parts) == 8
    assert len(rigid_body.build_body(start, PHYSICS, none).parts) == 1


def test_parts_become_parts_of_one_body_about_the_centre_of_mass_of_all():
    legs = [box(0.02, 0.1, 0.1, (x, 0, 0.05)) for x in (-0.09, 0.09)]
    top = box(0.2, 0.1, 0.001, (0, 0, 0.1005))
    start = start_of(asset_of(*legs, top))
    made = make_body(start, parts=tuple(np.asarray(m.vertices) for m in (*legs, top)))
    assert len(made.parts) == 3
    for part, mesh in zip(made.parts, (*legs, top), strict=True):
        back = transform(made.T_obj_body, part)
        assert back.min(axis=0) == pytest.approx(mesh.bounds[0], abs=1e-12)
        assert back.max(axis=0) == pytest.approx(mesh.bounds[1], abs=1e-12)
    far = np.linalg.norm(start.hull.vertices - start.asset.mass.com, axis=1).max()
    assert made.reach_m == pytest.approx(far)


def test_the_box_about_an_object_has_its_size_along_its_own_axes_and_its_lowest_point():
    turned = rotation_about(np.array([0.3, 0.9, 0.1]), 0.7)
    start = start_of(CAN, pose(turned, np.zeros(3)))
    boxed = choose_collision_shape(start, BOXED)
    assert np.ptp(boxed.hull.vertices, axis=0) == pytest.approx(np.ptp(start.hull.vertices, axis=0))
    assert len(boxed.hull.vertices) == 8
    lows = [transform(one.T_world_obj, one.hull.vertices)[:, 2].min() for one in (start, boxed)]
    assert lows[0] == pytest.approx(lows[1], abs=1e-12)
    assert choose_collision_shape(start, PHYSICS) is start


def test_convex_parts_of_a_mesh_from_outside_are_as_fine_as_the_key_says(monkeypatch):
    asked = []

    def parts_of(asset, threshold, share):
        asked.append(threshold)
        return (asset.shape.vertices,)

    monkeypatch.setattr(rigid_body, "parts_of", parts_of)
    for concavity in (0.1, 0.02):
        rigid_body.build_body(
            start_of(TRAY), PHYSICS.model_copy(update={"concavity": concavity}), EffectPlan(("decomposition",), {})
        )
    assert asked == [0.1, 0.02]


def test_principal_axes_are_a_rotation_that_makes_the_inertia_diagonal():
    mass = asset_of(box(0.1, 0.02, 0.05), box(0.03, 0.2, 0.01, (0.05, 0.1, 0.02))).mass
    T, moments = body_frame(mass)
    R = T[:3, :3]
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R.T @ mass.inertia @ R == pytest.approx(np.diag(moments), abs=1e-12)
