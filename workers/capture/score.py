"""A processed capture against truth: that of its simulation, or a mesh that the user gives, which is aligned to it first."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from schemas.base import Array, Pose
from schemas.capture import CaptureScore, Reconstruction, SynthesizedView, ViewScore
from schemas.errors import CaptureError, MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import CaptureFolder
from workers.capture.process import CaptureViews, unless_unseen
from workers.capture.surface.coverage import describe_grazing, sample_surface
from workers.capture.surface.posed_view import UNSEEN, PosedView, best_cosine, facing_cosine, placed
from workers.capture.truth import MESH_FILE, TRUTH, read_truth
from workers.door.meshes.formats import FORMATS, load_shape
from workers.geometry.camera import project, spread_evenly
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import UP, angle_between, invert, pose, rotation_about, transform
from workers.geometry.raycast import Caster, cast_view

SAMPLES = 40_000
"""Points of the true surface: their share within a distance is known to a quarter of a percent."""

COMPLETE_M = 0.003

MEASURED_M = 0.004
"""Depth of the surface itself and not of another: three times the noise of a pixel that has twice an Azure Kinect's."""


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
class ViewErrors:
    """A synthesised view against the true one, on pixels of the object that both have.

    color_error: mean absolute difference of 8-bit codes; covered: share of the true object's pixels that the view has; beyond:
    share of the view's object pixels that are none.
    """

    depth_median_mm: float
    depth_p95_mm: float
    color_error: float
    covered: float
    beyond: float
    measured_share: float


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


def compare_view(view: SynthesizedView, depth_m: Array, rgb: NDArray[np.uint8]) -> ViewErrors:
    """The errors of a synthesised view, of the object's true depth [H, W], 0 where it is not seen.

    Raises CaptureError where it has no pixel of the object in common with the truth.
    """
    mask = depth_m > 0.0
    both = view.mask & mask & (view.depth_m > 0.0)
    if not both.any():
        raise CaptureError("nothing_seen", "a synthesised view shows nothing of the object where it is")
    off_mm = 1e3 * np.abs(view.depth_m - depth_m)[both]
    return ViewErrors(
        depth_median_mm=float(np.median(off_mm)),
        depth_p95_mm=float(np.quantile(off_mm, 0.95)),
        color_error=float(np.abs(view.rgb[both].astype(np.float64) - rgb[both]).mean()),
        covered=float(both.sum() / mask.sum()),
        beyond=float((view.mask & ~mask).sum() / max(int(view.mask.sum()), 1)),
        measured_share=view.measured_share,
    )


TURNS = 24
"""Starts: the mesh stands on each of its sides, turned about the vertical by so many angles."""

UPS = [np.eye(3), *(rotation_about(axis, angle) for axis, angle in product(np.eye(3)[:2], (0.5 * np.pi, -0.5 * np.pi)))]
UPS += [rotation_about(np.eye(3)[0], np.pi)]
"""What takes each of a mesh's axes up, and down; those after the first are tried where it does not fit."""
GOOD, LOOSE = 0.01, 0.02
"""Trimmed distances, of the cloud's size, below which a mesh fits, and from which on it may be another one."""
STEPS_TRY, STEPS_FINE = 12, 60
FEW, MANY = 1500, 8000
TRIM = 0.9
"""Share of the nearest pairs that count: what one side lacks must not pull."""


