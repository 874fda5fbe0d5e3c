"""The shape, margin, frame and parts of the bodies that the simulator is given."""

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart
from schemas.scene.shape import Asset
from tests.shapes import asset_of, box
from workers.geometry.frames import pose, rotation_about, transform, uniform_rotation
from workers.geometry.hull import convex_hull
from workers.physics import rigid_body
from workers.physics.rigid_body import SLOP_M, body_frame, choose_collision_shape, make_body

PHYSICS = Job(name="t").physics
BOXED = PHYSICS.model_copy(update={"collision": "box"})
MARGIN_M = PHYSICS.margin_mm / 1e3
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


@pytest.mark.parametrize("name", SHAPES)
def test_the_shape_with_its_margin_lies_in_the_hull_and_touches_its_planes_but_for_the_slop(name):
    """Of a body and a ball about each of its points, the support function is the body's plus the ball's radius."""
    start = start_of(asset_of(SHAPES[name]))
    made = make_body(start, PHYSICS)
    vertices = transform(made.T_obj_body, made.parts[0])
    rng = np.random.default_rng(0)
    for normals, tight in ((start.hull.normals, True), (rng.standard_normal((500, 3)), False)):
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        inside = (start.hull.vertices @ normals.T).max(axis=0) - (vertices @ normals.T).max(axis=0)
        beyond = made.margin_m - SLOP_M - inside
        assert beyond.max() < 1e-9
        assert not tight or beyond.min() > -1e-9
    assert made.margin_m == pytest.approx(MARGIN_M)


def test_a_plate_thinner_than_four_margins_gets_a_margin_of_a_quarter_of_its_thickness():
    start = start_of(asset_of(box(0.2, 0.2, 0.0002)))
    made = make_body(start, PHYSICS)
    assert made.margin_m == pytest.approx(0.0002 / 4 + SLOP_M)
    half = transform(made.T_obj_body, made.parts[0])[:, 2].max()
    assert half == pytest.approx(0.0001 - 0.0002 / 4, abs=1e-8)


def test_parts_become_parts_of_one_body_with_one_margin_about_the_centre_of_mass_of_all():
    legs = [box(0.02, 0.1, 0.1, (x, 0, 0.05)) for x in (-0.09, 0.09)]
    top = box(0.2, 0.1, 0.001, (0, 0, 0.1005))
    start = start_of(asset_of(*legs, top))
    made = make_body(start, PHYSICS, parts=tuple(np.asarray(m.vertices) for m in (*legs, top)))
    assert len(made.parts) == 3
    assert made.margin_m == pytest.approx(MARGIN_M)  # the board's millimetre is ten margins
    for part, mesh in zip(made.parts, (*legs, top), strict=True):
        back = transform(made.T_obj_body, part)
        inset = made.margin_m - SLOP_M
        assert back.min(axis=0) == pytest.approx(mesh.bounds[0] + inset, abs=2e-8)
        assert back.max(axis=0) == pytest.approx(mesh.bounds[1] - inset, abs=2e-8)
    far = np.linalg.norm(start.hull.vertices - start.asset.mass.com, axis=1).max()
    assert made.reach_m == pytest.approx(far)


def test_a_thin_part_makes_the_margin_of_all_smaller():
    thin = box(0.2, 0.1, 0.0002, (0, 0, 0.1001))
    start = start_of(asset_of(box(0.2, 0.1, 0.1, (0, 0, 0.05)), thin))
    cut = (np.asarray(box(0.2, 0.1, 0.1, (0, 0, 0.05)).vertices), np.asarray(thin.vertices))
    made = make_body(start, PHYSICS, parts=cut)
    assert made.margin_m == pytest.approx(0.0002 / 4 + SLOP_M)
    thick = transform(made.T_obj_body, made.parts[0])  # made smaller by as little as the thin one
    assert thick.min(axis=0) == pytest.approx(np.array([-0.1, -0.05, 0.0]) + 0.0002 / 4, abs=2e-8)


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
