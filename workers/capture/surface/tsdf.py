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
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from schemas.base import Array
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from workers.capture.surface.posed_view import pixel_of
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
    """A depth image after the fit.

    inverse [h, w] float32: 1/z of the fitted plane, 1/m, 0 where there is none; facing [h, w] float32: the cosine of
    incidence times the length of the pixel's ray at z = 1, which turns a difference of z into a distance from the plane.
    """

    inverse: NDArray[np.float32]
    facing: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SurfaceDepth(FittedDepth):
    """The fit with its edges marked.

    sure [h, w] uint8: 1 where all samples were fitted, 2 where they were in the pixels around, too, else 0. beyond [h, w]
    float32: `inverse` and, where that is 0, 1/z of the board where the view shows it: there `facing` is the board's.
    """

    sure: NDArray[np.uint8]
    beyond: NDArray[np.float32]


def fit_depth(depth_m: NDArray[np.float32], k: Intrinsics) -> FittedDepth:
    """The fit of depth [H, W]."""
    inverse, facing, _ = _fit_planes(depth_m, depth_m > 0.0, k, REACHES[0], MOST_EDGE_DEG)
    return FittedDepth(inverse, facing)


def fit_surfaces(depth_m: NDArray[np.float32], k: Intrinsics) -> SurfaceDepth:
    """The fit of depth [H, W] with fewer samples where more do not lie on a plane, and without ramps between two surfaces."""
    inverse, facing, rough = _fit_planes(depth_m, depth_m > 0.0, k, REACHES[0], MOST_EDGE_DEG)
    usual = float(np.median(rough[inverse > 0.0])) if inverse.any() else 0.0
    roughest = ROUGHEST * max(usual, LEAST_ROUGH)
    bent = rough > roughest
    whole = (inverse > 0.0) & ~bent
    fewer = _fit_planes(depth_m, bent, k, REACHES[1], SMALL_EDGE_DEG)
    inverse[bent] = np.where(fewer[2] > roughest, 0.0, fewer[0])[bent]
    facing[bent] = fewer[1][bent]
    ramps = _ramps(inverse, facing, _stride(k))
    inverse[ramps] = 0.0
    whole &= ~ramps
    sure = whole.astype(np.uint8) + ndimage.binary_erosion(whole, np.ones((3, 3), np.bool_))
    return SurfaceDepth(inverse, facing, sure, inverse)


def _stride(k: Intrinsics) -> int:
    return max(1, round(k.fx / STRIDE_FOCAL_PX))


def _ramps(inverse: NDArray[np.float32], facing: NDArray[np.float32], stride: int) -> NDArray[np.bool_]:
    """[h, w] bool: steep pixels between two less steep ones, along a row or a column, that are no farther off than `WIDE`.

    Where two surfaces lie one behind the other by less than that, mixed pixels join them, and a plane fits the ramp.
    """
    (height, width), reach = inverse.shape, RAMP_REACH * stride
    q, facing_around, ramps = np.pad(inverse, reach), np.pad(facing, reach), np.zeros(inverse.shape, np.bool_)

    def flattest(down: int, right: int) -> NDArray[np.float32]:
        best = np.zeros(inverse.shape, np.float32)
        for n in range(2 * stride, reach + 1):
            at = np.s_[reach + n * down :, reach + n * right :]
            near = np.abs(q[at][:height, :width] - inverse) < WIDE * inverse
            best = np.maximum(best, np.where(near, facing_around[at][:height, :width], 0.0))
        return best

    for down, right in ((0, 1), (1, 0)):
        ramps |= np.minimum(flattest(down, right), flattest(-down, -right)) > RAMP * facing
    return ramps & (facing < STEEP)


Fit = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""(inverse, facing, rough), each [h, w], 0 where no plane fits. rough: the scatter of 1/z about the plane, 1/m, times the slope
`facing`, by which noise grows."""

Plane = tuple[float, float, float]
"""1/z = a + b i + c j of a pixel's neighbourhood, i columns and j rows from the pixel, in strides; a is 0 for no plane."""


