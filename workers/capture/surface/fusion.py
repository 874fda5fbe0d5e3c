"""The surface of a capture's object: depth of all views merged, confirmed, moved to where views face it, and coloured."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from schemas.base import Array
from schemas.capture import Reconstruction
from schemas.errors import CaptureError
from schemas.job.captures import Fusion
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.surface.object_mask import ObjectRegion
from workers.capture.surface.posed_view import NEAREST_M, PosedView, best_cosine, sample_pixels
from workers.capture.surface.tsdf import (
    FRONT_VOXELS,
    MOST_EDGE_DEG,
    SurfaceDepth,
    empty_volume,
    extract_surface,
    fit_surfaces,
    integrate,
    sample_inverse,
)
from workers.geometry.camera import project_bounds
from workers.geometry.colour import SRGB_STEPS, encode_codes
from workers.geometry.frames import UP, invert, transform
from workers.geometry.jit import compiled
from workers.geometry.mesh import face_areas, piece_of
from workers.geometry.raycast import Caster

UNSEEN = 128
"""The code of each channel where no view sees anything."""

SUREST = 2
"""Of `SurfaceDepth.sure`: the pixels around are of the same surface."""

LEAST_LIGHT = 0.02
"""Darker colours, in linear light, say nothing about a view's exposure."""

LEAST_COS = math.cos(math.radians(MOST_EDGE_DEG))

LENIENT = 0.5
"""Share of the smallest cosine of incidence down to which a point's own normal may turn away: it is rougher than the fit of
the pixel, which keeps to the whole."""

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


@dataclass(frozen=True, eq=False)
class Sight:
    """A view ready to be asked: its pictures, and the fit of its depth in a window about the object, which `camera` sees."""

    view: PosedView
    fitted: SurfaceDepth
    camera: Camera


@dataclass(frozen=True, eq=False)
class Support:
    """How far the views see the surface beyond each point along its normal: mean [N], metres; `views` [N] that see it.

    past [N]: views that see past it; sure [N] bool: a view sees it away from any edge.
    """

    mean_m: Array
    views: NDArray[np.int32]
    past: NDArray[np.int32]
    sure: NDArray[np.bool_]

    def confirmed(self, min_views: int) -> NDArray[np.bool_]:
        """[N] bool: seen by as many views and by no more views seen past, or seen surely by a view that none sees past."""
        many = (self.views >= min_views) & (self.past <= self.views)
        return np.asarray(many | (self.sure & (self.past == 0)))


Seen = tuple[Array, Array, NDArray[np.uint8], NDArray[np.bool_]]
"""What a view says of points, each [N]: the offset along the normal to the surface that it sees, metres; its weight, 0 where it
does not see the point; `SurfaceDepth.sure` of the pixel, 0 where weight is 0; whether it sees something farther off there."""


def measure_support(points: Array, normals: Array, sights: Sequence[Sight], within_m: float) -> Support:
    """Mean over the views, weighted by inverse variance, of the distance to the surface that they see there."""
    total, weight = np.zeros(len(points)), np.zeros(len(points))
    views, past = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    sure = np.zeros(len(points), np.bool_)
    for sight in sights:
        offset_m, seen, sure_here, past_here = observe(points, normals, sight, within_m)
        total += offset_m * seen
        weight += seen
        views += seen > 0.0
        past += past_here
        sure |= sure_here > 0
    return Support(np.where(weight > 0.0, total / np.where(weight > 0.0, weight, 1.0), 0.0), views, past, sure)


def observe(points: Array, normals: Array, sight: Sight, within_m: float) -> Seen:
    """What a view says of points [N, 3] with unit normals [N, 3], board frame; `within_m` of the surface they are seen."""
    k, fitted = sight.camera.intrinsics, sight.fitted
    pictures = (fitted.inverse, fitted.beyond, fitted.sure)
    pinhole = (k.fx, k.fy, k.cx_opencv, k.cy_opencv)
    return _observe(points, normals, invert(sight.camera.T_world_cam), pinhole, pictures, within_m)


