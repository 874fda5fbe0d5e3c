"""The pixels of an image: the rays that a lens gives them, depth as stored, colours, extents of regions, normals and smoothness.

Lenses are OpenCV's: Brown-Conrady with the radial factor (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6), as [8]
float64 in its order: k1, k2, p1, p2, k3, k4, k5, k6. Image coordinates are pixels from the left and upper edge: a pixel's centre
is at +0.5 here, and at a whole number in OpenCV.
"""

import functools
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.job.views import Distortion, Images
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.jit import compiled, compiled_for


class Extent(NamedTuple):
    """A region's number of pixels and bounding box (x, y, width, height); all 0 for a region without pixels."""

    pixels: int
    bbox_xywh: tuple[int, int, int, int]


@compiled_for("const(f4[:,::1]), f8, f8, f8", "f8[:,::1], f8, f8, f8")
def round_depth(depth_m: NDArray[np.floating], low_m: float, high_m: float, units_per_m: float) -> NDArray[np.uint16]:
    """[H, W] uint16: depth [H, W] in units, to the nearest (ties to even); 0 unless low < depth < high (0 for nan)."""
    units = np.empty(depth_m.shape, np.uint16)
    for row in range(depth_m.shape[0]):
        for column in range(depth_m.shape[1]):
            z = np.float64(depth_m[row, column])
            # A choice between values and not a branch, and a conversion by way of 32 bits, so that this is vectorised.
            nearest = np.rint(z * units_per_m) if (z > low_m) & (z < high_m) else 0.0
            units[row, column] = np.uint16(np.int32(nearest))
    return units


def fill_plane_depth(
    depth_m: NDArray[np.float32], region: NDArray[np.uint8], region_id: int, plane: NDArray[np.float32], k: Intrinsics
) -> None:
    """Writes z along the optical axis into `depth_m` [H, W] where `region` [H, W] is `region_id`, of one plane.

    plane [4]: (n, n . p) in the optical frame. z = n . p / (n . ray), ray = ((x - cx) / fx, (y - cy) / fy, 1), in float32 and
    in this order, as a fragment shader computes it.
    """
    view = np.array([k.cx, k.cy, 1.0 / k.fx, 1.0 / k.fy], np.float32)
    _fill_plane_depth(depth_m, region, np.uint8(region_id), plane, view)


