"""Packing of shapes for the GPU."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.shape import Part, Shape
from tests.workers.render.random_scenes import part_of
from workers.render.raster.batches import own_vertices, pack_shape

BODIES = {
    "sphere": trimesh.creation.icosphere(3, 0.1),
    "box": trimesh.creation.box((1.0, 2.0, 3.0)),
    "torus": trimesh.creation.torus(0.3, 0.1, 24, 12),
    "fan": trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], [[0, i, i % 4 + 1] for i in (1, 2, 3, 4)]
    ),
}


@pytest.mark.parametrize("name", BODIES)
def test_every_face_keeps_its_corners_and_owns_its_last_vertex(name):
    body = BODIES[name]
    faces, source = own_vertices(body.faces, len(body.vertices))
    assert len(set(faces[:, 2])) == len(faces)
    np.testing.assert_array_equal(source[: len(body.vertices)], np.arange(len(body.vertices)))
    for turned, face in zip(source[faces], body.faces, strict=True):
        assert tuple(turned) in {tuple(np.roll(face, shift)) for shift in range(3)}, (
            "same corners, same sense of turning"
        )
    assert len(source) <= max(len(body.faces), len(body.vertices)) + 0.1 * len(body.faces), "hardly more than faces"


@pytest.mark.parametrize("name", BODIES)
def test_the_last_vertex_of_a_face_carries_its_plane(name):
    part = part_of(BODIES[name])
    (batch,) = pack_shape(Shape((part,)))
    planes = batch.vertices[batch.indices[:, 2], -4:].astype(np.float64)
    corners = batch.vertices[batch.indices, :3].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        np.einsum("fcx,fx->fc", corners, planes[:, :3]), planes[:, 3:].repeat(3, axis=1), atol=1e-6
    )
    outside = np.einsum("fx,fx->f", planes[:, :3], corners.mean(axis=1))
    assert name in ("torus", "fan") or (outside > 0).all(), "normals of a convex body about the origin point outwards"


def test_faces_of_the_top_come_first():
    box = BODIES["box"]
    (batch,) = pack_shape(Shape((part_of(box),)))
    highest = batch.vertices[batch.indices, 2] == np.float32(box.vertices[:, 2].max())
    assert batch.top_faces == 2
    assert highest.all(axis=1).tolist() == [True] * 2 + [False] * 10
    upside_down = Part("p", box.vertices, frozen_array(box.faces[:, ::-1], np.int32))
    assert pack_shape(Shape((upside_down,)))[0].top_faces == 0, "a face seen from below only is no top"


def test_the_top_is_planar_where_its_normals_are_upright_and_its_colours_one():
    (plain,) = Shape((part_of(BODIES["box"]),)).parts
    upright = np.tile([0.0, 0.0, 1.0], (len(plain.vertices), 1))
    top = plain.vertices[:, 2] > 0.0
    tilted, below = upright.copy(), upright.copy()
    tilted[np.flatnonzero(top)[0]] = 0.01, 0.0, 1.0
    below[~top] = 1.0, 0.0, 0.0
    one, two = np.full((len(upright), 4), 200, np.uint8), np.full((len(upright), 4), 200, np.uint8)
    two[np.flatnonzero(top)[0], 1] = 201
    for change, planar in (
        ({"normals": frozen_array(upright)}, True),
        ({"normals": frozen_array(below)}, True),
        ({"normals": frozen_array(tilted)}, False),
        ({"colors": one}, True),
        ({"colors": two}, False),
    ):
        (batch,) = pack_shape(Shape((replace(plain, **change),)))
        assert (batch.planar, batch.planar_top) == (False, planar), change
    assert pack_shape(Shape((plain,)))[0].planar_top
