"""One view as another camera would see it: its depth image as a surface of small triangles, drawn with a z-buffer.

Triangles join neighbouring pixels of one surface, so that the picture has no gaps where the other camera is nearer.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.view import Camera
from workers.capture.surface.posed_view import PosedView
from workers.capture.surface.tsdf import FittedDepth
from workers.geometry.frames import invert
from workers.geometry.jit import compiled

SAME_SURFACE = 0.012
"""Neighbouring pixels whose 1/z differs by a larger share are not joined."""

FEATHER_PX = 15
"""Width over which a view's weight falls towards the edges of what it measured, at a focal length of 912 px."""


@dataclass(frozen=True, eq=False)
class Layer:
    """What a view shows to another camera.

    depth_m [H, W] float32, 0 where nothing; weight [H, W] float32, 0 where nothing, or where a surface is seen from behind and
    hides what is farther; rgb [H, W, 3] uint8; mask [H, W] bool of the object.
    """

    depth_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    mask: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Source:
    """A view ready to be drawn from elsewhere: its fitted depth, and colour, mask and weight of each depth pixel."""

    number: int
    camera: Camera
    fitted: FittedDepth
    rgb: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    weight: NDArray[np.float32]


def prepare_source(view: PosedView, fitted: FittedDepth, mask: NDArray[np.bool_]) -> Source:
    """The source of a view whose depth is fitted in the whole image; `mask` is the object's in the depth camera."""
    k = view.camera.intrinsics
    T = invert(view.camera.T_world_cam) @ view.depth_camera.T_world_cam
    rgb = view.rgb
    if not np.array_equal(T, np.eye(4)):
        rgb = np.zeros_like(view.rgb)
        _carry_colours(view.rgb, fitted.inverse, (k.fx, k.fy, k.cx, k.cy), T, rgb)
    width = max(3, round(FEATHER_PX * k.fx / 912.0)) | 1
    inner = cv2.blur((fitted.inverse > 0.0).astype(np.float32), (width, width), borderType=cv2.BORDER_CONSTANT)
    known = np.clip(2.0 * inner - 1.0, 0.02, 1.0)
    # The inverse variance of depth, times the share of the neighbourhood that was measured.
    weight = fitted.facing**2 * fitted.inverse**4 * known
    return Source(view.number, view.depth_camera, fitted, rgb, mask, weight.astype(np.float32))


def move_depth(depth_m: NDArray[np.float32], source: Camera, target: Camera) -> NDArray[np.float32]:
    """[H, W] float32: a depth image as another camera nearby has it, as it was measured; 0 where it shows nothing."""
    inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0.0)
    fitted = FittedDepth(0, 0, inverse, np.ones_like(inverse))
    blank = np.zeros((*depth_m.shape, 3), np.uint8)
    layer = warp(Source(0, source, fitted, blank, blank[..., 0] > 0, np.ones_like(inverse)), target)
    return np.where(layer.weight > 0.0, layer.depth_m, np.float32(0.0))


def warp(source: Source, camera: Camera, factor: float = 1.0) -> Layer:
    """The source as `camera` sees it; its weights times `factor`."""
    k, m = source.camera.intrinsics, camera.intrinsics
    shape = (m.height, m.width)
    layer = Layer(
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros((*shape, 3), np.uint8),
        np.zeros(shape, np.bool_),
    )
    T = invert(camera.T_world_cam) @ source.camera.T_world_cam
    u, v, z = _carry(source.fitted.inverse, (k.fx, k.fy, k.cx, k.cy), T, (m.fx, m.fy, m.cx, m.cy))
    weight = source.weight * np.float32(factor)
    _draw_grid(
        (u, v, z),
        source.fitted.inverse,
        source.rgb,
        source.mask,
        weight,
        layer.depth_m,
        layer.weight,
        layer.rgb,
        layer.mask,
    )
    return layer


