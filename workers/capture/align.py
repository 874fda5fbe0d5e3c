"""Alignment of a given mesh to a merged surface: iterated closest points from many starts."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.errors import CaptureError
from schemas.scene.shape import Mesh
from workers.capture.evaluate import sample_surface
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import invert, pose, rotation_about, transform

TURNS = 24
"""Starts: the mesh stands as it is, z up, turned about the vertical by so many angles."""

STEPS_TRY, STEPS_FINE = 12, 60
FEW, MANY = 1500, 8000
TRIM = 0.9
"""Share of the nearest pairs that count: what one side lacks must not pull."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """T_board_obj [4, 4] of the mesh, and the root mean square distance of the cloud to it, trimmed, millimetres."""

    T_board_obj: Pose
    rms_mm: float


def align_mesh(points: Array, mesh: Mesh) -> Alignment:
    """The pose of a mesh, z up, metres, that fits points [N, 3] best. Raises CaptureError for fewer than 100 points."""
    if len(points) < 100:
        raise CaptureError("no_surface", f"a cloud of {len(points)} points cannot be aligned")
    samples, normals = sample_surface(mesh, MANY)
    tree = cKDTree(samples)
    few = points[:: max(1, len(points) // FEW)]
    best: tuple[float, Pose] = (np.inf, np.eye(4))
    for turn in range(TURNS):
        R = rotation_about(np.array([0.0, 0.0, 1.0]), 2.0 * np.pi * turn / TURNS)
        turned = mesh.vertices @ R.T
        middle = 0.5 * (turned.min(axis=0) + turned.max(axis=0))
        goal = 0.5 * (points.min(axis=0) + points.max(axis=0))
        goal[2] += (
            points[:, 2].max() - goal[2] - (turned[:, 2].max() - middle[2])
        )  # tops together: the foot is not seen
        start = pose(R, goal - middle)
        best = min(best, _iterate(few, samples, normals, tree, start, STEPS_TRY), key=lambda found: found[0])
    many = points[:: max(1, len(points) // MANY)]
    _, T = _iterate(many, samples, normals, tree, best[1], STEPS_FINE)
    distance = np.sort(distance_to_mesh(transform(invert(T), many), mesh)[0])[: int(TRIM * len(many))]
    return Alignment(T, 1e3 * float(np.sqrt((distance**2).mean())))


def _iterate(points: Array, samples: Array, normals: Array, tree: cKDTree, T: Pose, steps: int) -> tuple[float, Pose]:
    """(trimmed mean square distance, T_board_obj): linearised point to plane (Chen and Medioni 1991)."""
    error = np.inf
    for _ in range(steps):
        local = transform(invert(T), points)
        distance, nearest = tree.query(local)
        keep = distance <= np.quantile(distance, TRIM)
        error = float((distance[keep] ** 2).mean())
        p, q, n = local[keep], samples[nearest[keep]], normals[nearest[keep]]
        A = np.concatenate([np.cross(p, n), n], axis=1)
        step = np.linalg.lstsq(A, ((q - p) * n).sum(axis=1), rcond=None)[0]
        angle = float(np.linalg.norm(step[:3]))
        R = np.eye(3) if angle < 1e-15 else rotation_about(step[:3] / angle, angle)
        T = T @ invert(pose(R, step[3:]))
        if angle < 1e-8 and np.linalg.norm(step[3:]) < 1e-8:
            break
    return error, T