def align_mesh(points: Array, mesh: Mesh) -> tuple[Pose, float]:
    """(T_board_obj [4, 4], millimetres) of the mesh, metres, any of its axes up, that fits points [N, 3] best.

    The millimetres are the root mean square distance of the points to it, trimmed. Raises CaptureError for fewer than 100
    points, and for a mesh of quite another size.
    """
    if len(points) < 100:
        raise CaptureError("no_surface", f"a cloud of {len(points)} points cannot be aligned")
    _check_size(points, mesh)
    samples, normals = sample_surface(mesh, MANY)
    tree = cKDTree(samples)
    few, many = (points[:: max(1, len(points) // count)] for count in (FEW, MANY))
    goal = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tries, fits = list[tuple[float, Pose]](), GOOD * np.linalg.norm(np.ptp(points, axis=0))
    for up in UPS:
        for turn in range(TURNS):
            R = rotation_about(UP, 2.0 * np.pi * turn / TURNS) @ up
            turned = mesh.vertices @ R.T
            shift = goal - 0.5 * (turned.min(axis=0) + turned.max(axis=0))
            shift[2] = points[:, 2].max() - turned[:, 2].max()  # tops together: the foot is not seen
            tries.append(_iterate(few, samples, normals, tree, pose(R, shift), STEPS_TRY))
        if min(error for error, _ in tries) < fits**2:
            break
    start = min(tries, key=lambda error_and_pose: error_and_pose[0])[1]
    _, T = _iterate(many, samples, normals, tree, start, STEPS_FINE)
    distance = np.sort(distance_to_mesh(transform(invert(T), many), mesh)[0])[: int(TRIM * len(many))]
    return T, 1e3 * float(np.sqrt((distance**2).mean()))


def _check_size(points: Array, mesh: Mesh) -> None:
    """Raises CaptureError for a mesh too small to have these points, or so large that they are nearly nothing of it."""
    size, cloud = (float(np.linalg.norm(np.ptp(each, axis=0))) for each in (mesh.vertices, points))
    if not 0.3 * cloud < size < 4.0 * cloud:
        scale = next((k for k in (0.001, 0.01, 0.0254, 1000.0, 100.0) if 0.8 * cloud < k * size < 2.0 * cloud), None)
        remedy = "is it this object?" if scale is None else f"scale it by {scale:g} if it is this object"
        raise CaptureError(
            "size",
            f"the mesh is {size:.3g} m across, and what was captured {cloud:.3g} m; it is read in metres: {remedy}",
        )


def describe_misfit(points: Array, rms_mm: float) -> str | None:
    """A sentence where points [N, 3] lie so far off an aligned mesh that it may be another one."""
    size_mm = 1e3 * float(np.linalg.norm(np.ptp(points, axis=0)))
    share = f"{rms_mm:.1f} mm are {rms_mm / size_mm:.0%} of what was captured"
    return f"{share}: is it this object, whole?" if rms_mm > max(LOOSE * size_mm, 1e3 * COMPLETE_M) else None


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
        T = T @ invert(pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]))
        if np.abs(step).max() < 1e-8:
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
    """All that was compared: the summary that a dataset stores, and by number the views that were left out in turn."""

    summary: CaptureScore
    surface: SurfaceErrors
    held_out: Mapping[int, ViewErrors]


def read_mesh_file(path: Path) -> Mesh:
    """The triangles of a mesh file. Raises CaptureError where it cannot be read or has none."""
    if path.suffix.lower() not in FORMATS:
        raise CaptureError("format", f"{path} is none of {', '.join(FORMATS)}: export it as one of those")
    try:
        shape = load_shape(path, MeshLimits()).shape
    except MeshError as error:
        raise CaptureError(error.reason, error.detail) from error
    return Mesh(shape.vertices, shape.faces)


def read_whole_truth(folder: CaptureFolder) -> Truth | None:
    """The truth of a simulated capture, None of a real one. Raises CaptureError where it cannot be read."""
    truth = read_truth(folder.path)
    if truth is None:
        return None
    mesh = read_mesh_file(folder.path / TRUTH / MESH_FILE)
    poses = {n: truth.T_board_cam[n] for n in folder.numbers if n < len(truth.T_board_cam)}
    return Truth(poses, Mesh(transform(truth.T_board_obj, mesh.vertices), mesh.faces))


def describe_true_grazing(folder: CaptureFolder) -> str | None:
    """What `describe_grazing` says of a simulated capture's true surface and poses; None of a real one."""
    truth, k = read_whole_truth(folder), folder.camera.intrinsics
    cameras = {n: Camera(k, T) for n, T in truth.T_board_cam.items()} if truth else {}
    return describe_grazing(truth.surface, cameras) if truth else None


def score_capture(views: CaptureViews, truth: Truth, held_out: int = HELD_OUT) -> Score:
    """The errors of poses, surface and synthesised views. Raises CaptureError where no used view has a true pose."""
    used = {view.number: view.T_board_cam for view in views.estimate.used if view.T_board_cam is not None}
    known = sorted(set(used) & set(truth.T_board_cam))
    if not known:
        raise CaptureError("no_pose", "no view has a pose that could be compared with the truth")
    pairs = [(used[n], truth.T_board_cam[n]) for n in known]
    mm = [1e3 * float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in pairs]
    deg = [float(np.degrees(angle_between(a[:3, :3], b[:3, :3]))) for a, b in pairs]
    cameras = [Camera(views.folder.camera.intrinsics, truth.T_board_cam[n]) for n in known]
    surface = score_surface(views.surface, truth.surface, cameras)
    left_out = score_held_out(views, truth, known, held_out)
    depth_mm = {n: errors.depth_median_mm for n, errors in left_out.items()}
    by_view = {n: ViewScore(a, b, depth_mm.get(n)) for n, a, b in zip(known, mm, deg, strict=True)}
    depth = float(np.median(list(depth_mm.values()))) if depth_mm else None
    cloud = surface.cloud_median_mm, surface.cloud_p95_mm, surface.completeness
    summary = CaptureScore(float(np.median(mm)), float(np.median(deg)), *cloud, depth, by_view)
    return Score(summary, surface, left_out)


def score_surface(surface: Reconstruction, true: Mesh, cameras: Sequence[Camera]) -> SurfaceErrors:
    """Cloud and mesh against the true surface, of which the cameras see a part."""
    samples, normals = sample_surface(true, SAMPLES)
    visible = best_cosine(Caster(true), samples, normals, cameras) > UNSEEN
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


def score_measured(views: CaptureViews, truth: Truth) -> tuple[float, float]:
    """What depth there was to merge: (share of the visible samples that a used view has depth of, completeness of those).

    A surface that is seen at a grazing angle alone, or between two edges, is visible and has no depth.
    """
    samples, normals = sample_surface(truth.surface, SAMPLES)
    numbers = sorted(set(views.cameras) & set(truth.T_board_cam))
    cameras = [Camera(views.folder.camera.intrinsics, truth.T_board_cam[n]) for n in numbers]
    visible = best_cosine(Caster(truth.surface), samples, normals, cameras) > UNSEEN
    measured = np.zeros(len(samples), np.bool_)
    for number in numbers:
        measured |= measured_points(samples, normals, views.posed(number))
    distance, _ = cKDTree(views.surface.points).query(samples)
    both = visible & measured
    complete = float((distance[both] <= COMPLETE_M).mean()) if both.any() else 0.0
    return float(both.sum() / max(int(visible.sum()), 1)), complete


def score_held_out(views: CaptureViews, truth: Truth, known: Sequence[int], most: int) -> dict[int, ViewErrors]:
    """Views made of the others, from their true poses, against the true depth and what was photographed."""
    errors: dict[int, ViewErrors] = {}
    for number in (known[place] for place in spread_evenly(len(known), most)):
        camera = Camera(views.folder.camera.intrinsics, truth.T_board_cam[number])
        depth_m = cast_view([placed(truth.surface)], camera)[0]  # of the object alone
        with unless_unseen():
            made = views.synthesize(camera, without=number)
            errors[number] = compare_view(made, depth_m, views.posed(number).rgb)
    return errors


def score_against_mesh(result: CaptureViews, mesh: Mesh) -> tuple[SurfaceErrors, Pose, float]:
    """The surface's errors after the mesh is aligned to the cloud, and what `align_mesh` gives.

    What is visible follows from the estimated poses.
    """
    T_board_obj, rms_mm = align_mesh(result.surface.points, mesh)
    aligned = Mesh(transform(T_board_obj, mesh.vertices), mesh.faces)
    k = result.folder.camera.intrinsics
    cameras = [Camera(k, view.T_board_cam) for view in result.estimate.used if view.T_board_cam is not None]
    return score_surface(result.surface, aligned, cameras), T_board_obj, rms_mm
