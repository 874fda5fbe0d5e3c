"""Errors of a cloud and of views against a true surface, and the alignment of frames before that.

- Errors of a processed capture against truth: poses, merged surface, synthesised views.
- Alignment of a given mesh to a merged surface: iterated closest points from many starts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.capture import Reconstruction, SynthesizedView
from schemas.errors import CaptureError
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.surface.posed_view import PosedView, facing_cosine, placed
from workers.geometry.camera import project
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import angle_between, invert, pose, rotation_about, transform
from workers.geometry.raycast import cast_view

SAMPLES = 40_000
"""Points of the true surface: their share within a distance is known to a quarter of a percent."""

SEED = 20_240_801
"""Of the surface samples, so that the same capture has the same figures."""

COMPLETE_M = 0.003

MEASURED_M = 0.004
"""Depth of the surface itself and not of another: three times the noise of a pixel that has twice an Azure Kinect's."""


@dataclass(frozen=True)
class PoseErrors:
    """Distance and angle between estimated and true camera poses: median and worst."""

    median_mm: float
    worst_mm: float
    median_deg: float
    worst_deg: float
    views: int


@dataclass(frozen=True)
class SurfaceErrors:
    """Merged cloud against the true surface.

    cloud_*: from each point of the cloud to the surface; surface_*: from each visible sample of the true surface to the merged
    mesh, millimetres; completeness: share of the visible samples with a point of the cloud within 3 mm; visible_share: share of
    the surface that is visible to a camera at all.
    """

    cloud_median_mm: float
    cloud_p95_mm: float
    surface_median_mm: float
    surface_p95_mm: float
    completeness: float
    visible_share: float
    points: int


@dataclass(frozen=True)
class MeasuredSurface:
    """What depth there was to merge: share of the visible samples that at least one view has depth of, and their completeness.

    A surface that is seen at a grazing angle alone, or between two edges, is visible and has no depth.
    """

    measured_of_visible: float
    completeness_of_measured: float


@dataclass(frozen=True)
class ViewErrors:
    """A synthesised view against the true one, on pixels of the object that both have.

    color_error: mean absolute difference of 8-bit codes, None where the true colours are unknown; covered: share of the true
    object's pixels that the view has; beyond: share of the view's object pixels that are none.
    """

    depth_median_mm: float
    depth_p95_mm: float
    color_error: float | None
    covered: float
    beyond: float
    measured_share: float


def compare_poses(estimated: Sequence[Pose], true: Sequence[Pose]) -> PoseErrors:
    """Errors of T_board_cam. Raises CaptureError for no poses."""
    if not len(estimated):
        raise CaptureError("no_pose", "no view has a pose that could be compared with the truth")
    mm = [1e3 * float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(estimated, true, strict=True)]
    deg = [float(np.degrees(angle_between(a[:3, :3], b[:3, :3]))) for a, b in zip(estimated, true, strict=True)]
    return PoseErrors(float(np.median(mm)), max(mm), float(np.median(deg)), max(deg), len(mm))


def sample_surface(mesh: Mesh, count: int = SAMPLES) -> tuple[Array, Array]:
    """(points, unit normals), each [N, 3]: evenly over the area, the same for the same mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    total = np.cumsum(area)
    rng = np.random.default_rng(SEED)
    # One sample in each of N equal shares of the area.
    at = (np.arange(count) + rng.uniform(size=count)) / count * total[-1]
    face = np.minimum(np.searchsorted(total, at, side="right"), len(area) - 1)
    s, t = rng.uniform(size=(2, count))
    s, t = np.where(s + t > 1.0, 1.0 - s, s), np.where(s + t > 1.0, 1.0 - t, t)
    points = a[face] + s[:, None] * (b - a)[face] + t[:, None] * (c - a)[face]
    return points, across[face] / np.maximum(area[face], 1e-300)[:, None]


def compare_surface(
    found: Reconstruction, true: Mesh, samples: Array, visible: NDArray[np.bool_], cloud_of_samples_m: Array
) -> SurfaceErrors:
    """The errors of a merged surface; samples [N, 3] of the true one, which of them are visible, and how far the cloud is."""
    off, _ = distance_to_mesh(found.points, true)
    back, _ = distance_to_mesh(samples[visible], Mesh(found.vertices, found.faces))
    return SurfaceErrors(
        cloud_median_mm=1e3 * float(np.median(off)),
        cloud_p95_mm=1e3 * float(np.quantile(off, 0.95)),
        surface_median_mm=1e3 * float(np.median(back)),
        surface_p95_mm=1e3 * float(np.quantile(back, 0.95)),
        completeness=float((cloud_of_samples_m[visible] <= COMPLETE_M).mean()),
        visible_share=float(visible.mean()),
        points=len(found.points),
    )


def measured_points(points: Array, normals: Array, view: PosedView) -> NDArray[np.bool_]:
    """[N] bool: points [N, 3] of the true surface, unit normals outwards, of which a view has depth.

    The pixel that a point projects to has depth within `MEASURED_M` of the surface, along its normal.
    """
    camera = view.depth_camera
    k, cosine = camera.intrinsics, facing_cosine(points, normals, camera)
    measured = np.zeros(len(points), np.bool_)
    facing = np.flatnonzero(cosine > 0.0)
    seen = transform(invert(camera.T_world_cam), points[facing])
    u, v = project(seen, k)
    z = view.depth_m[np.floor(v).astype(np.int64), np.floor(u).astype(np.int64)]
    measured[facing] = (z > 0.0) & (np.abs(z - seen[:, 2]) * cosine[facing] < MEASURED_M)
    return measured


def true_view(mesh: Mesh, camera: Camera) -> Array:
    """[H, W] float64: exact depth of the mesh alone, by the ray caster, 0 where it is not seen."""
    return cast_view([placed(mesh)], camera)[0]


def compare_view(
    view: SynthesizedView,
    depth_m: Array,
    mask: NDArray[np.bool_],
    rgb: NDArray[np.uint8] | None = None,
) -> ViewErrors:
    """The errors of a synthesised view. Raises CaptureError where it has no pixel of the object in common with the truth."""
    both = view.mask & mask & (view.depth_m > 0.0) & (depth_m > 0.0)
    if not both.any():
        raise CaptureError("nothing_seen", "a synthesised view shows nothing of the object where it is")
    off_mm = 1e3 * np.abs(view.depth_m - depth_m)[both]
    color = None if rgb is None else float(np.abs(view.rgb[both].astype(np.float64) - rgb[both]).mean())
    return ViewErrors(
        depth_median_mm=float(np.median(off_mm)),
        depth_p95_mm=float(np.quantile(off_mm, 0.95)),
        color_error=color,
        covered=float(both.sum() / mask.sum()),
        beyond=float((view.mask & ~mask).sum() / max(int(view.mask.sum()), 1)),
        measured_share=view.measured_share,
    )


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
