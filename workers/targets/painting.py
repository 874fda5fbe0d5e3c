"""Loops that write an image target where a thing is seen, from the faces and distances of `surfaces.nearest_faces`. Pure.

`seen` is always (face [H, W] int32, -1 for none; z [H, W] float64, metres), `k` fx, fy, cx, cy; pixel centres lie at +0.5.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.view import FULL
from workers.geometry.colour import LIMITS
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
            number = face[row, column]
            if number >= 0:
                for channel in range(3):
                    image[row, column, channel] = codes[number, channel]


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
            number = face[row, column]
            if number < 0 or regions[number] != region_id:
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
    faces; base [P, 3] linear light of parts; texels [T, 3] uint16: linear light of all textures one after another, in steps of
    1 / FULL, each with its first row and column once more at its end; places [P, 3]: where a part's texture begins, its height
    and its width, one texel for none.
    """

    points: Array
    values: Array
    corners: NDArray[np.int32]
    part: NDArray[np.int32]
    base: Array
    texels: NDArray[np.uint16]
    places: NDArray[np.int64]


@compiled
def paint_albedo(seen: SeenFaces, skin: Skin, k: Intrinsic, codes: NDArray[np.uint8], image: NDArray[np.uint8]) -> None:
    """Writes the base colour of what is seen into an image [H, W, 3]; codes [65536]: sRGB of linear light (`CODES`).

    Textures are bilinear among four texels in linear light, and repeat beyond their edges; uv (0, 0) is their lower left corner.
    In runs of pixels of one face, whose loops the compiler can make vectors of.
    """
    face, depth = seen
    height, width = face.shape
    weights_by_ray, by_ray = np.zeros((3, 3)), np.zeros((5, 3))
    values, tint = np.empty((5, width)), np.empty((3, width), np.float32)
    texel, share = np.empty((2, width), np.int32), np.empty((2, width), np.float32)
    for row in range(height):
        end = 0
        while end < width:
            first, number = end, face[row, end]
            while end < width and face[row, end] == number:
                end += 1
            if number < 0:
                continue
            count, part, colours = end - first, skin.part[number], image[row, first:end]
            texture, base = skin.places[part], skin.base[part]
            alike = _follow_corners(skin.points, skin.corners[number], skin.values, weights_by_ray, by_ray)
            if alike and texture[1] * texture[2] == 1:
                for channel in range(3):
                    light = base[channel] * skin.values[skin.corners[number, 0], 2 + channel]
                    colours[:, channel] = codes[np.uint64(light * FULL + 0.5)]
                continue
            ray = (first + 0.5 - k[2]) / k[0], (row + 0.5 - k[3]) / k[1], 1.0 / k[0]
            z = depth[row, first:end]
            _interpolate(by_ray, ray, z, values)
            _keep_inside(skin, number, weights_by_ray, ray, z, values)
            for channel in range(3):
                for j in range(count):
                    tint[channel, j] = base[channel] * values[2 + channel, j]
            _find_texels(values, count, texture, texel, share)
            _blend(tint, texel, share, texture, skin.texels, codes, colours)


@compiled
def _interpolate(by_ray: Array, ray: tuple[float, float, float], z: Array, values: Array) -> None:
    """Writes the values [5, N] of a face along a row; ray: x and y of the first, at z = 1, and how x grows."""
    for n in range(5):
        begin = by_ray[n, 0] * ray[0] + by_ray[n, 1] * ray[1] + by_ray[n, 2]
        more = by_ray[n, 0] * ray[2]
        for j in range(len(z)):
            values[n, j] = z[j] * (begin + more * np.float64(j))