@compiled
def _observe(
    points: Array,
    normals: Array,
    T: Array,
    k: tuple[float, float, float, float],
    pictures: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]],
    within_m: float,
) -> Seen:
    """A difference of z times (normal . ray) is the distance along the normal; weights as in the distance field."""
    inverse, beyond, sures = pictures
    offset, weight = np.zeros(len(points)), np.zeros(len(points))
    sure, past = np.zeros(len(points), np.uint8), np.zeros(len(points), np.bool_)
    height, width = inverse.shape
    for i in range(len(points)):
        p, n = points[i], normals[i]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if not z > NEAREST_M:
            continue
        ray_x = (T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]) / z
        ray_y = (T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]) / z
        x, y = k[0] * ray_x + k[2], k[1] * ray_y + k[3]
        if not (-0.5 < x < width - 0.5 and -0.5 < y < height - 0.5):
            continue
        slope = 0.0  # of the ray against the normal
        for axis in range(3):
            slope -= n[axis] * (T[0, axis] * ray_x + T[1, axis] * ray_y + T[2, axis])
        least = LEAST_COS * math.sqrt(1.0 + ray_x * ray_x + ray_y * ray_y)
        row, column = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
        past[i] = _sees_past(inverse, beyond, row, column, z, within_m / max(slope, least))
        q = sample_inverse(inverse, x, y)
        s = (z - 1.0 / q) * slope if q > 0.0 else np.inf
        if slope >= LENIENT * least and abs(s) < within_m:
            offset[i], sure[i] = s, sures[row, column]
            weight[i] = slope * slope * q * q * q * q
    return offset, weight, sure, past


@compiled
def _sees_past(
    inverse: NDArray[np.float32], beyond: NDArray[np.float32], row: int, column: int, z: float, reach_m: float
) -> bool:
    """Whether a pixel and those around it all lie more than reach_m behind z, so that no outline is seen past.

    Where they all are the board's, whose plane is known well, whatever is above it is seen past.
    """
    nearest, board = 0.0, True
    for i in range(max(row - 1, 0), min(row + 2, beyond.shape[0])):
        for j in range(max(column - 1, 0), min(column + 2, beyond.shape[1])):
            if not beyond[i, j] > 0.0:
                return False
            nearest, board = max(nearest, beyond[i, j]), board and inverse[i, j] == 0.0
    return bool(1.0 / nearest - z > (0.0 if board else reach_m))


def color_points(points: Array, normals: Array, sights: Sequence[Sight], within_m: float) -> NDArray[np.uint8]:
    """[N, 3] uint8 sRGB: the mean of the views, mostly of those that see a point best, after their exposures were made alike.

    A point that no view sees has the colour of the nearest one that is seen, grey where there is none.
    """
    light = np.zeros((len(sights), len(points), 3), np.float32)
    score = np.zeros((len(sights), len(points)), np.float32)
    for number, sight in enumerate(sights):
        _, weight, sure, _ = observe(points, normals, sight, within_m)
        # A pixel on an outline has the colour of what is beside it, as white of the board.
        seen = np.flatnonzero((sure == SUREST) & (weight > 0.0))
        camera = sight.view.camera
        light[number, seen], inside = sample_pixels(sight.view.rgb, SRGB_STEPS, camera, points[seen])
        score[number, seen] = np.where(inside, weight[seen], 0.0)
    light *= exposure_gains(light, score)[:, None, None].astype(np.float32)
    # Squares, so that the best views decide, without a seam where their order changes.
    weight = score.astype(np.float64) ** 2
    total = weight.sum(axis=0)
    mean = np.einsum("vn,vnc->nc", weight, light) / np.where(total > 0.0, total, 1.0)[:, None]
    codes = encode_codes(mean)
    unseen = total == 0.0
    if unseen.all():
        codes[:] = UNSEEN
    elif unseen.any():
        _, nearest = cKDTree(points[~unseen]).query(points[unseen])
        codes[unseen] = codes[~unseen][nearest]
    return codes