@compiled
def _carry_colours(
    rgb: NDArray[np.uint8],
    inverse: NDArray[np.float32],
    k: tuple[float, float, float, float],
    T: Array,
    found: NDArray[np.uint8],
) -> None:
    """The colour that the colour camera has where each depth pixel's point projects to; T: depth to colour camera."""
    height, width = inverse.shape
    for row in range(height):
        for column in range(width):
            if not inverse[row, column] > 0.0:
                continue
            z = 1.0 / inverse[row, column]
            x, y = (column + 0.5 - k[2]) / k[0] * z, (row + 0.5 - k[3]) / k[1] * z
            Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not Z > 0.05:
                continue
            u = k[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / Z + k[2] - 0.5
            v = k[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / Z + k[3] - 0.5
            if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
                continue
            c, r = int(np.floor(u)), int(np.floor(v))
            s, t = u - c, v - r
            for i in range(3):
                upper = rgb[r, c, i] * (1.0 - s) + rgb[r, c + 1, i] * s
                lower = rgb[r + 1, c, i] * (1.0 - s) + rgb[r + 1, c + 1, i] * s
                found[row, column, i] = np.uint8(upper * (1.0 - t) + lower * t + 0.5)


@compiled
def _carry(
    inverse: NDArray[np.float32],
    k: tuple[float, float, float, float],
    T: Array,
    m: tuple[float, float, float, float],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(u, v, z) [h, w]: pixels of the target with centres on integers; z is 0 where there is nothing in front of it."""
    height, width = inverse.shape
    u, v = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    depth = np.zeros((height, width), np.float32)
    for row in range(height):
        ray_y = (row + 0.5 - k[3]) / k[1]
        for column in range(width):
            if not inverse[row, column] > 0.0:
                continue
            z = 1.0 / inverse[row, column]
            x, y = (column + 0.5 - k[2]) / k[0] * z, ray_y * z
            Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if Z > 0.05:
                u[row, column] = m[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / Z + m[2] - 0.5
                v[row, column] = m[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / Z + m[3] - 0.5
                depth[row, column] = Z
    return u, v, depth


@compiled
def _draw_grid(
    uvz: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    inverse: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    weight: NDArray[np.float32],
    depth_out: NDArray[np.float32],
    weight_out: NDArray[np.float32],
    rgb_out: NDArray[np.uint8],
    mask_out: NDArray[np.bool_],
) -> None:
    """Two triangles for each square of four pixels, wound like the image: a surface seen from its front stays so."""
    u, v, z = uvz
    height, width = depth_out.shape
    rows, columns = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for row in range(inverse.shape[0] - 1):
        for column in range(inverse.shape[1] - 1):
            for half in range(2):
                rows[0], columns[0] = (row, column) if half == 0 else (row + 1, column + 1)
                rows[1], columns[1] = row, column + 1
                rows[2], columns[2] = row + 1, column
                least, most = np.inf, 0.0
                good = True
                for i in range(3):
                    q = inverse[rows[i], columns[i]]
                    good = good and z[rows[i], columns[i]] > 0.0
                    least, most = min(least, q), max(most, q)
                if not good or least < (1.0 - SAME_SURFACE) * most:
                    continue
                ua, va = u[rows[0], columns[0]], v[rows[0], columns[0]]
                ub, vb = u[rows[1], columns[1]], v[rows[1], columns[1]]
                uc, vc = u[rows[2], columns[2]], v[rows[2], columns[2]]
                area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
                if area == 0.0:
                    continue
                front = (area > 0.0) == (half == 0)
                left, right = max(int(np.ceil(min(ua, ub, uc))), 0), min(int(np.floor(max(ua, ub, uc))), width - 1)
                top, bottom = max(int(np.ceil(min(va, vb, vc))), 0), min(int(np.floor(max(va, vb, vc))), height - 1)
                for y in range(top, bottom + 1):
                    for x in range(left, right + 1):
                        wb = ((x - ua) * (vc - va) - (uc - ua) * (y - va)) / area
                        wc = ((ub - ua) * (y - va) - (x - ua) * (vb - va)) / area
                        wa = 1.0 - wb - wc
                        if wa < -1e-6 or wb < -1e-6 or wc < -1e-6:
                            continue
                        za, zb, zc = z[rows[0], columns[0]], z[rows[1], columns[1]], z[rows[2], columns[2]]
                        at = 1.0 / (wa / za + wb / zb + wc / zc)
                        if depth_out[y, x] > 0.0 and depth_out[y, x] <= at:
                            continue
                        depth_out[y, x] = at
                        if not front:
                            weight_out[y, x] = 0.0
                            continue
                        weight_out[y, x] = (
                            wa * weight[rows[0], columns[0]]
                            + wb * weight[rows[1], columns[1]]
                            + wc * weight[rows[2], columns[2]]
                        )
                        for c in range(3):
                            rgb_out[y, x, c] = np.uint8(
                                wa * rgb[rows[0], columns[0], c]
                                + wb * rgb[rows[1], columns[1], c]
                                + wc * rgb[rows[2], columns[2], c]
                                + 0.5
                            )
                        nearest = 0 if wa >= wb and wa >= wc else (1 if wb >= wc else 2)
                        mask_out[y, x] = mask[rows[nearest], columns[nearest]]