def _fit_planes(
    depth_m: NDArray[np.float32], asked: NDArray[np.bool_], k: Intrinsics, reach: int, max_edge_deg: float
) -> Fit:
    """Fits a plane to the samples around each pixel that is asked for; `reach`: samples to each side."""
    least_cos = math.cos(math.radians(max_edge_deg))
    return _fit(depth_m, asked, (k.fx, k.fy, k.cx, k.cy), _stride(k), reach, least_cos)


@compiled
def _fit(
    depth_m: NDArray[np.float32],
    asked: NDArray[np.bool_],
    k: tuple[float, float, float, float],
    stride: int,
    reach: int,
    least_cos: float,
) -> Fit:
    """Each plane is fitted twice: to the samples at about the pixel's depth, then to those of them near the first plane."""
    height, width = depth_m.shape
    inverse, facing = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    rough, samples = np.zeros((height, width), np.float32), np.empty(((2 * reach + 1) ** 2, 3))
    least = int(np.ceil(LEAST_SHARE * len(samples)))
    for row in range(height):
        ray_y = (row + 0.5 - k[3]) / k[1]
        for column in range(width):
            if not asked[row, column]:
                continue
            ray_x = (column + 0.5 - k[2]) / k[0]
            ray = np.sqrt(1.0 + ray_x * ray_x + ray_y * ray_y)
            count = _gather(depth_m, row, column, stride, reach, samples)
            plane = _solve(samples, count, least)
            if plane[0] == 0.0:
                continue
            # dz = z^2 d(1/z), so a share of the depth is the same share of its inverse.
            gate = min(GATE * ray / _facing(plane, stride, k, ray_x, ray_y), WIDE) * plane[0]
            count = _keep_near(samples, count, plane, gate)
            plane = _solve(samples, count, least)
            if plane[0] == 0.0:
                continue
            slope = _facing(plane, stride, k, ray_x, ray_y)
            if slope >= least_cos * ray and abs(1.0 / depth_m[row, column] - plane[0]) < gate:
                inverse[row, column], facing[row, column] = plane[0], slope
                rough[row, column] = slope * _scatter(samples, count, plane)
    return inverse, facing, rough


@compiled
def _gather(depth_m: NDArray[np.float32], row: int, column: int, stride: int, reach: int, samples: Array) -> int:
    """The number of samples around a pixel at about its depth; their (1/z, i, j) go into `samples`."""
    height, width = depth_m.shape
    z0, count = depth_m[row, column], 0
    for j in range(-reach, reach + 1):
        for i in range(-reach, reach + 1):
            y, x = row + j * stride, column + i * stride
            if 0 <= y < height and 0 <= x < width and z0 * (1.0 - WIDE) < depth_m[y, x] < z0 * (1.0 + WIDE):
                samples[count, 0], samples[count, 1], samples[count, 2] = 1.0 / depth_m[y, x], i, j
                count += 1
    return count


@compiled
def _solve(samples: Array, count: int, least: int) -> Plane:
    """Least squares by Cramer's rule about the means; no plane for fewer than `least` samples, or samples in a line."""
    if count < least:
        return 0.0, 0.0, 0.0
    mq = mi = mj = 0.0
    for n in range(count):
        mq, mi, mj = mq + samples[n, 0], mi + samples[n, 1], mj + samples[n, 2]
    mq, mi, mj = mq / count, mi / count, mj / count
    ii = jj = ij = iq = jq = 0.0
    for n in range(count):
        q, i, j = samples[n, 0] - mq, samples[n, 1] - mi, samples[n, 2] - mj
        ii, jj, ij = ii + i * i, jj + j * j, ij + i * j
        iq, jq = iq + i * q, jq + j * q
    area = ii * jj - ij * ij
    if not area > 1e-9:
        return 0.0, 0.0, 0.0
    b, c = (iq * jj - jq * ij) / area, (jq * ii - iq * ij) / area
    return max(mq - b * mi - c * mj, 0.0), b, c


@compiled
def _off_plane(sample: Array, plane: Plane) -> float:
    """1/z of a sample less that of the plane there."""
    return float(sample[0] - plane[0] - plane[1] * sample[1] - plane[2] * sample[2])


