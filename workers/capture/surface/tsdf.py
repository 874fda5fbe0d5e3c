"""Truncated signed distances from depth images, and triangle meshes from them.

Planes are fitted to the neighbourhood of each depth pixel: less noise, the angle of incidence, and no flying pixels. On a plane
1/z is linear in the image, so the fit is exact there. Registered depth is coarser than the colour image that it fills, so the
neighbourhood is sampled with a stride that grows with the focal length.

The field is that of Curless and Levoy 1996, with the distance along the surface's normal in place of the distance along the ray,
because the latter grows with the angle of incidence, and weights by inverse variance.
"""

import math
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from schemas.base import Array
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.frames import invert
from workers.geometry.jit import compiled

REACHES = (2, 1)
"""Samples to each side: 5 x 5, and 3 x 3 where those do not lie on a plane, as at a rim."""

MOST_EDGE_DEG = 84.0
"""Angle of incidence beyond which pixels are left out: their depth is a guess."""

SMALL_EDGE_DEG = 60.0
"""Largest angle of incidence of a fit to 3 x 3 samples: three samples across an edge always lie on some steep plane."""

STRIDE_FOCAL_PX = 456.0
"""Focal length at which neighbouring samples are one pixel apart: two pixels at the Azure Kinect's 912, about a depth pixel."""

WIDE = 0.035
"""A sample that is farther from the middle one than this share of its depth belongs to another surface: a slope of 80 degrees
across the neighbourhood."""

GATE = 0.008
"""A sample that is farther from the first fit than this share of its depth, over the cosine of incidence, belongs to another
surface: 6 mm at 0.8 m, three times the noise of a depth pixel that has twice the noise of an Azure Kinect."""

LEAST_SHARE = 0.44
"""A pixel with fewer samples on its own surface, 11 of 25, is a speck or between two surfaces: it is left out."""

ROUGHEST = 1.6
"""Samples that scatter about their plane by so many times the view's median lie on no plane. The scatter of 25 samples of
which some nine are independent varies by a quarter: noise alone does this in one pixel of a hundred."""

LEAST_ROUGH = 0.0003
"""Scatter of 1/z, 1/m, that rounding to millimetres leaves at 1 m: views without noise are not held to less."""

RAMP = 1.6
"""A steep pixel between two surfaces whose cosines of incidence are so many times its own lies on neither of them."""

RAMP_REACH = 4
"""Samples to each side within which those two surfaces are looked for: the width of the window, and a mixed pixel."""

STEEP = 0.5
"""Cosine of incidence below which a pixel may be a ramp: 60 degrees."""


@dataclass(frozen=True, eq=False)
class FittedDepth:
    """A window of a depth image after the fit; its first pixel is the image's (`top`, `left`).

    inverse [h, w] float32: 1/z of the fitted plane, 1/m, 0 where there is none; facing [h, w] float32: the cosine of
    incidence times the length of the pixel's ray at z = 1, which turns a difference of z into a distance from the plane.
    """

    top: int
    left: int
    inverse: NDArray[np.float32]
    facing: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SurfaceDepth(FittedDepth):
    """The fit with what is on an edge found out.

    sure [h, w] uint8: 1 where all samples were fitted, 2 where they were in the pixels around, too, else 0. beyond [h, w]
    float32: `inverse` and, where that is 0, 1/z of the board where the view shows it: there `facing` is the board's.
    """

    sure: NDArray[np.uint8]
    beyond: NDArray[np.float32]


def fit_depth(
    depth_m: NDArray[np.float32], k: Intrinsics, max_edge_deg: float, window: tuple[int, int, int, int] | None = None
) -> FittedDepth:
    """The fit of depth [H, W] in a window (top, left, bottom, right), all of it by default."""
    top, left, bottom, right = window or (0, 0, *depth_m.shape)
    shape = (max(bottom - top, 0), max(right - left, 0))
    inverse, facing, rough = (np.zeros(shape, np.float32) for _ in range(3))
    _fit(depth_m, _focal(k), _stride(k), _least_cos(max_edge_deg), (top, left), REACHES[0], inverse, facing, rough)
    return FittedDepth(top, left, inverse, facing)