def fourth_channel(rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] uint8: the last of four channels [H, W, 4]. OpenCV takes three times as long."""
    channel = np.empty(rgba.shape[:2], np.uint8)
    _high_bytes(rgba.reshape(-1).view("<u4"), channel.reshape(-1))
    return channel


@compiled_for("u4[::1], u1[::1]")
def _high_bytes(words: NDArray[np.uint32], high: NDArray[np.uint8]) -> None:
    for n in range(len(words)):
        high[n] = np.uint8(words[n] >> np.uint32(24))


@compiled_for("f4[:,::1], u1[:,::1], u1, f4[::1], f4[::1]")
def _fill_plane_depth(
    depth_m: NDArray[np.float32],
    region: NDArray[np.uint8],
    region_id: np.uint8,
    plane: NDArray[np.float32],
    view: NDArray[np.float32],
) -> None:
    a, b, c, d = plane[0], plane[1], plane[2], plane[3]
    half, ax = np.float32(0.5), np.empty(region.shape[1], np.float32)
    for column in range(region.shape[1]):
        ax[column] = a * ((np.float32(column) + half - view[0]) * view[2])
    for row in range(region.shape[0]):
        by = b * ((np.float32(row) + half - view[1]) * view[3])
        for column in range(region.shape[1]):
            z = d / (ax[column] + by + c)
            depth_m[row, column] = z if region[row, column] == region_id else depth_m[row, column]


@compiled_for("const(u1[:,:,::1]), i4[:,::1]")
def gather_colours(rgb: NDArray[np.uint8], source: NDArray[np.integer]) -> NDArray[np.uint8]:
    """[H, W, C] uint8: at each pixel that of `rgb` [h, w, C] with the flat index `source` [H, W], with its alpha; 0 for -1."""
    channels = rgb.shape[2]
    gathered = np.zeros((source.shape[0], source.shape[1], channels), np.uint8)
    pixels = np.ascontiguousarray(rgb).reshape(-1, channels)
    for row in range(source.shape[0]):
        for column in range(source.shape[1]):
            index = source[row, column]
            if index >= 0:
                for channel in range(channels):
                    gathered[row, column, channel] = pixels[index, channel]
    return gathered


def measure_regions(region: NDArray[np.uint8]) -> list[Extent]:
    """The extent of each of the 256 region ids in a mask [H, W]."""
    counts, boxes = np.zeros(256, np.int64), np.zeros((256, 4), np.int64)
    boxes[:, :2] = max(region.shape)
    whole = np.ascontiguousarray(region)
    words = whole.view(np.uint64) if region.shape[1] % 8 == 0 else np.empty((len(region), 0), np.uint64)
    _measure_regions(whole, words, counts, boxes)
    extents = [Extent(0, (0, 0, 0, 0))] * 256
    for found in np.flatnonzero(counts).tolist():
        x, y, right, bottom = boxes[found].tolist()
        extents[found] = Extent(int(counts[found]), (x, y, right - x, bottom - y))
    return extents


@compiled_for("const(u1[:,::1]), const(u8[:,::1]), i8[::1], i8[:,::1]")
def _measure_regions(
    region: NDArray[np.uint8], words: NDArray[np.uint64], counts: NDArray[np.int64], boxes: NDArray[np.int64]
) -> None:
    """Adds up runs of one id along each row; boxes are left, top, right and bottom, the last two excluded.

    `words` are the same pixels eight at a time, or none.
    """
    height, width = region.shape
    for row in range(height):
        first, here, eights = 0, region[row], words[row]
        while first < width:
            region_id = here[first]
            stop = first + 1
            eight = np.uint64(region_id) * np.uint64(0x0101010101010101)
            while stop < width and here[stop] == region_id:
                stop += 1
                if stop % 8 == 0 and len(eights):
                    word = stop // 8
                    while word < len(eights) and eights[word] == eight:
                        word += 1
                    stop = 8 * word
            counts[region_id] += stop - first
            boxes[region_id, 0] = min(boxes[region_id, 0], first)
            boxes[region_id, 1] = min(boxes[region_id, 1], row)
            boxes[region_id, 2] = max(boxes[region_id, 2], stop)
            boxes[region_id, 3] = max(boxes[region_id, 3], row + 1)
            first = stop


@compiled_for("u2[:,::1], u2[:,::1], f8")
def count_filled(projected: NDArray[np.uint16], seen: NDArray[np.uint16], behind: float) -> tuple[int, int]:
    """(pixels that are not 0 in `projected`, those of them that lie more than `behind` units behind `seen`)."""
    filled = hidden = 0
    # Whole numbers of 16 bits differ by more than this where they do by more than `behind`.
    whole = np.int32(min(np.floor(behind), 65_535.0))
    for row in range(projected.shape[0]):
        here, there = projected[row], seen[row]
        row_filled = row_hidden = np.int32(0)  # of a row, in 32 bits: twice as many in a vector
        for column in range(len(here)):
            drawn, farthest = np.int32(here[column]), np.int32(there[column]) + whole
            row_filled = np.int32(row_filled + np.int32(drawn > 0))
            row_hidden = np.int32(row_hidden + np.int32((drawn > 0) & (there[column] > 0) & (drawn > farthest)))
        filled, hidden = filled + int(row_filled), hidden + int(row_hidden)
    return filled, hidden


def quantise_depth(depth_m: NDArray[np.floating], images: Images) -> NDArray[np.uint16]:
    """[H, W] uint16: z to the nearest unit; 0 where nothing was hit or z is outside the open range that is stored."""
    low, high = images.depth_range_m
    return round_depth(depth_m, low, high, images.depth_units_per_m)


def dequantise_depth(depth: NDArray[np.uint16], images: Images) -> Array:
    """[H, W] float64 metres, 0 where there is none: what a reader of the stored image gets."""
    return depth / images.depth_units_per_m


Depth = NDArray[np.floating] | NDArray[np.uint16]
"""[H, W] z along the optical axis, in units of 1 / `units_per_m` metres; 0 where there is none."""


def facing_cosine(
    depth: Depth,
    region: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    camera: Camera,
    viewpoint: Array,
    units_per_m: float = 1.0,
) -> Array:
    """Cosine between the surface's normal and the direction to `viewpoint` (world), at some pixels; nan where unknown.

    pixels [N] flat indices; returns [N] float64. The normal comes from central differences of the unprojected depth, on
    the side of the camera that took it; it is known where the pixel and its four neighbours have depth and belong to one
    region.
    """
    k = camera.intrinsics
    eye = camera.T_world_cam[:3, :3].T @ (viewpoint - camera.position)
    return _facing_cosine(depth, units_per_m, region, pixels, (k.cx, k.cy, k.fx, k.fy), eye)


Point = tuple[float, float, float]


@compiled
def _point(depth: Depth, units_per_m: float, row: int, column: int, k: tuple[float, float, float, float]) -> Point:
    """What a pixel sees, metres, in the camera's frame; k: cx, cy, fx, fy."""
    z = depth[row, column] / units_per_m
    return (column + 0.5 - k[0]) / k[2] * z, (row + 0.5 - k[1]) / k[3] * z, z


