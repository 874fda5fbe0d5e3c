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
from schemas.scene.view import Camera, Intrinsics
from workers.capture.surface.posed_view import PosedView, project_pixels, sample_pixels
from workers.capture.surface.tsdf import FittedDepth
from workers.geometry.frames import invert, transform
from workers.geometry.jit import compiled
from workers.geometry.zbuffer import corner_weights, draw_triangles

Images = tuple[NDArray[np.uint8], Array, NDArray[np.bool_]]
"""(rgb [H, W, 3], depth_m [H, W] float64, mask [H, W] of the object)."""

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
    k, rgb = view.camera.intrinsics, view.rgb
    if not np.array_equal(view.camera.T_world_cam, view.depth_camera.T_world_cam):
        known, points = _lift(fitted.inverse, k)
        points = transform(view.depth_camera.T_world_cam, points)
        rgb = np.zeros_like(rgb)
        rgb[known] = sample_pixels(view.rgb, np.arange(256.0), view.camera, points)[0] + 0.5
    width = max(3, round(FEATHER_PX * k.fx / 912.0)) | 1
    inner = cv2.blur((fitted.inverse > 0.0).astype(np.float32), (width, width), borderType=cv2.BORDER_CONSTANT)
    known = np.clip(2.0 * inner - 1.0, 0.02, 1.0)
    # The inverse variance of depth, times the share of the neighbourhood that was measured.
    weight = fitted.facing**2 * fitted.inverse**4 * known
    return Source(view.number, view.depth_camera, fitted, rgb, mask, weight.astype(np.float32))


def move_depth(depth_m: NDArray[np.float32], source: Camera, target: Camera) -> NDArray[np.float32]:
    """[H, W] float32: a depth image as another camera nearby has it, as it was measured; 0 where it shows nothing."""
    inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0.0)
    fitted = FittedDepth(inverse, np.ones_like(inverse))
    blank = np.zeros((*depth_m.shape, 3), np.uint8)
    layer = warp(Source(0, source, fitted, blank, blank[..., 0] > 0, np.ones_like(inverse)), target)
    return np.where(layer.weight > 0.0, layer.depth_m, np.float32(0.0))


def warp(source: Source, camera: Camera, factor: float = 1.0) -> Layer:
    """The source as `camera` sees it; its weights times `factor`."""
    k, inverse = camera.intrinsics, source.fitted.inverse
    pixels, z = _carry(inverse, source.camera, camera)
    triangles = _join(inverse, z)
    depth, drawn = draw_triangles(pixels, z, triangles, (k.height, k.width), EDGE_SLACK, True)
    shares = corner_weights(pixels, triangles, drawn)
    weight = source.weight * np.float32(factor)
    painted = _paint(drawn, shares, triangles, pixels, weight, source.rgb, source.mask)
    return Layer(depth.astype(np.float32), *painted)


def _lift(inverse: NDArray[np.float32], k: Intrinsics) -> tuple[NDArray[np.bool_], Array]:
    """(pixels [h, w] that have depth, their points [N, 3] in camera coordinates)."""
    rows, columns = np.nonzero(inverse > 0.0)
    z = 1.0 / inverse[rows, columns].astype(np.float64)
    points = np.stack([(columns + 0.5 - k.cx) / k.fx * z, (rows + 0.5 - k.cy) / k.fy * z, z], axis=1)
    return inverse > 0.0, points


def _carry(inverse: NDArray[np.float32], source: Camera, target: Camera) -> tuple[NDArray[np.float32], ...]:
    """(u and v [h * w, 2], z [h * w]): pixels of the target with centres on integers; z is 0 where nothing is in front of it."""
    known, points = _lift(inverse, source.intrinsics)
    m, T = target.intrinsics, invert(target.T_world_cam) @ source.T_world_cam
    seen = project_pixels(points, T, (m.fx, m.fy, m.cx, m.cy))
    pixels, depth = np.zeros((inverse.size, 2), np.float32), np.zeros(inverse.size, np.float32)
    pixels[known.ravel()], depth[known.ravel()] = seen[:, :2] - 0.5, seen[:, 2]
    return pixels, depth


def _join(inverse: NDArray[np.float32], z: NDArray[np.float32]) -> NDArray[np.int32]:
    """[T, 3]: two triangles for each square of four pixels, of the three that lie on one surface, by number.

    The first begins with the lowest number and is wound as the image's axes are, the second with the highest and otherwise.
    """
    number = np.arange(inverse.size, dtype=np.int32).reshape(inverse.shape)
    upper, right, lower, last = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    pairs = [np.stack([first, right, lower], axis=-1) for first in (upper, last)]
    triangles = np.stack(pairs, axis=2).reshape(-1, 3)
    corners = inverse.ravel()[triangles]
    joined = (z[triangles] > 0.0).all(axis=1)
    joined &= corners.min(axis=1) >= np.float64(1.0 - SAME_SURFACE) * corners.max(axis=1)
    return triangles[joined]