def fit_surfaces(depth_m: NDArray[np.float32], k: Intrinsics, max_edge_deg: float) -> SurfaceDepth:
    """The fit of depth [H, W] with fewer samples where more do not lie on a plane, and without ramps between two surfaces."""
    inverse, facing, rough = (np.zeros(depth_m.shape, np.float32) for _ in range(3))
    stride, least_cos, corner = _stride(k), _least_cos(max_edge_deg), (0, 0)
    _fit(depth_m, _focal(k), stride, least_cos, corner, REACHES[0], inverse, facing, rough)
    usual = float(np.median(rough[inverse > 0.0])) if inverse.any() else 0.0
    roughest = ROUGHEST * max(usual, LEAST_ROUGH)
    bent = rough > roughest
    inverse[bent] = 0.0
    whole = inverse > 0.0
    rough[~bent] = SETTLED
    least_cos = max(least_cos, _least_cos(SMALL_EDGE_DEG))
    _fit(depth_m, _focal(k), stride, least_cos, corner, REACHES[1], inverse, facing, rough)
    inverse[rough > roughest] = 0.0
    ramps = _ramps(inverse, facing, stride)
    inverse[ramps] = 0.0
    whole &= ~ramps
    sure = whole.astype(np.uint8) + ndimage.binary_erosion(whole, np.ones((3, 3), np.bool_))
    return SurfaceDepth(0, 0, inverse, facing, sure, inverse)


def _focal(k: Intrinsics) -> tuple[float, float, float, float]:
    return k.fx, k.fy, k.cx, k.cy


def _stride(k: Intrinsics) -> int:
    return max(1, round(k.fx / STRIDE_FOCAL_PX))


def _least_cos(max_edge_deg: float) -> float:
    return math.cos(math.radians(max_edge_deg))


def _ramps(inverse: NDArray[np.float32], facing: NDArray[np.float32], stride: int) -> NDArray[np.bool_]:
    """[h, w] bool: steep pixels between two less steep ones, along a row or a column, that are no farther off than `WIDE`.

    Where two surfaces lie one behind the other by less than that, mixed pixels join them, and a plane fits the ramp.
    """
    (height, width), reach = inverse.shape, RAMP_REACH * stride
    q, facing_around, found = np.pad(inverse, reach), np.pad(facing, reach), np.zeros(inverse.shape, np.bool_)

    def flattest(down: int, right: int) -> NDArray[np.float32]:
        best = np.zeros(inverse.shape, np.float32)
        for n in range(2 * stride, reach + 1):
            at = np.s_[reach + n * down :, reach + n * right :]
            near = np.abs(q[at][:height, :width] - inverse) < WIDE * inverse
            best = np.maximum(best, np.where(near, facing_around[at][:height, :width], 0.0))
        return best

    for down, right in ((0, 1), (1, 0)):
        found |= np.minimum(flattest(down, right), flattest(-down, -right)) > RAMP * facing
    return found & (facing < STEEP)


SETTLED = -1.0
"""Roughness of a pixel that is not fitted again."""


@compiled
def _fit(
    depth_m: NDArray[np.float32],
    k: tuple[float, float, float, float],
    stride: int,
    least_cos: float,
    corner: tuple[int, int],
    reach: int,
    inverse: NDArray[np.float32],
    facing: NDArray[np.float32],
    rough: NDArray[np.float32],
) -> None:
    """Two fits of 1/z = a + b du + c dv: to the samples at about the pixel's depth, then to those near the first plane.

    `reach`: samples to each side. rough [h, w] is `SETTLED` where nothing is to be done; it becomes the scatter of 1/z about
    the plane, 1/m, times the slope, by which a depth camera's noise grows.
    """
    height, width = depth_m.shape
    side = 2 * reach + 1
    least = int(np.ceil(LEAST_SHARE * side * side))
    q, at_x, at_y = np.empty(side * side), np.empty(side * side), np.empty(side * side)
    plane = np.empty(3)
    for at_row in range(inverse.shape[0]):
        row = at_row + corner[0]
        ray_y = (row + 0.5 - k[3]) / k[1]
        for at_column in range(inverse.shape[1]):
            column = at_column + corner[1]
            z0 = depth_m[row, column]
            if not z0 > 0.0 or rough[at_row, at_column] < 0.0:
                continue
            rough[at_row, at_column] = 0.0
            n = 0
            for i in range(-reach, reach + 1):
                y = row + i * stride
                for j in range(-reach, reach + 1):
                    x = column + j * stride
                    if 0 <= y < height and 0 <= x < width:
                        z = depth_m[y, x]
                        if z0 * (1.0 - WIDE) < z < z0 * (1.0 + WIDE):
                            q[n], at_x[n], at_y[n] = 1.0 / z, j, i
                            n += 1
            if n < least or not _solve(q, at_x, at_y, n, plane):
                continue
            ray_x = (column + 0.5 - k[2]) / k[0]
            ray = np.sqrt(1.0 + ray_x * ray_x + ray_y * ray_y)
            slope = _facing(plane, stride, k, ray_x, ray_y)
            # dz = z^2 dq, so a share of the depth is the same share of its inverse.
            gate = min(GATE * ray / slope, WIDE) * plane[0]
            kept = 0
            for i in range(n):
                if abs(q[i] - plane[0] - plane[1] * at_x[i] - plane[2] * at_y[i]) < gate:
                    q[kept], at_x[kept], at_y[kept] = q[i], at_x[i], at_y[i]
                    kept += 1
            if kept < least or not _solve(q, at_x, at_y, kept, plane):
                continue
            slope = _facing(plane, stride, k, ray_x, ray_y)
            if slope >= least_cos * ray and abs(1.0 / z0 - plane[0]) < gate:
                inverse[at_row, at_column] = plane[0]
                facing[at_row, at_column] = slope
                total = 0.0
                for i in range(kept):
                    error = q[i] - plane[0] - plane[1] * at_x[i] - plane[2] * at_y[i]
                    total += error * error
                rough[at_row, at_column] = slope * np.sqrt(total / (kept - 3))


