"""Meshes of a distance field in closed form."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.capture.surface.tsdf import (
    Volume,
    cut_below,
    extract_surface,
    face_areas,
    keep_vertices,
    large_parts,
    vertex_normals,
)

RADIUS = 0.02


def sphere(seen=lambda p: np.ones(p.shape[:3], bool)):
    axis = np.arange(-15, 16) * 0.002
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    distance = np.linalg.norm(grid - [0.0003, 0.0, -0.0005], axis=-1) - RADIUS
    near = np.ones(grid.shape[:3], np.uint16)
    weight = seen(grid).astype(np.float32)
    return Volume(np.full(3, axis[0]), 0.002, distance.astype(np.float32), weight, near)


def test_the_surface_lies_at_distance_zero_and_is_wound_outwards():
    mesh = extract_surface(sphere())
    radius = np.linalg.norm(mesh.vertices - [0.0003, 0.0, -0.0005], axis=1)
    assert np.abs(radius - RADIUS).max() < 5e-5
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight and solid.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    outwards = (vertex_normals(mesh) * (mesh.vertices - [0.0003, 0.0, -0.0005])).sum(axis=1) / radius
    assert outwards.min() > 0.99
    assert face_areas(mesh).sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=0.01)


def test_no_surface_is_made_where_nothing_was_seen():
    mesh = extract_surface(sphere(lambda p: p[..., 0] > -0.0001))
    assert len(mesh.faces) and mesh.vertices[:, 0].min() > -1e-6
    assert not len(extract_surface(sphere(lambda p: np.linalg.norm(p, axis=-1) > 0.026)).faces)
    assert not len(extract_surface(sphere(lambda p: np.zeros(p.shape[:3], bool))).faces)


def test_a_mesh_is_cut_along_a_tilted_plane():
    mesh = cut_below(extract_surface(sphere()), (0.1, -0.2, 0.001), 0.004)
    height = mesh.vertices[:, 2] - 0.1 * mesh.vertices[:, 0] + 0.2 * mesh.vertices[:, 1] - 0.001
    level = 0.004 * np.sqrt(1)
    assert height.min() == pytest.approx(level, abs=1e-9) and (np.abs(height - level) < 1e-9).sum() > 30


def test_small_loose_parts_are_told_from_large_ones():
    big = extract_surface(sphere())
    crumb = trimesh.creation.icosphere(1, 0.002)
    both = Mesh(
        np.concatenate([crumb.vertices + 0.1, big.vertices]),
        np.concatenate([crumb.faces, big.faces + len(crumb.vertices)]).astype(np.int32),
    )
    keep = large_parts(both, 0.02)
    assert not keep[: len(crumb.vertices)].any() and keep[len(crumb.vertices) :].all()
    assert large_parts(both, 0.001).all()
    kept, old = keep_vertices(both, keep)
    assert np.array_equal(kept.vertices, big.vertices) and np.array_equal(kept.faces, big.faces)
    assert np.array_equal(both.vertices[old], kept.vertices)