@compiled
def _paint(
    drawn: NDArray[np.int32],
    shares: Array,
    triangles: NDArray[np.int32],
    pixels: NDArray[np.float32],
    weight: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    mask: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]:
    """(weight, rgb, mask) of a layer, between the corners of the triangle that is drawn at each pixel."""
    height, width = drawn.shape
    weights, colours = np.zeros((height, width), np.float32), np.zeros((height, width, 3), np.uint8)
    inside = np.zeros((height, width), np.bool_)
    weight_of, rgb_of, mask_of = weight.ravel(), rgb.reshape(-1, 3), mask.ravel()
    for y in range(height):
        for x in range(width):
            if drawn[y, x] < 0:
                continue
            a, b, c = triangles[drawn[y, x], 0], triangles[drawn[y, x], 1], triangles[drawn[y, x], 2]
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


def fill_holes(rgb: NDArray[np.uint8], depth_m: Array, mask: NDArray[np.bool_], size_px: int) -> Images:
    """(rgb, depth_m, mask) where small holes are filled from their rims inwards, and outer edges stay as they are.

    Small are gaps of up to about 2 * size_px across, and holes that are enclosed and have at most (4 * size_px)^2 pixels.
    """
    holes = np.argwhere(_small_holes(depth_m > 0.0, size_px))
    framed = [np.pad(image, [(1, 1), (1, 1), (0, 0)][: image.ndim]) for image in (rgb, depth_m, mask)]
    while len(holes):
        around = [[image[holes[:, 0] + i, holes[:, 1] + j] for i in range(3) for j in range(3)] for image in framed]
        colours, depths, inside = (np.array(values, np.float64) for values in around)
        farthest = depths.max(axis=0)
        rim = farthest > 0.0
        if not rim.any():
            break
        shares = (depths > farthest - STEP_M)[:, rim]
        count = shares.sum(axis=0)
        at = tuple((holes[rim] + 1).T)
        framed[0][at] = (colours[:, rim] * shares[..., None]).sum(axis=0) / count[:, None] + 0.5
        framed[1][at] = (depths[:, rim] * shares).sum(axis=0) / count
        framed[2][at] = (inside[:, rim] * shares).sum(axis=0) / count > 0.5
        holes = holes[~rim]
    colour, depth, filled = (image[1:-1, 1:-1] for image in framed)
    return np.asarray(colour, np.uint8), np.asarray(depth, np.float64), np.asarray(filled, np.bool_)


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


def synthesize_view(sources: Sequence[Source], camera: Camera) -> SynthesizedView:
    """What `camera` would see, made of sources, with small holes filled as `fill_holes` does.

    Raises CaptureError where none of them shows anything to it.
    """
    numbers, layers = [source.number for source in sources], []
    for source in sources:
        cosine = max(float(source.camera.T_world_cam[:3, 2] @ camera.T_world_cam[:3, 2]), 0.0)
        layers.append(warp(source, camera, max(cosine**SHARPNESS, 1e-6)))
    if not any(layer.weight.any() for layer in layers):
        raise CaptureError(
            "nothing_seen",
            f"none of the {len(numbers)} nearest views ({', '.join(map(str, numbers))}) shows anything to this camera",
        )
    merged = merge_layers(layers)
    rgb, depth_m, mask = fill_holes(*merged, FILL_PX)
    measured = merged[1] > 0.0
    share = float(measured.sum() / max(int((depth_m > 0.0).sum()), 1))
    return SynthesizedView(rgb, depth_m, mask, measured, share, tuple(numbers))


def merge_layers(layers: Sequence[Layer]) -> Images:
    """(rgb, depth_m, mask): at each pixel the mean of the layers' nearest surface; empty where one is seen from behind."""
    shape = layers[0].depth_m.shape
    nearest, hidden, total, depth, inside = (np.full(shape, start) for start in (np.inf, np.inf, 0.0, 0.0, 0.0))
    colour = np.zeros((*shape, 3))
    for layer in layers:
        z = np.where(layer.depth_m > 0.0, layer.depth_m, np.inf)
        nearest = np.minimum(nearest, np.where(layer.weight > 0.0, z, np.inf))
        hidden = np.minimum(hidden, np.where(layer.weight > 0.0, np.inf, z))
    shown = (nearest < np.inf) & (hidden >= nearest - AGREE_M)
    for layer in layers:
        weight = np.where(shown & (layer.depth_m > 0.0) & (layer.depth_m < nearest + AGREE_M), layer.weight, 0.0)
        total += weight
        depth += weight * layer.depth_m
        colour += weight[..., None] * layer.rgb
        inside += weight * layer.mask
    known = np.where(shown, total, 1.0)
    rgb = np.where(shown[..., None], colour / known[..., None] + 0.5, 0.0).astype(np.uint8)
    return rgb, depth / known, inside > 0.5 * total