@compiled
def _solve(q: Array, x: Array, y: Array, n: int, plane: Array) -> bool:
    """Least squares of q = plane . (1, x, y) by Cramer's rule about the means; False where the samples lie in a line."""
    mx = my = mq = 0.0
    for i in range(n):
        mx += x[i]
        my += y[i]
        mq += q[i]
    mx, my, mq = mx / n, my / n, mq / n
    cxx = cyy = cxy = cxq = cyq = 0.0
    for i in range(n):
        dx, dy, dq = x[i] - mx, y[i] - my, q[i] - mq
        cxx += dx * dx
        cyy += dy * dy
        cxy += dx * dy
        cxq += dx * dq
        cyq += dy * dq
    area = cxx * cyy - cxy * cxy
    if not area > 1e-9:
        return False
    plane[1] = (cxq * cyy - cyq * cxy) / area
    plane[2] = (cyq * cxx - cxq * cxy) / area
    plane[0] = mq - plane[1] * mx - plane[2] * my
    return bool(plane[0] > 0.0)


@compiled
def _facing(plane: Array, stride: int, k: tuple[float, float, float, float], ray_x: float, ray_y: float) -> float:
    """Cosine of incidence times the ray's length: the plane is A x + B y + C z = 1 in camera coordinates."""
    A, B = plane[1] / stride * k[0], plane[2] / stride * k[1]
    C = plane[0] - A * ray_x - B * ray_y
    return float(plane[0] / np.sqrt(A * A + B * B + C * C))


FRONT_VOXELS = 3.0
"""Distances in front of the surface are cut off here: above the noise of a view after its fit, which is about 1 mm."""

BACK_VOXELS = 2.0
"""Behind the surface nothing is known from here on: short, so that the two sides of a thin wall hardly touch."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxel centres at origin + voxel_m * (i, j, k), board frame; distance_m and weight [X, Y, Z] float32.

    distance_m is positive outside; weight is 0 where no view has seen the voxel.
    """

    origin: Array
    voxel_m: float
    distance_m: NDArray[np.float32]
    weight: NDArray[np.float32]


def empty_volume(low: Array, high: Array, voxel_m: float) -> Volume:
    """A volume without views that reaches from corner to corner, board frame, metres."""
    shape = np.maximum(np.ceil((high - low) / voxel_m).astype(np.int64) + 1, 2)
    distance_m, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    return Volume(np.array(low), voxel_m, distance_m, weight)


def integrate(volume: Volume, fitted: SurfaceDepth, camera: Camera) -> None:
    """Adds one view's depth to the volume."""
    k = camera.intrinsics
    _integrate(
        volume.distance_m,
        volume.weight,
        volume.origin,
        volume.voxel_m,
        invert(camera.T_world_cam),
        (k.fx, k.fy, k.cx - fitted.left - 0.5, k.cy - fitted.top - 0.5),
        fitted.inverse,
        fitted.facing,
        fitted.beyond,
    )


@compiled
def sample_inverse(inverse: NDArray[np.float32], x: float, y: float) -> float:
    """1/z at (x, y), pixel centres on integers, 0 where there is none.

    Bilinear where all four pixels are of one surface, else the nearest pixel's.
    """
    height, width = inverse.shape
    near_column, near_row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
    if near_column < 0 or near_row < 0 or near_column >= width or near_row >= height:
        return 0.0
    nearest = inverse[near_row, near_column]
    column, row = int(np.floor(x)), int(np.floor(y))
    if nearest == 0.0 or column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
        return nearest
    a, b = inverse[row, column], inverse[row, column + 1]
    c, d = inverse[row + 1, column], inverse[row + 1, column + 1]
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not least > 0.988 * most:
        return nearest
    s, t = x - column, y - row
    return (a * (1.0 - s) + b * s) * (1.0 - t) + (c * (1.0 - s) + d * s) * t


