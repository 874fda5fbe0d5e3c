"""A processed capture against truth: that of its simulation, or a mesh that the user gives, which is aligned to it first."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.capture import CaptureEstimate, CaptureScore, Reconstruction, SynthesizedView, ViewScore
from schemas.errors import CaptureError, ViewError
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import MESH_FILE, TRUTH, CaptureFolder, read_truth
from workers.capture.process import CaptureViews, StoredResult
from workers.capture.surface.posed_view import PosedView, facing_cosine, placed, visible_points
from workers.geometry.camera import project, spread_evenly
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


HELD_OUT = 6
"""Views that are left out in turn and made of the others."""


@dataclass(frozen=True, eq=False)
class Truth:
    """T_board_cam [4, 4] by view number, and the object's surface in the board frame."""

    T_board_cam: Mapping[int, Pose]
    surface: Mesh


@dataclass(frozen=True, eq=False)
class Score:
    """All that was compared: the summary that a dataset stores, the surface, and the views that were left out, by number."""

    summary: CaptureScore
    surface: SurfaceErrors
    held_out: Mapping[int, ViewErrors]
    worst_mm: float | None
    worst_deg: float | None


def read_mesh_file(path: Path) -> Mesh:
    """The triangles of a mesh file. Raises CaptureError where it cannot be read or has none."""
    try:
        found = trimesh.load_scene(io.BytesIO(path.read_bytes()), file_type=path.suffix[1:].lower(), process=False)
        mesh = found.to_mesh()
    except FileNotFoundError:
        raise CaptureError("missing", f"{path} is not there") from None
    except Exception as error:  # readers of many formats raise errors of many kinds
        raise CaptureError("unreadable", f"{path} is no mesh that can be read: {error!r}") from error
    faces = np.array(getattr(mesh, "faces", ()), np.int32).reshape(-1, 3)
    if not len(faces):
        raise CaptureError("unreadable", f"{path} has no triangles")
    return Mesh(np.array(mesh.vertices, np.float64), faces)


def read_whole_truth(folder: CaptureFolder) -> Truth | None:
    """The truth of a simulated capture, None of a real one. Raises CaptureError where it cannot be read."""
    truth = read_truth(folder.path)
    if truth is None:
        return None
    mesh = read_mesh_file(folder.path / TRUTH / MESH_FILE)
    poses = {n: truth.T_board_cam[n] for n in folder.numbers if n < len(truth.T_board_cam)}
    return Truth(poses, Mesh(transform(truth.T_board_obj, mesh.vertices), mesh.faces))


def score_capture(
    estimate: CaptureEstimate, surface: Reconstruction, views: CaptureViews, truth: Truth, held_out: int = HELD_OUT
) -> Score:
    """The errors of poses, surface and synthesised views. Raises CaptureError where no used view has a true pose."""
    used = {view.number: view.T_board_cam for view in estimate.used if view.T_board_cam is not None}
    known = sorted(set(used) & set(truth.T_board_cam))
    poses = compare_poses([used[n] for n in known], [truth.T_board_cam[n] for n in known])
    cameras = [Camera(views.folder.camera.intrinsics, truth.T_board_cam[n]) for n in known]
    errors = score_surface(surface, truth.surface, cameras)
    left_out = score_held_out(views, truth, known, held_out)
    by_view = {}
    for n in known:
        one = compare_poses([used[n]], [truth.T_board_cam[n]])
        depth = left_out[n].depth_median_mm if n in left_out else None
        by_view[n] = ViewScore(one.median_mm, one.median_deg, depth)
    summary = CaptureScore(
        pose_mm=poses.median_mm,
        pose_deg=poses.median_deg,
        cloud_median_mm=errors.cloud_median_mm,
        cloud_p95_mm=errors.cloud_p95_mm,
        completeness=errors.completeness,
        depth_median_mm=float(np.median([e.depth_median_mm for e in left_out.values()])) if left_out else None,
        views=by_view,
    )
    return Score(summary, errors, left_out, poses.worst_mm, poses.worst_deg)


def score_surface(surface: Reconstruction, true: Mesh, cameras: Sequence[Camera]) -> SurfaceErrors:
    """Cloud and mesh against the true surface, of which the cameras see a part."""
    samples, normals = sample_surface(true)
    visible = visible_points(true, samples, normals, cameras)
    distance_m, _ = cKDTree(surface.points).query(samples)
    off, _ = distance_to_mesh(surface.points, true)
    back, _ = distance_to_mesh(samples[visible], Mesh(surface.vertices, surface.faces))
    return SurfaceErrors(
        cloud_median_mm=1e3 * float(np.median(off)),
        cloud_p95_mm=1e3 * float(np.quantile(off, 0.95)),
        surface_median_mm=1e3 * float(np.median(back)),
        surface_p95_mm=1e3 * float(np.quantile(back, 0.95)),
        completeness=float((distance_m[visible] <= COMPLETE_M).mean()),
        visible_share=float(visible.mean()),
        points=len(surface.points),
    )


def score_measured(surface: Reconstruction, views: CaptureViews, truth: Truth) -> MeasuredSurface:
    """How much of what was visible had depth in any used view, and how much of that has a point within 3 mm."""
    samples, normals = sample_surface(truth.surface)
    numbers = sorted(set(views.cameras) & set(truth.T_board_cam))
    k = views.folder.camera.intrinsics
    visible = visible_points(truth.surface, samples, normals, [Camera(k, truth.T_board_cam[n]) for n in numbers])
    measured = np.zeros(len(samples), np.bool_)
    for number in numbers:
        measured |= measured_points(samples, normals, views.posed(number))
    distance, _ = cKDTree(surface.points).query(samples)
    both = visible & measured
    return MeasuredSurface(
        float(both.sum() / max(int(visible.sum()), 1)),
        float((distance[both] <= COMPLETE_M).mean()) if both.any() else 0.0,
    )


def score_held_out(views: CaptureViews, truth: Truth, known: Sequence[int], most: int) -> dict[int, ViewErrors]:
    """Views made of the others, from their true poses, against the true depth and what was photographed."""
    found: dict[int, ViewErrors] = {}
    for number in (known[place] for place in spread_evenly(len(known), most)):
        camera = Camera(views.folder.camera.intrinsics, truth.T_board_cam[number])
        depth_m: Array = true_view(truth.surface, camera)
        try:
            made = views.synthesize(camera, without=number)
            found[number] = compare_view(made, depth_m, depth_m > 0.0, views.posed(number).rgb)
        except (CaptureError, ViewError):  # the view sees nothing of the object, or nothing beside it does
            continue
    return found


def score_against_mesh(result: StoredResult, mesh: Mesh) -> tuple[SurfaceErrors, Alignment]:
    """The surface's errors after the mesh is aligned to the cloud; what is visible follows from the estimated poses."""
    alignment = align_mesh(result.surface.points, mesh)
    placed = Mesh(transform(alignment.T_board_obj, mesh.vertices), mesh.faces)
    k = result.folder.camera.intrinsics
    cameras = [Camera(k, view.T_board_cam) for view in result.estimate.used if view.T_board_cam is not None]
    return score_surface(result.surface, placed, cameras), alignment
