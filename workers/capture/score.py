"""A processed capture against truth: that of its simulation, or a mesh that the user gives."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.capture import CaptureEstimate, CaptureScore, Reconstruction, ViewScore
from schemas.errors import CaptureError, ViewError
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import MESH_FILE, TRUTH, CaptureFolder, read_truth
from workers.capture.stored import StoredResult
from workers.capture.surface.evaluate import (
    COMPLETE_M,
    Alignment,
    MeasuredSurface,
    SurfaceErrors,
    ViewErrors,
    align_mesh,
    compare_poses,
    compare_surface,
    compare_view,
    measured_points,
    sample_surface,
    true_view,
)
from workers.capture.surface.posed_view import visible_points
from workers.capture.views import CaptureViews
from workers.geometry.camera import spread_evenly
from workers.geometry.frames import transform

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
    distance, _ = cKDTree(surface.points).query(samples)
    return compare_surface(surface, true, samples, visible, np.asarray(distance, np.float64))


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