@compiled
def _keep_inside(
    skin: Skin, number: int, weights_by_ray: Array, ray: tuple[float, float, float], z: Array, values: Array
) -> None:
    """Overwrites values [5, N] of what is beyond the face, or whose plane goes through the camera: the nearest of its edges."""
    two, three, inside = weights_by_ray[1], weights_by_ray[2], True
    begin = two[0] * ray[0] + two[1] * ray[1] + two[2], three[0] * ray[0] + three[1] * ray[1] + three[2]
    more = two[0] * ray[2], three[0] * ray[2]
    for j in range(len(z)):
        second, third = z[j] * (begin[0] + more[0] * np.float64(j)), z[j] * (begin[1] + more[1] * np.float64(j))
        inside &= (second >= 0.0) & (third >= 0.0) & (second + third <= 1.0)
    if inside:
        return
    point, weights, corners = np.empty(3), np.empty(3), skin.corners[number]
    for j in range(len(z)):
        second, third = z[j] * (begin[0] + more[0] * np.float64(j)), z[j] * (begin[1] + more[1] * np.float64(j))
        if not (second >= 0.0 and third >= 0.0 and second + third <= 1.0):
            point[0], point[1], point[2] = (ray[0] + j * ray[2]) * z[j], ray[1] * z[j], z[j]
            weigh_edges(point, skin.points, corners, weights)
            for n in range(5):
                values[n, j] = 0.0
                for corner in range(3):
                    values[n, j] += weights[corner] * skin.values[corners[corner], n]


@compiled
def _find_texels(
    values: Array, count: int, texture: NDArray[np.int64], texel: NDArray[np.int32], share: NDArray[np.float32]
) -> None:
    """Writes column and row [2, N] of the upper left of four texels, and how far from their centre to the next each point is."""
    height, width = np.float64(texture[1]), np.float64(texture[2])
    for j in range(count):
        u, v = values[0, j] - 0.5 / width, 1.0 - values[1, j] - 0.5 / height
        u, v = (u - np.floor(u)) * width, (v - np.floor(v)) * height
        left, upper = min(np.floor(u), width - 1.0), min(np.floor(v), height - 1.0)
        texel[0, j], texel[1, j] = np.int32(left), np.int32(upper)
        share[0, j], share[1, j] = u - left, v - upper


@compiled
def _blend(
    tint: NDArray[np.float32],
    texel: NDArray[np.int32],
    share: NDArray[np.float32],
    texture: NDArray[np.int64],
    texels: NDArray[np.uint16],
    codes: NDArray[np.uint8],
    colours: NDArray[np.uint8],
) -> None:
    """Writes the colours [N, 3] of a row's points: texels, bilinear, times tint."""
    wide, half, most = texture[2] + 1, np.float32(0.5), np.float32(FULL)
    for j in range(len(colours)):
        # Unsigned numbers are not tested for counting from the end, which would take a third of the time.
        a = np.uint64(texture[0] + texel[1, j] * wide + texel[0, j])
        b, c, d = a + np.uint64(1), a + np.uint64(wide), a + np.uint64(wide + 1)
        across, down = share[0, j], share[1, j]
        w_d = across * down
        w_c, w_b = down - w_d, across - w_d
        w_a = np.float32(1.0) - across - w_c
        r = w_a * texels[a, 0] + w_b * texels[b, 0] + w_c * texels[c, 0] + w_d * texels[d, 0]
        g = w_a * texels[a, 1] + w_b * texels[b, 1] + w_c * texels[c, 1] + w_d * texels[d, 1]
        b_ = w_a * texels[a, 2] + w_b * texels[b, 2] + w_c * texels[c, 2] + w_d * texels[d, 2]
        colours[j, 0] = codes[np.uint64(np.int32(min(r * tint[0, j], most) + half))]
        colours[j, 1] = codes[np.uint64(np.int32(min(g * tint[1, j], most) + half))]
        colours[j, 2] = codes[np.uint64(np.int32(min(b_ * tint[2, j], most) + half))]


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
            second, third = (axis + 1) % 3, (axis + 2) % 3
            by_ray[corner, axis] = b[second] * c[third] - b[third] * c[second]
    a = points[corners[0]]
    volume = a[0] * by_ray[0, 0] + a[1] * by_ray[0, 1] + a[2] * by_ray[0, 2]
    for corner in range(3):
        for axis in range(3):
            by_ray[corner, axis] /= volume


@compiled_for("i8[::1], u2[::1], u1[::1], u2[:,::1], u1[:,::1]")
def paint_layers(
    start: NDArray[np.int64],
    z: NDArray[np.uint16],
    region: NDArray[np.uint8],
    depth: NDArray[np.uint16],
    regions: NDArray[np.uint8],
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
