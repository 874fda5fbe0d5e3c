"""Loops that write an image target where a thing is seen, from the faces and distances of `surfaces.nearest_faces`. Pure.

`seen` is always (face [H, W] int32, -1 for none; z [H, W] float64, metres), `k` fx, fy, cx, cy; pixel centres lie at +0.5.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.view import FULL
from workers.geometry.colour import LIMITS, SRGB_STEPS
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.mesh import weigh_edges

SeenFaces = tuple[NDArray[np.int32], Array]
Intrinsic = tuple[float, float, float, float]

CODES = np.searchsorted(LIMITS, np.arange(FULL + 1) / FULL).astype(np.uint8)
"""[65536] 8-bit sRGB of linear light in steps of 1 / 65535, of which the darkest code has 20."""


@compiled_for("i4[:,::1], u2[:,::1], u2[:,:,::1]")
def paint_faces(face: NDArray[np.int32], codes: NDArray[np.uint16], image: NDArray[np.uint16]) -> None:
    """Writes the code [F, 3] of each pixel's face into an image [H, W, 3]."""
    for row in range(face.shape[0]):
        for column in range(face.shape[1]):
            own = face[row, column]
            if own >= 0:
                for channel in range(3):
                    image[row, column, channel] = codes[own, channel]


@compiled_for("Tuple((i4[:,::1], f8[:,::1])), u1[::1], u1, f8[:,::1], UniTuple(f8, 4), f8, f8[::1], u2[:,:,::1]")
def paint_points(
    seen: SeenFaces,
    regions: NDArray[np.uint8],
    region_id: np.uint8,
    T_obj_cam: Pose,
    k: Intrinsic,
    scale: float,
    offset: Array,
    image: NDArray[np.uint16],
) -> None:
    """Writes (point - offset) / scale, in 16 bits, of what is seen of one object; regions [F] are those of the faces."""
    face, depth = seen
    for row in range(face.shape[0]):
        for column in range(face.shape[1]):
            own = face[row, column]
            if own < 0 or regions[own] != region_id:
                continue
            z = depth[row, column]
            x, y = (column + 0.5 - k[2]) / k[0] * z, (row + 0.5 - k[3]) / k[1] * z
            for axis in range(3):
                point = T_obj_cam[axis, 0] * x + T_obj_cam[axis, 1] * y + T_obj_cam[axis, 2] * z + T_obj_cam[axis, 3]
                share = min(max((point - offset[axis]) / scale, 0.0), 1.0)
                image[row, column, axis] = np.uint16(np.rint(share * FULL))


class Skin(NamedTuple):
    """What the faces of a view are coloured by.

    points [V, 3] in the camera's frame and values [V, 5], uv and linear colours, of vertices; corners [F, 3] and part [F] of
    faces; base [P, 3] linear light of parts; texels: all textures one after another, [h, w, 3] uint8 sRGB; places [P, 3]: where
    a part's texture begins, its height and its width, one texel for none.
    """

    points: Array
    values: Array
    corners: NDArray[np.int32]
    part: NDArray[np.int32]
    base: Array
    texels: NDArray[np.uint8]
    places: NDArray[np.int64]


def paint_albedo(seen: SeenFaces, skin: Skin, k: Intrinsic, image: NDArray[np.uint8]) -> None:
    """Writes the base colour, sRGB, of what is seen into an image [H, W, 3].

    Textures are bilinear among four texels in linear light, and repeat beyond their edges; uv (0, 0) is their lower left corner.
    """
    _paint_albedo(seen, skin, k, (SRGB_STEPS, CODES), image)