def exposure_gains(light: NDArray[np.float32], score: NDArray[np.float32]) -> Array:
    """[V]: factors on the views' light [V, N, 3] that make what they see in common (score [V, N] > 0) equally bright.

    Medians of ratios, so that gloss and misplaced edges do not count; the views' median factor is 1.
    """
    bright = light.mean(axis=2, dtype=np.float64)
    known = (score > 0.0) & (bright > LEAST_LIGHT) & (bright < 0.9)
    log = np.log(np.where(known, bright, 1.0))
    gains = np.zeros(len(light))
    for _ in range(4):
        count = known.sum(axis=0)
        mean = np.where(known, log + gains[:, None], 0.0).sum(axis=0) / np.maximum(count, 1)
        for view in range(len(light)):
            shared = known[view] & (count > 1)
            gains[view] = np.median(mean[shared] - log[view, shared]) if shared.sum() >= 50 else 0.0
        gains -= np.median(gains)
    return np.asarray(np.exp(np.clip(gains, -1.5, 1.5)))


def sight_object(view: PosedView, region: ObjectRegion) -> Sight:
    """A view's depth about the object, fitted.

    Depth of the board says where nothing is, and no plane mixes the two.
    """
    rows, columns = object_window(region, view.depth_camera)
    k, T = view.depth_camera.intrinsics, view.depth_camera.T_world_cam
    k = k.model_copy(update={"cx": k.cx - columns.start, "cy": k.cy - rows.start})
    object_m, board_inverse, board_facing = region.split_depth(view.depth_m[rows, columns], Camera(k, T))
    fitted = fit_surfaces(object_m, k)
    empty = fitted.inverse == 0.0
    beyond = np.where(empty, board_inverse, fitted.inverse)
    facing = np.where(empty, board_facing, fitted.facing)
    return Sight(view, replace(fitted, facing=facing, beyond=beyond), Camera(k, T))


def object_window(region: ObjectRegion, camera: Camera) -> tuple[slice, slice]:
    """(rows, columns) of the pixels that can see the region's box."""
    low, high = region.low, region.high
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    k = camera.intrinsics
    left, top, right, bottom = project_bounds(transform(invert(camera.T_world_cam), corners), k, NEAREST_M)
    rows = np.clip([math.floor(top) - MARGIN_PX, math.ceil(bottom) + MARGIN_PX], 0, k.height)
    columns = np.clip([math.floor(left) - MARGIN_PX, math.ceil(right) + MARGIN_PX], 0, k.width)
    return slice(*rows.tolist()), slice(*columns.tolist())


def fuse_views(views: Sequence[PosedView], region: ObjectRegion, spec: Fusion) -> Reconstruction:
    """The object's surface. Raises CaptureError where too few views see it, or none of it is confirmed."""
    sights = [sight for view in views if (sight := sight_object(view, region)).fitted.inverse.any()]
    if len(sights) < spec.min_views:
        raise CaptureError(
            "too_few_views",
            f"{len(sights)} of {len(views)} views have depth on the object, and fusion.min_views is {spec.min_views}: "
            "take more pictures, or lower it",
        )
    volume, within_m = empty_volume(region.low, region.high, spec.voxel_m), FRONT_VOXELS * spec.voxel_m
    for sight in sights:
        integrate(volume, sight.fitted, sight.camera)
    mesh = _confirm(extract_surface(volume), sights, spec)
    mesh = _clean(_settle(mesh, sights, within_m), region)
    if not len(mesh.faces):
        raise CaptureError(
            "no_surface",
            f"no point of the object is seen alike by fusion.min_views = {spec.min_views} views: the poses are wrong, or the "
            "object has no depth (shiny, black or transparent)",
        )
    normals = vertex_normals(mesh)
    count = measure_support(mesh.vertices, normals, sights, within_m).views
    colors = color_points(mesh.vertices, normals, sights, within_m)
    seen = count > 0
    cloud = mesh.vertices[seen], normals[seen], colors[seen], count[seen]
    return Reconstruction(*cloud, mesh.vertices, mesh.faces, colors)