@compiled
def _between(a: Point, b: Point) -> Point:
    """A minus b: tuples, because numba allocates an array for each difference of arrays."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _facing_cosine(
    depth: Depth,
    units_per_m: float,
    region: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    k: tuple[float, float, float, float],
    eye: Array,
) -> Array:
    """k: cx, cy, fx, fy."""
    cosine = np.full(len(pixels), np.nan)
    for n in range(len(pixels)):
        row, column = pixels[n] // depth.shape[1], pixels[n] % depth.shape[1]
        cosine[n] = facing_at(depth, units_per_m, region, row, column, k, (eye[0], eye[1], eye[2]))
    return cosine


@compiled
def facing_at(
    depth: Depth,
    units_per_m: float,
    region: NDArray[np.uint8],
    row: int,
    column: int,
    k: tuple[float, float, float, float],
    eye: Point,
) -> float:
    """The cosine of `facing_cosine` at one pixel; k: cx, cy, fx, fy; eye: the viewpoint in the camera's frame.

    In that frame x runs right and y down, so that y across x points towards the camera.
    """
    if row == 0 or column == 0 or row == depth.shape[0] - 1 or column == depth.shape[1] - 1:
        return np.nan
    known = True
    for dy, dx in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)):
        alike = region[row + dy, column + dx] == region[row, column]
        known = known and alike and depth[row + dy, column + dx] > 0
    if not known:
        return np.nan
    a = _between(_point(depth, units_per_m, row + 1, column, k), _point(depth, units_per_m, row - 1, column, k))
    b = _between(_point(depth, units_per_m, row, column + 1, k), _point(depth, units_per_m, row, column - 1, k))
    normal = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    towards = _between(eye, _point(depth, units_per_m, row, column, k))
    along = normal[0] * towards[0] + normal[1] * towards[1] + normal[2] * towards[2]
    length2 = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
    away2 = towards[0] * towards[0] + towards[1] * towards[1] + towards[2] * towards[2]
    if length2 > 0.0 and away2 > 0.0:
        return along / (math.sqrt(length2) * math.sqrt(away2))
    return np.nan


@compiled
def is_smooth(
    depth: Depth, region: NDArray[np.uint8], row: int, column: int, bound_m: float, units_per_m: float
) -> bool:
    """Whether a pixel and its four neighbours see one smooth surface of one region.

    On a plane 1/z is linear in the image; its second differences, times z squared, are the step in depth that
    a plane does not explain, and must stay below `bound_m` along rows and along columns.
    """
    height, width = depth.shape
    z = depth[row, column] / units_per_m
    good = 0 < row < height - 1 and 0 < column < width - 1 and z > 0.0
    for dy, dx in ((0, 1), (1, 0)):
        if good:
            a, b = depth[row + dy, column + dx] / units_per_m, depth[row - dy, column - dx] / units_per_m
            alike = region[row + dy, column + dx] == region[row, column] == region[row - dy, column - dx]
            good = alike and a > 0.0 and b > 0.0 and abs(1.0 / a + 1.0 / b - 2.0 / z) * z * z < bound_m
    return good


WIDEST = 5.0
"""Largest distance from the axis at z = 1 that a lens is used at: 79 degrees."""

STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-11)
"""OpenCV inverts a lens by steps of a fixed-point iteration. These reach rounding, where its default of five does not."""

FOUND_PX = 1e-6
"""A pixel whose ray does not lead back to it as nearly as this has none: the lens folds over before it."""


def opencv_lens(lens: Distortion | None) -> Array:
    """[8] float64; all 0 without a lens."""
    if lens is None:
        return frozen_array(np.zeros(8))
    return frozen_array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0])


def opencv_matrix(k: Intrinsics) -> Array:
    """[3, 3] float64: the camera matrix as OpenCV has it, the first pixel's centre at 0."""
    return np.array([[k.fx, 0.0, k.cx_opencv], [0.0, k.fy, k.cy_opencv], [0.0, 0.0, 1.0]])