@compiled
def _paint_albedo(
    seen: SeenFaces,
    skin: Skin,
    k: Intrinsic,
    curves: tuple[Array, NDArray[np.uint8]],
    image: NDArray[np.uint8],
) -> None:
    face, depth = seen
    points, values, corners, part, base, texels, places = skin
    steps, codes = curves
    weights_by_ray, by_ray, last = np.zeros((3, 3)), np.zeros((5, 3)), -1
    weights, value, point = np.empty(3), np.empty(5), np.empty(3)
    begin, height, width, own, alike = 0, 1, 1, 0, True
    for row in range(face.shape[0]):
        ray_y = (row + 0.5 - k[3]) / k[1]
        for column in range(face.shape[1]):
            if face[row, column] < 0:
                continue
            if face[row, column] != last:
                last = face[row, column]
                own = part[last]
                begin, height, width = places[own, 0], places[own, 1], places[own, 2]
                alike = _follow_corners(points, corners[last], values, weights_by_ray, by_ray) and width * height == 1
            if alike:
                for channel in range(3):
                    light = base[own, channel] * values[corners[last, 0], 2 + channel]
                    image[row, column, channel] = codes[np.uint64(light * FULL + 0.5)]
                continue
            z = depth[row, column]
            x, y = (column + 0.5 - k[2]) / k[0] * z, ray_y * z
            second = weights_by_ray[1, 0] * x + weights_by_ray[1, 1] * y + weights_by_ray[1, 2] * z
            third = weights_by_ray[2, 0] * x + weights_by_ray[2, 1] * y + weights_by_ray[2, 2] * z
            if second >= 0.0 and third >= 0.0 and second + third <= 1.0:
                for n in range(5):
                    value[n] = by_ray[n, 0] * x + by_ray[n, 1] * y + by_ray[n, 2] * z
            else:  # beyond the face, or its plane goes through the camera: the nearest point of its edges
                point[0], point[1], point[2] = x, y, z
                weigh_edges(point, points, corners[last], weights)
                for n in range(5):
                    value[n] = 0.0
                    for corner in range(3):
                        value[n] += weights[corner] * values[corners[last, corner], n]
            u, v = value[0] - 0.5 / width, 1.0 - value[1] - 0.5 / height
            u, v = (u - math.floor(u)) * width, (v - math.floor(v)) * height
            x0, y0 = min(int(u), width - 1), min(int(v), height - 1)
            across, down = u - x0, v - y0
            x1, y1 = (x0 + 1 if x0 + 1 < width else 0), (y0 + 1 if y0 + 1 < height else 0)
            # Unsigned numbers are not tested for counting from the end, which would take a third of the time.
            a, b = np.uint64(begin + 3 * (y0 * width + x0)), np.uint64(begin + 3 * (y0 * width + x1))
            c, d = np.uint64(begin + 3 * (y1 * width + x0)), np.uint64(begin + 3 * (y1 * width + x1))
            w_d, w_c, w_b = across * down, (1.0 - across) * down, across * (1.0 - down)
            w_a = 1.0 - w_b - w_c - w_d
            for channel in range(3):
                more = np.uint64(channel)
                upper = w_a * steps[np.uint64(texels[a + more])] + w_b * steps[np.uint64(texels[b + more])]
                lower = w_c * steps[np.uint64(texels[c + more])] + w_d * steps[np.uint64(texels[d + more])]
                light = base[own, channel] * value[2 + channel] * (upper + lower)
                image[row, column, channel] = codes[np.uint64(min(max(light, 0.0), 1.0) * FULL + 0.5)]


@compiled
def _follow_corners(
    points: Array, corners: NDArray[np.int32], values: Array, weights_by_ray: Array, by_ray: Array
) -> bool:
    """Writes the maps from a point of a face to its corners' weights [3, 3], and to their values [5, 3], interpolated.

    Returns whether all corners have the same colour.
    """
    _weights_by_ray(points, corners, weights_by_ray)
    alike = True
    for n in range(5):
        for axis in range(3):
            by_ray[n, axis] = 0.0
            for corner in range(3):
                by_ray[n, axis] += values[corners[corner], n] * weights_by_ray[corner, axis]
        if n >= 2:
            alike &= values[corners[0], n] == values[corners[1], n] == values[corners[2], n]
    return alike


@compiled
def _weights_by_ray(points: Array, corners: NDArray[np.int32], by_ray: Array) -> None:
    """Writes into `by_ray` [3, 3] the map from a point of a face to the weights of its corners there.

    Those of corners a, b, c solve w_a a + w_b b + w_c c = p; not finite where the plane goes through the camera.
    """
    for corner in range(3):
        b, c = points[corners[(corner + 1) % 3]], points[corners[(corner + 2) % 3]]
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            by_ray[corner, axis] = b[one] * c[two] - b[two] * c[one]
    a = points[corners[0]]
    volume = a[0] * by_ray[0, 0] + a[1] * by_ray[0, 1] + a[2] * by_ray[0, 2]
    for corner in range(3):
        for axis in range(3):
            by_ray[corner, axis] /= volume


@compiled_for("i8[::1], f8[::1], u1[::1], f8[:,::1], u1[:,::1]")
def paint_layers(
    start: NDArray[np.int64], z: Array, region: NDArray[np.uint8], depth: Array, regions: NDArray[np.uint8]
) -> None:
    """Writes z and region of each pixel's surfaces (`surfaces.Surfaces`) into layers [L, H * W]; into the last, the last one."""
    layers = len(depth) - 1
    for pixel in range(len(start) - 1):
        first, count = start[pixel], start[pixel + 1] - start[pixel]
        for layer in range(min(count, layers)):
            depth[layer, pixel], regions[layer, pixel] = z[first + layer], region[first + layer]
        if count:
            depth[layers, pixel], regions[layers, pixel] = z[first + count - 1], region[first + count - 1]


@compiled_for("i8[::1], u1[::1], i8[::1], u1[:,::1]")
def paint_silhouettes(
    start: NDArray[np.int64], region: NDArray[np.uint8], place: NDArray[np.int64], masks: NDArray[np.uint8]
) -> None:
    """Writes 255 into the mask [objects, H * W] of every region that a pixel's ray meets; place [256]: of regions in masks."""
    for pixel in range(len(start) - 1):
        for n in range(start[pixel], start[pixel + 1]):
            masks[place[region[n]], pixel] = 255
