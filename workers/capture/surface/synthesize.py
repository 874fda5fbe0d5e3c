"""A view from any pose, made of captured ones: ranked, warped, merged, holes filled (Staszak and Belter 2024, step 4).

A depth image is drawn as a surface of small triangles with a z-buffer. Triangles join neighbouring pixels of one surface,
so that the picture has no gaps where the other camera is nearer.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.capture import SynthesizedView
from schemas.errors import CaptureError
from schemas.job.captures import Synthesis
from schemas.scene.view import Camera
from workers.capture.surface.posed_view import PosedView
from workers.capture.surface.tsdf import FittedDepth
from workers.geometry.frames import invert
from workers.geometry.jit import compiled
from workers.geometry.zbuffer import draw_triangles

SAME_SURFACE = 0.012
"""Neighbouring pixels whose 1/z differs by a larger share are not joined."""

EDGE_SLACK = 1e-6
"""Share of a triangle's area by which a pixel's centre may lie beyond its edge: coordinates are float32."""

FILL_PX = 3
"""Holes up to about this size are filled, and counted as not measured."""

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
    T, inverse = invert(camera.T_world_cam) @ source.camera.T_world_cam, source.fitted.inverse
    pixels, z = _carry(inverse, (k.fx, k.fy, k.cx, k.cy), T, (m.fx, m.fy, m.cx, m.cy))
    triangles = _join(inverse, z)
    depth, found, shares = draw_triangles(pixels, z, triangles, (m.height, m.width), EDGE_SLACK, True)
    return Layer(
        depth.astype(np.float32),
        *_paint(found, shares, triangles, pixels, source.weight * np.float32(factor), source.rgb, source.mask),
    )


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
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(u and v [h * w, 2], z [h * w]): pixels of the target with centres on integers; z is 0 where nothing is in front of it."""
    height, width = inverse.shape
    pixels, depth = np.zeros((inverse.size, 2), np.float32), np.zeros(inverse.size, np.float32)
    for row in range(height):
        ray_y = (row + 0.5 - k[3]) / k[1]
        for column in range(width):
            if not inverse[row, column] > 0.0:
                continue
            z = 1.0 / inverse[row, column]
            x, y = (column + 0.5 - k[2]) / k[0] * z, ray_y * z
            Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if Z > 0.05:
                n = row * width + column
                pixels[n, 0] = m[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / Z + m[2] - 0.5
                pixels[n, 1] = m[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / Z + m[3] - 0.5
                depth[n] = Z
    return pixels, depth


@compiled
def _join(inverse: NDArray[np.float32], z: NDArray[np.float32]) -> NDArray[np.int32]:
    """[T, 3]: two triangles for each square of four pixels, of the three that lie on one surface, by number.

    The first begins with the lowest number and is wound as the image's axes are, the second with the highest and otherwise.
    """
    height, width = inverse.shape
    triangles, count = np.empty((2 * inverse.size, 3), np.int32), 0
    of_all = inverse.ravel()
    for row in range(height - 1):
        for column in range(width - 1):
            n = row * width + column
            for first in (n, n + width + 1):
                least, most, good = np.inf, 0.0, True
                for pixel in (first, n + 1, n + width):
                    good = good and z[pixel] > 0.0
                    least, most = min(least, of_all[pixel]), max(most, of_all[pixel])
                if good and not least < (1.0 - SAME_SURFACE) * most:
                    triangles[count, 0], triangles[count, 1], triangles[count, 2] = first, n + 1, n + width
                    count += 1
    return triangles[:count]


@compiled
def _paint(
    found: NDArray[np.int32],
    shares: Array,
    triangles: NDArray[np.int32],
    pixels: NDArray[np.float32],
    weight: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    mask: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]:
    """(weight, rgb, mask) of a layer, between the corners of the triangle that is drawn at each pixel."""
    height, width = found.shape
    weights, colours = np.zeros((height, width), np.float32), np.zeros((height, width, 3), np.uint8)
    inside = np.zeros((height, width), np.bool_)
    weight_of, rgb_of, mask_of = weight.ravel(), rgb.reshape(-1, 3), mask.ravel()
    for y in range(height):
        for x in range(width):
            if found[y, x] < 0:
                continue
            a, b, c = triangles[found[y, x], 0], triangles[found[y, x], 1], triangles[found[y, x], 2]
            wa, wb, wc = shares[y, x, 0], shares[y, x, 1], shares[y, x, 2]
            across, down = pixels[b] - pixels[a], pixels[c] - pixels[a]
            if (across[0] * down[1] - down[0] * across[1] > 0.0) != (a < b):
                continue  # seen from behind
            weights[y, x] = wa * weight_of[a] + wb * weight_of[b] + wc * weight_of[c]
            for i in range(3):
                colours[y, x, i] = np.uint8(wa * rgb_of[a, i] + wb * rgb_of[b, i] + wc * rgb_of[c, i] + 0.5)
            inside[y, x] = mask_of[a if wa >= wb and wa >= wc else (b if wb >= wc else c)]
    return weights, colours, inside


STEP_M = 0.01
"""Depths that differ by more are of two surfaces; a pixel that both touch belongs to the farther one."""


def fill_holes(
    rgb: NDArray[np.uint8], depth_m: Array, mask: NDArray[np.bool_], size_px: int
) -> tuple[NDArray[np.uint8], Array, NDArray[np.bool_]]:
    """(rgb, depth_m, mask) where small holes are filled from their rims inwards, and outer edges stay as they are.

    Small are gaps of up to about 2 * size_px across, and holes that are enclosed and have at most (4 * size_px)^2 pixels.
    """
    if size_px == 0:
        return rgb, depth_m, mask
    holes = np.argwhere(_small_holes(depth_m > 0.0, size_px))
    rgb, depth_m, mask = rgb.copy(), depth_m.copy(), mask.copy()
    while len(holes):
        left = _fill_rim(rgb, depth_m, mask, holes)
        if left.all():
            break
        holes = holes[left]
    return rgb, depth_m, mask


def _small_holes(known: NDArray[np.bool_], size_px: int) -> NDArray[np.bool_]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size_px + 1, 2 * size_px + 1))
    # Beyond the image's edge nothing is known: without the border, closing would fill along it.
    border = 2 * size_px
    framed = np.pad(known.view(np.uint8), border)
    gaps = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, disc) > framed
    _, label, stats, _ = cv2.connectedComponentsWithStats(1 - framed, connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= (4 * size_px) ** 2
    small[0] = False
    return np.asarray((gaps | small[label])[border:-border, border:-border])


@compiled
def _fill_rim(
    rgb: NDArray[np.uint8], depth_m: Array, mask: NDArray[np.bool_], holes: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Fills the holes that have a known neighbour, all from what was known before; returns those that have none."""
    height, width = depth_m.shape
    left = np.ones(len(holes), np.bool_)
    found = np.zeros((len(holes), 5))
    for n in range(len(holes)):
        row, column = holes[n]
        farthest = 0.0
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                farthest = max(farthest, depth_m[y, x])
        if farthest == 0.0:
            continue
        count = 0
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                if depth_m[y, x] > farthest - STEP_M:
                    count += 1
                    found[n, 0] += depth_m[y, x]
                    found[n, 1] += mask[y, x]
                    for c in range(3):
                        found[n, 2 + c] += rgb[y, x, c]
        for i in range(5):
            found[n, i] /= count
        left[n] = False
    for n in range(len(holes)):
        if not left[n]:
            row, column = holes[n]
            depth_m[row, column] = found[n, 0]
            mask[row, column] = found[n, 1] > 0.5
            for c in range(3):
                rgb[row, column, c] = np.uint8(found[n, 2 + c] + 0.5)
    return left


AGREE_M = 0.006
"""Surfaces nearer to one another than this along a pixel's ray are one, whose depth is the views' mean."""

SHARPNESS = 8
"""Power of the cosine between two optical axes that weighs a view: one 30 degrees off counts a third."""


def choose_sources(axes: Mapping[int, Array], camera: Camera, spec: Synthesis) -> list[int]:
    """Numbers of the views that a picture is made of, best first, of the z-axes [3] of all views by number.

    The best is the one with the largest cosine between its axis and the camera's; the first among equals.
    """
    numbers = sorted(axes)
    cosines = np.array([axes[number] for number in numbers]).reshape(-1, 3) @ camera.T_world_cam[:3, 2]
    return [numbers[n] for n in np.argsort(-cosines, kind="stable")[: spec.views]]


def synthesize_view(sources: Sequence[Source], camera: Camera, spec: Synthesis) -> SynthesizedView:
    """What `camera` would see, from the best `spec.views` of the sources.

    Raises CaptureError where none of them shows anything to it.
    """
    by_number = {source.number: source for source in sources}
    numbers = choose_sources({n: source.camera.T_world_cam[:3, 2] for n, source in by_number.items()}, camera, spec)
    layers = []
    for number in numbers:
        source = by_number[number]
        cosine = max(float(source.camera.T_world_cam[:3, 2] @ camera.T_world_cam[:3, 2]), 0.0)
        layers.append(warp(source, camera, max(cosine**SHARPNESS, 1e-6)))
    if not any(layer.weight.any() for layer in layers):
        raise CaptureError(
            "nothing_seen",
            f"none of the {len(numbers)} nearest views ({', '.join(map(str, numbers))}) shows anything to this camera",
        )
    rgb, depth_m, mask = merge_layers(layers, camera)
    filled = fill_holes(rgb, depth_m, mask, FILL_PX)
    measured = depth_m > 0.0
    return SynthesizedView(
        rgb=filled[0],
        depth_m=filled[1],
        mask=filled[2],
        measured=measured,
        measured_share=float(measured.sum() / max(int((filled[1] > 0.0).sum()), 1)),
        sources=tuple(numbers),
    )


def merge_layers(layers: Sequence[Layer], camera: Camera) -> tuple[NDArray[np.uint8], Array, NDArray[np.bool_]]:
    """(rgb, depth_m, mask): at each pixel the mean of the layers' nearest surface; empty where one is seen from behind."""
    shape = (camera.intrinsics.height, camera.intrinsics.width)
    rgb, depth, mask = np.zeros((*shape, 3), np.uint8), np.zeros(shape), np.zeros(shape, np.bool_)
    _merge(
        np.stack([layer.depth_m for layer in layers]),
        np.stack([layer.weight for layer in layers]),
        np.stack([layer.rgb for layer in layers]),
        np.stack([layer.mask for layer in layers]),
        rgb,
        depth,
        mask,
    )
    return rgb, depth, mask


@compiled
def _merge(
    depths: NDArray[np.float32],
    weights: NDArray[np.float32],
    rgbs: NDArray[np.uint8],
    masks: NDArray[np.bool_],
    rgb: NDArray[np.uint8],
    depth: Array,
    mask: NDArray[np.bool_],
) -> None:
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            nearest = hidden = np.inf
            for n in range(len(depths)):
                z = depths[n, row, column]
                if z > 0.0 and weights[n, row, column] > 0.0:
                    nearest = min(nearest, z)
                elif z > 0.0:
                    hidden = min(hidden, z)
            if not nearest < np.inf or hidden < nearest - AGREE_M:
                continue
            total = z_total = r = g = b = inside = 0.0
            for n in range(len(depths)):
                z, w = depths[n, row, column], weights[n, row, column]
                if z > 0.0 and w > 0.0 and z < nearest + AGREE_M:
                    total += w
                    z_total += w * z
                    r += w * rgbs[n, row, column, 0]
                    g += w * rgbs[n, row, column, 1]
                    b += w * rgbs[n, row, column, 2]
                    if masks[n, row, column]:
                        inside += w
            depth[row, column] = z_total / total
            rgb[row, column, 0] = np.uint8(r / total + 0.5)
            rgb[row, column, 1] = np.uint8(g / total + 0.5)
            rgb[row, column, 2] = np.uint8(b / total + 0.5)
            mask[row, column] = inside > 0.5 * total
