"""One surface from the depth of all views: merged, confirmed, moved to where the views see it, and coloured."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.capture.estimate import Reconstruction
from schemas.errors import CaptureError
from schemas.job.captures import Fusion
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.depth_fit import fit_depth
from workers.capture.mesh import cut_below, extract_surface, keep_vertices, large_parts, vertex_normals
from workers.capture.object_region import ObjectRegion
from workers.capture.posed_view import PosedView
from workers.capture.surface import Sight, color_points, measure_offsets
from workers.capture.tsdf import FRONT_VOXELS, empty_volume, integrate, views_near
from workers.capture.visibility import visible_points
from workers.geometry.camera import project_bounds
from workers.geometry.frames import invert, transform

MARGIN_PX = 12
"""Width by which a view's window is larger than the object's box."""

LEAST_PART = 0.02
"""Share of the largest part's area below which a loose part is noise."""

FACING_AWAY = -1.0
"""Whichever way a rough point's normal turns, it is seen where nothing hides it."""

LIFT_VOXELS = 0.25
"""Points are looked at from so far above the surface: its roughness hides less."""

STEPS = 2
"""Times that points are moved along their normals to where the views see the surface."""


def sight_object(views: Sequence[PosedView], region: ObjectRegion, spec: Fusion) -> list[Sight]:
    """Each view's depth about the object, fitted; views that see nothing of it are left out."""
    least_cos = math.cos(math.radians(spec.max_edge_deg))
    sights = []
    for view in views:
        window = object_window(region, view.depth_camera)
        fitted = fit_depth(without_others(view), view.depth_camera.intrinsics, spec.max_edge_deg, window)
        if fitted.inverse.any():
            sights.append(Sight(view, fitted, least_cos))
    return sights


def without_others(view: PosedView) -> NDArray[np.float32]:
    """[H, W] depth; where a mask was given, none where it ends, so that no surface spans its edge."""
    return view.depth_m


def object_window(region: ObjectRegion, camera: Camera) -> tuple[int, int, int, int]:
    """(top, left, bottom, right) of the pixels that can see the region's box."""
    low, high = region.low, region.high
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    k = camera.intrinsics
    left, top, right, bottom = project_bounds(transform(invert(camera.T_world_cam), corners), k, 0.05)
    rows = np.clip([math.floor(top) - MARGIN_PX, math.ceil(bottom) + MARGIN_PX], 0, k.height)
    columns = np.clip([math.floor(left) - MARGIN_PX, math.ceil(right) + MARGIN_PX], 0, k.width)
    return int(rows[0]), int(columns[0]), int(rows[1]), int(columns[1])


def fuse_views(
    views: Sequence[PosedView], region: ObjectRegion, spec: Fusion, seconds: Mapping[str, float] | None = None
) -> Reconstruction:
    """The object's surface. Raises CaptureError where too few views see it, or none of it is confirmed."""
    sights = sight_object(views, region, spec)
    if len(sights) < spec.min_views:
        raise CaptureError(
            "too_few_views",
            f"{len(sights)} of {len(views)} views have depth on the object, and fusion.min_views is {spec.min_views}: "
            "take more pictures, or lower it",
        )
    volume = empty_volume(region.low, region.high, spec.voxel_m)
    for sight in sights:
        integrate(volume, sight.fitted, sight.view.depth_camera)
    within_m = FRONT_VOXELS * spec.voxel_m
    mesh = extract_surface(volume)
    mesh, _ = keep_vertices(mesh, views_near(volume, mesh.vertices) >= spec.min_views)
    mesh = _outside(mesh, sights, spec)
    mesh = _settle(mesh, sights, within_m)
    mesh = _clean(cut_below(mesh, region.plane, region.clearance_m), region)
    if not len(mesh.faces):
        raise CaptureError(
            "no_surface",
            f"no point of the object is seen alike by fusion.min_views = {spec.min_views} views: the poses are wrong, or the "
            "object has no depth (shiny, black or transparent)",
        )
    normals = vertex_normals(mesh)
    count = views_near(volume, mesh.vertices)
    colors = color_points(mesh.vertices, normals, sights, within_m)
    sure = count >= spec.min_views
    return Reconstruction(
        points=mesh.vertices[sure],
        normals=normals[sure],
        colors=colors[sure],
        views=count[sure],
        vertices=mesh.vertices,
        faces=mesh.faces,
        vertex_colors=colors,
        seconds=dict(seconds or {}),
    )


def _outside(mesh: Mesh, sights: Sequence[Sight], spec: Fusion) -> Mesh:
    """What a camera can see past what the views measured face to face.

    A pixel that mixes two surfaces looks into the object, and there the field has a second surface behind the first.
    """
    if not len(mesh.faces):
        return mesh
    normals = vertex_normals(mesh)
    faced = measure_offsets(mesh.vertices, normals, sights, FRONT_VOXELS * spec.voxel_m).views >= spec.min_views
    hiding, _ = keep_vertices(mesh, faced)
    if not len(hiding.faces):
        return mesh
    cameras = [sight.view.depth_camera for sight in sights]
    seen = visible_points(hiding, mesh.vertices, normals, cameras, LIFT_VOXELS * spec.voxel_m, FACING_AWAY)
    return keep_vertices(mesh, seen)[0]


def _settle(mesh: Mesh, sights: Sequence[Sight], within_m: float) -> Mesh:
    """The mesh after each vertex has moved to the mean of the surfaces that the views see there.

    The field rounds edges and thickens thin walls, because it holds what views from the other side saw, too; a view that
    faces a point knows only its own side.
    """
    vertices = mesh.vertices
    for _ in range(STEPS):
        if not len(mesh.faces):
            break
        normals = vertex_normals(Mesh(vertices, mesh.faces))
        moved = measure_offsets(vertices, normals, sights, within_m).mean_m
        vertices = vertices + normals * _smooth(moved, mesh)[:, None]
    return Mesh(vertices, mesh.faces)


def _smooth(values: Array, mesh: Mesh) -> Array:
    """[V]: half of each vertex's value and half of its neighbours' mean, so that noise between neighbours does not fold faces."""
    total, count = np.zeros(len(values)), np.zeros(len(values))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        total += np.bincount(mesh.faces[:, i], weights=values[mesh.faces[:, j]], minlength=len(values))
        count += np.bincount(mesh.faces[:, i], minlength=len(values))
    return 0.5 * values + 0.5 * total / np.maximum(count, 1)


def _clean(mesh: Mesh, region: ObjectRegion) -> Mesh:
    """Without what is beside the footprint, and without small loose parts."""
    # The cut lies on the clearance itself, and its points must not fall below it by rounding.
    lifted = mesh.vertices + np.array([0.0, 0.0, 1e-6])
    mesh, _ = keep_vertices(mesh, region.holds(lifted))
    return keep_vertices(mesh, large_parts(mesh, LEAST_PART))[0]