def _confirm(mesh: Mesh, sights: Sequence[Sight], spec: Fusion) -> Mesh:
    """What the views confirm, and a camera can see past what they confirm.

    A pixel that mixes two surfaces looks into the object, and there the field has a second surface behind the first.
    """
    normals = vertex_normals(mesh)
    confirmed = measure_support(mesh.vertices, normals, sights, FRONT_VOXELS * spec.voxel_m).confirmed(spec.min_views)
    hiding = keep_vertices(mesh, confirmed)
    normals = normals[np.unique(mesh.faces[confirmed[mesh.faces].all(axis=1)])]
    cameras = [sight.view.depth_camera for sight in sights]
    lift_m = LIFT_VOXELS * spec.voxel_m
    cosine = best_cosine(Caster(hiding), hiding.vertices, normals, cameras, lift_m, FACING_AWAY)
    return keep_vertices(hiding, cosine > FACING_AWAY)


def _settle(mesh: Mesh, sights: Sequence[Sight], within_m: float) -> Mesh:
    """The mesh after each vertex has moved to the mean of the surfaces that the views see there.

    The field rounds edges and thickens thin walls, because it holds what views from the other side saw, too; a view that
    faces a point knows only its own side.
    """
    vertices = mesh.vertices
    for _ in range(STEPS):
        normals = vertex_normals(Mesh(vertices, mesh.faces))
        moved = measure_support(vertices, normals, sights, within_m).mean_m
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
    """What stands above the clearance and the footprint, without small loose parts."""
    # Floors below the clearance are lifted above it while the mesh is cut.
    lifted = Mesh(mesh.vertices + UP * region.lift_m(mesh.vertices)[:, None], mesh.faces)
    cut = cut_below(lifted, region.plane, region.clearance_m)
    mesh = Mesh(cut.vertices - UP * region.lift_m(cut.vertices)[:, None], cut.faces)
    # The cut lies on the clearance itself, and its points must not fall below it by rounding.
    return large_parts(keep_vertices(mesh, region.holds(mesh.vertices + 1e-6 * UP)), LEAST_PART)


def keep_vertices(mesh: Mesh, keep: NDArray[np.bool_]) -> Mesh:
    """The faces whose three vertices are kept, with the vertices that they use."""
    return piece_of(mesh, mesh.faces[keep[mesh.faces].all(axis=1)])


def cut_below(mesh: Mesh, plane: tuple[float, float, float], height_m: float) -> Mesh:
    """What is above the plane z = a x + b y + c + height_m; faces across it are cut along it."""
    a, b, c = plane
    normal = np.array([-a, -b, 1.0])
    normal /= np.linalg.norm(normal)
    if not len(mesh.faces):
        return mesh
    vertices, faces, _ = trimesh.intersections.slice_faces_plane(
        mesh.vertices, mesh.faces, normal, np.array([0.0, 0.0, c + height_m])
    )
    return Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32).reshape(-1, 3))


def large_parts(mesh: Mesh, least_share: float) -> Mesh:
    """The connected parts that have at least a share of the area of the largest one."""
    ends, count = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(mesh.vertices)
    graph = sparse.coo_matrix((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(count, count))
    part = connected_components(graph, directed=False)[1][mesh.faces[:, 0]]
    area = np.bincount(part, weights=face_areas(mesh.vertices, mesh.faces))
    return piece_of(mesh, mesh.faces[area[part] >= least_share * area.max(initial=0.0)])


def vertex_normals(mesh: Mesh) -> Array:
    """[V, 3] unit normals, the mean of the faces' weighted by their area; up where a vertex has no face."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    across, normals = np.cross(b - a, c - a), np.zeros((len(mesh.vertices), 3))
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, corner], weights=across[:, axis], minlength=len(normals))
    length = np.linalg.norm(normals, axis=1)
    normals[length == 0.0] = [0.0, 0.0, 1.0]
    return normals / np.where(length == 0.0, 1.0, length)[:, None]
