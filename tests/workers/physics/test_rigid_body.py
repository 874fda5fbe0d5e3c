"""The shape, frame and parts of the bodies that the simulator is given."""

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box
from workers.geometry.frames import pose, transform, uniform_rotation
from workers.geometry.hull import convex_hull, depth_m
from workers.physics import rigid_body
from workers.physics.rigid_body import body_frame, make_body, octants

PHYSICS = Job(name="t").physics
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