@compiled
def _keep_near(samples: Array, count: int, plane: Plane, gate: float) -> int:
    """Moves the samples that are nearer to the plane than `gate`, 1/m, to the front; their number."""
    kept = 0
    for n in range(count):
        if abs(_off_plane(samples[n], plane)) < gate:
            samples[kept] = samples[n]
            kept += 1
    return kept


@compiled
def _scatter(samples: Array, count: int, plane: Plane) -> float:
    """Standard deviation of 1/z of samples about their plane, which takes up three numbers."""
    total = 0.0
    for n in range(count):
        total += _off_plane(samples[n], plane) ** 2
    return float(np.sqrt(total / (count - 3)))


@compiled
def _facing(plane: Plane, stride: int, k: tuple[float, float, float, float], ray_x: float, ray_y: float) -> float:
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
    return Volume(np.array(low), voxel_m, np.zeros(shape, np.float32), np.zeros(shape, np.float32))


def integrate(volume: Volume, fitted: SurfaceDepth, camera: Camera) -> None:
    """Adds the depth of one view, whose first pixel is the camera's, to the volume."""
    k, T = camera.intrinsics, invert(camera.T_world_cam)
    into = volume.distance_m, volume.weight, volume.origin, volume.voxel_m
    pinhole = k.fx, k.fy, k.cx_opencv, k.cy_opencv
    _integrate(*into, T, pinhole, fitted.inverse, fitted.facing, fitted.beyond)


@compiled
def sample_inverse(inverse: NDArray[np.float32], x: float, y: float) -> float:
    """1/z at (x, y) within half a pixel of the image, pixel centres on integers, 0 where there is none.

    Bilinear where all four pixels are of one surface, else the nearest pixel's.
    """
    height, width = inverse.shape
    nearest = inverse[int(np.floor(y + 0.5)), int(np.floor(x + 0.5))]
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
    """T: board to camera; k: fx, fy, cx, cy with pixel centres on integers; the last three are a `SurfaceDepth`'s.

    One loop: a call for each voxel with a tuple of pictures takes three times as long.
    """
    front, back, full = FRONT_VOXELS * voxel_m, BACK_VOXELS * voxel_m, 0.5 * BACK_VOXELS * voxel_m
    height, width = inverse.shape
    for i in range(distance_m.shape[0]):
        for j in range(distance_m.shape[1]):
            for n in range(distance_m.shape[2]):
                x, y, z = pixel_of(T, k, origin[0] + i * voxel_m, origin[1] + j * voxel_m, origin[2] + n * voxel_m)
                if not (z > 0.0 and -0.5 < x < width - 0.5 and -0.5 < y < height - 0.5):
                    continue
                row, column = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
                q, slope, behind = sample_inverse(inverse, x, y), facing[row, column], back
                if q == 0.0:  # of the board a view says where nothing is
                    q, behind = beyond[row, column], 0.0
                s = (1.0 / q - z) * slope if q > 0.0 else -back
                if s <= -behind:
                    continue
                # Depth's standard deviation grows with z^2 and with 1 / cosine.
                w = slope * slope * q * q * q * q
                if s < -full:
                    w *= (back + s) / (back - full)
                total = weight[i, j, n] + w
                distance_m[i, j, n] = (distance_m[i, j, n] * weight[i, j, n] + min(s, front) * w) / total
                weight[i, j, n] = total


def extract_surface(volume: Volume) -> Mesh:
    """The surface at distance 0 between voxels that were seen, wound outwards, board frame (Lewiner's marching cubes)."""
    # Voxels at the far corner of a cell whose eight voxels were seen: so skimage reads its mask.
    whole = ndimage.binary_erosion(volume.weight > 0.0, np.ones((2, 2, 2), np.bool_))
    try:
        vertices, faces, _, _ = marching_cubes(
            volume.distance_m, 0.0, mask=whole, allow_degenerate=False, gradient_direction="descent"
        )
    except (RuntimeError, ValueError):  # no surface in the cells that were seen
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    return Mesh(volume.origin + volume.voxel_m * vertices.astype(np.float64), faces.astype(np.int32))