@compiled
def _integrate(
    distance_m: NDArray[np.float32],
    weight: NDArray[np.float32],
    origin: Array,
    voxel_m: float,
    T: Array,
    k: tuple[float, float, float, float],
    inverse: NDArray[np.float32],
    facing: NDArray[np.float32],
    beyond: NDArray[np.float32],
) -> None:
    """T: board to camera; k: fx, fy, cx, cy of the window with pixel centres on integers."""
    front, back, full = FRONT_VOXELS * voxel_m, BACK_VOXELS * voxel_m, 0.5 * BACK_VOXELS * voxel_m
    height, width = inverse.shape
    for i in range(distance_m.shape[0]):
        for j in range(distance_m.shape[1]):
            bx, by = origin[0] + i * voxel_m, origin[1] + j * voxel_m
            for n in range(distance_m.shape[2]):
                bz = origin[2] + n * voxel_m
                z = T[2, 0] * bx + T[2, 1] * by + T[2, 2] * bz + T[2, 3]
                if not z > 0.05:
                    continue
                x = k[0] * (T[0, 0] * bx + T[0, 1] * by + T[0, 2] * bz + T[0, 3]) / z + k[2]
                y = k[1] * (T[1, 0] * bx + T[1, 1] * by + T[1, 2] * bz + T[1, 3]) / z + k[3]
                if not (-0.5 < x < width - 0.5 and -0.5 < y < height - 0.5):
                    continue
                row, column = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
                q, slope, behind = sample_inverse(inverse, x, y), facing[row, column], back
                if q == 0.0:  # of the board a view says where nothing is
                    q, behind = beyond[row, column], 0.0
                    if q == 0.0:
                        continue
                s = (1.0 / q - z) * slope
                if s <= -behind:
                    continue
                # Depth's standard deviation grows with z^2 and with 1 / cosine.
                w = slope * slope * q * q * q * q
                if s < -full:
                    w *= (back + s) / (back - full)
                total = weight[i, j, n] + w
                s = min(s, front)
                distance_m[i, j, n] = (distance_m[i, j, n] * weight[i, j, n] + s * w) / total
                weight[i, j, n] = total


EMPTY = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))


def extract_surface(volume: Volume) -> Mesh:
    """The surface at distance 0 between voxels that were seen, wound outwards, board frame (Lewiner's marching cubes)."""
    seen = volume.weight > 0.0
    if not ((volume.distance_m > 0.0) & seen).any() or not ((volume.distance_m < 0.0) & seen).any():
        return EMPTY
    # Voxels at the far corner of a cell whose eight voxels were seen: so skimage reads its mask.
    whole = ndimage.binary_erosion(seen, np.ones((2, 2, 2), np.bool_))
    try:
        vertices, faces, _, _ = marching_cubes(
            volume.distance_m, 0.0, mask=whole, allow_degenerate=False, gradient_direction="descent"
        )
    except RuntimeError:  # no surface in the cells that were seen
        return EMPTY
    return Mesh(volume.origin + volume.voxel_m * vertices.astype(np.float64), faces.astype(np.int32))


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


def keep_vertices(mesh: Mesh, keep: NDArray[np.bool_]) -> tuple[Mesh, NDArray[np.int64]]:
    """(the faces whose three vertices are kept, with the vertices that they use; the old numbers of those)."""
    faces = mesh.faces[keep[mesh.faces].all(axis=1)]
    used = np.unique(faces)
    number = np.zeros(len(mesh.vertices), np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return Mesh(mesh.vertices[used], number[faces]), used.astype(np.int64)


def large_parts(mesh: Mesh, least_share: float) -> NDArray[np.bool_]:
    """[V] bool: vertices of connected parts that have at least a share of the area of the largest one."""
    count = len(mesh.vertices)
    if not len(mesh.faces):
        return np.zeros(count, bool)
    i, j = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = sparse.coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(count, count))
    parts, label = connected_components(graph, directed=False)
    area = np.bincount(label[mesh.faces[:, 0]], weights=face_areas(mesh), minlength=parts)
    large: NDArray[np.bool_] = (area >= least_share * area.max())[label]
    return large


def face_areas(mesh: Mesh) -> Array:
    """[F] areas, m^2."""
    return 0.5 * np.linalg.norm(_face_normals(mesh), axis=1)


def vertex_normals(mesh: Mesh) -> Array:
    """[V, 3] unit normals, the mean of the faces' weighted by their area; up where a vertex has no face."""
    normals = np.zeros((len(mesh.vertices), 3))
    across = _face_normals(mesh)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, corner], weights=across[:, axis], minlength=len(normals))
    length = np.linalg.norm(normals, axis=1)
    normals[length == 0.0] = [0.0, 0.0, 1.0]
    return normals / np.where(length == 0.0, 1.0, length)[:, None]


def _face_normals(mesh: Mesh) -> Array:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    across: Array = np.cross(b - a, c - a)
    return across