def usable_radius(lens: Array) -> float:
    """Distance from the axis at z = 1 up to which the lens maps larger radii to larger ones; at most `WIDEST`."""
    k1, k2, _, _, k3, k4, k5, k6 = lens
    r = np.linspace(0.0, WIDEST, 5001)
    r2 = r * r
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    with np.errstate(divide="ignore", invalid="ignore"):
        image = r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    falls = np.flatnonzero(~(np.diff(image) > 0.0) | ~(below[1:] > 0.0))
    return float(r[falls[0]]) if len(falls) else WIDEST


def project_points(points: Array, k: Intrinsics, lens: Array) -> Array:
    """[N, 2] float64: image coordinates of points [N, 3] in the camera's frame.

    nan for points behind the camera and beyond the angle that the lens is used at.
    """
    return _draw(points, (k.fx, k.fy, k.cx, k.cy), lens, usable_radius(lens))


def rays_of_pixels(pixels: Array, k: Intrinsics, lens: Array) -> Array:
    """[N, 2] float64: (x / z, y / z) of image coordinates [N, 2]; nan where the lens maps nothing to."""
    rays = (pixels - np.array([k.cx, k.cy])) / np.array([k.fx, k.fy])
    if not np.any(lens) or not len(rays):
        return rays
    undistorted = cv2.undistortPoints((pixels - 0.5).reshape(-1, 1, 2), opencv_matrix(k), lens, criteria=STOP)
    rays = undistorted.reshape(-1, 2).astype(np.float64)
    back = project_points(np.column_stack([rays, np.ones(len(rays))]), k, lens)
    with np.errstate(invalid="ignore"):
        good = np.abs(back - pixels).max(axis=1) <= FOUND_PX
    rays[~good] = np.nan
    return rays


def pixel_rays(k: Intrinsics, lens: Array) -> Array:
    """[height, width, 2] float64, read-only: (x / z, y / z) through each pixel's centre; nan where the lens has none."""
    return _pixel_rays(k, tuple(float(x) for x in lens))


@functools.lru_cache(maxsize=4)
def _pixel_rays(k: Intrinsics, lens: tuple[float, ...]) -> Array:
    """Kept, because it is the same for every view and takes longer than what is done with it."""
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    centres = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
    return frozen_array(rays_of_pixels(centres, k, np.array(lens)).reshape(k.height, k.width, 2))


def distort(u: Array, v: Array, lens: Distortion, k: Intrinsics) -> tuple[Array, Array]:
    """Image coordinates through the lens of the pinhole coordinates (u, v), also where it folds over."""
    rays = np.stack([(u.ravel() - k.cx) / k.fx, (v.ravel() - k.cy) / k.fy, np.ones(u.size)], axis=1)
    x, y = _draw(rays, (k.fx, k.fy, k.cx, k.cy), opencv_lens(lens), np.inf).T
    return x.reshape(u.shape), y.reshape(v.shape)


def undistort(u: Array, v: Array, lens: Distortion, k: Intrinsics) -> tuple[Array, Array]:
    """The inverse of `distort`: pinhole coordinates of (u, v) through the lens; nan where the lens maps nothing to."""
    x, y = rays_of_pixels(np.stack([u.ravel(), v.ravel()], axis=1), k, opencv_lens(lens)).T
    return (k.fx * x + k.cx).reshape(u.shape), (k.fy * y + k.cy).reshape(v.shape)


@compiled
def _draw(points: Array, focal: tuple[float, float, float, float], lens: Array, radius: float) -> Array:
    """[N, 2]: image coordinates by OpenCV's formula (calib3d, "Detailed Description"), nan farther off the axis than `radius`."""
    fx, fy, cx, cy = focal
    p1, p2 = lens[2], lens[3]
    pixels = np.full((len(points), 2), np.nan)
    for n in range(len(points)):
        z = points[n, 2]
        if not z > 0.0:
            continue
        x, y = points[n, 0] / z, points[n, 1] / z
        r2 = x * x + y * y
        if r2 <= radius * radius:
            above = 1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
            radial = above / (1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[7])))
            pixels[n, 0] = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx
            pixels[n, 1] = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
    return pixels


def is_inner(region: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """[H, W]: the pixels that, with all eight beside them, show something; region [H, W]. None at the image's edge does."""
    inner: NDArray = cv2.erode(region, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return inner > 0


def fill_image(picture: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """[height, width, 3]: the middle of a picture [h, w, 3], as large as fills the image."""
    scale = max(width / picture.shape[1], height / picture.shape[0])
    wide, high = max(width, round(scale * picture.shape[1])), max(height, round(scale * picture.shape[0]))
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    left, top = (wide - width) // 2, (high - height) // 2
    return np.asarray(cv2.resize(picture, (wide, high), interpolation=how), np.uint8)[top:, left:][:height, :width]
