"""Meshes from outside that are no surface of one body: edges of many faces, crossings, one side only, inside out."""

from typing import Any

import numpy as np
import trimesh

from schemas.base import Array
from schemas.scene.shape import Asset
from tests.hard_cases.outside import SIDE_M, enter, obj, of
from tests.kit.shapes import box

S = SIDE_M


def _cubes(*at: tuple[float, float, float]) -> tuple[Array, Array]:
    """(vertices, faces) of cubes at these places, where equal corners are one."""
    whole: Any = trimesh.util.concatenate([box(S, S, S, (S * x, S * y, S * z)) for x, y, z in at])
    whole.merge_vertices(digits_vertex=9)
    return np.asarray(whole.vertices), np.asarray(whole.faces)


def sharing_an_edge() -> Asset:
    """Two cubes side by side, corner to corner: four faces meet at the upright edge between them."""
    return enter(obj(*_cubes((0, 0, 0), (1, 1, 0))))


def sharing_a_corner() -> Asset:
    """Two cubes that have one corner in common."""
    return enter(obj(*_cubes((0, 0, 0), (1, 1, 1))))


def with_inner_wall() -> Asset:
    """Two cubes side by side and the wall between them, twice: edges of four faces within the solid."""
    return enter(obj(*_cubes((0, 0, 0), (1, 0, 0))))


def with_fin() -> Asset:
    """A cube on whose upper side a sheet stands, from edge to edge: edges of three faces."""
    mesh, top = box(S, S, S), S / 2
    fin = np.array([[-top, 0, top], [top, 0, top], [top, 0, 2 * top], [-top, 0, 2 * top]])
    n = len(mesh.vertices)
    return enter(
        obj(np.concatenate([mesh.vertices, fin]), np.concatenate([mesh.faces, [[n, n + 1, n + 2], [n, n + 2, n + 3]]]))
    )


def crossing() -> Asset:
    """Two boxes of 150 mm across one another, as one mesh that cuts through itself."""
    return enter(of(trimesh.util.concatenate([box(0.15, 0.05, 0.05), box(0.05, 0.15, 0.05)])))


def moebius(count: int = 48) -> Asset:
    """A band with half a twist: a surface with one side and one border."""
    angle = 2.0 * np.pi * np.arange(count) / count
    along = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    across = np.cos(angle / 2)[:, None] * along + np.sin(angle / 2)[:, None] * [0.0, 0.0, 1.0]
    points = np.concatenate([0.05 * along - 0.01 * across, 0.05 * along + 0.01 * across])
    faces = []
    for k in range(count):
        a, b, c, d = k, k + count, (k + 1) % count, (k + 1) % count + count
        if k == count - 1:
            c, d = d, c
        faces += [[a, b, d], [a, d, c]]
    return enter(obj(points, np.array(faces)))


def one_inside_out() -> Asset:
    """Two cubes 50 mm apart, the faces of one of them inwards."""
    a, b = box(S, S, S, (-0.75 * S, 0, 0)), box(S, S, S, (0.75 * S, 0, 0))
    return enter(
        obj(np.concatenate([a.vertices, b.vertices]), np.concatenate([a.faces, b.faces[:, ::-1] + len(a.vertices)]))
    )


def cavity_inside_out() -> Asset:
    """A cube with a cubic cavity whose faces look into the wall, as if it were a second body within."""
    return enter(of(trimesh.util.concatenate([box(S, S, S), box(S / 2, S / 2, S / 2)])))
