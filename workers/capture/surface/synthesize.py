"""A view from any pose, made of captured ones: ranked, warped, merged, holes filled (Staszak and Belter 2024, step 4).

A depth image is drawn as a surface of small triangles with a z-buffer. Triangles join neighbouring pixels of one surface,
so that the picture has no gaps where the other camera is nearer.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from schemas.base import Array
from schemas.capture import SynthesizedView
from schemas.errors import CaptureError
from schemas.job.captures import Synthesis
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from workers.capture.surface.posed_view import PosedView, pinhole_rays, project_pixels, sample_pixels
from workers.capture.surface.tsdf import FittedDepth
from workers.geometry.camera import unproject
from workers.geometry.frames import invert, transform
from workers.geometry.jit import compiled
from workers.geometry.zbuffer import corner_weights, draw_depth, draw_triangles

Images = tuple[NDArray[np.uint8], Array]
"""(rgb [H, W, 3], depth_m [H, W] float64)."""

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
    hides what is farther; rgb [H, W, 3] uint8.
    """

    depth_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    rgb: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Source:
    """A view ready to be drawn from elsewhere: its fitted depth, and colour and weight of each depth pixel."""

    number: int
    camera: Camera
    fitted: FittedDepth
    rgb: NDArray[np.uint8]
    weight: NDArray[np.float32]


def prepare_source(view: PosedView, fitted: FittedDepth) -> Source:
    """The source of a view whose depth is fitted in the whole image."""
    k, rgb = view.camera.intrinsics, view.rgb
    if not np.array_equal(view.camera.T_world_cam, view.depth_camera.T_world_cam):
        points = transform(view.depth_camera.T_world_cam, _lift(fitted.inverse, k))
        rgb = np.zeros_like(rgb)
        rgb[fitted.inverse > 0.0] = sample_pixels(view.rgb, np.arange(256.0), view.camera, points)[0] + 0.5
    width = max(3, round(FEATHER_PX * k.fx / 912.0)) | 1
    inner = cv2.blur((fitted.inverse > 0.0).astype(np.float32), (width, width), borderType=cv2.BORDER_CONSTANT)
    known = np.clip(2.0 * inner - 1.0, 0.02, 1.0)
    # The inverse variance of depth, times the share of the neighbourhood that was measured.
    weight = fitted.facing**2 * fitted.inverse**4 * known
    return Source(view.number, view.depth_camera, fitted, rgb, weight.astype(np.float32))


def color_depth(view: PosedView) -> NDArray[np.float32]:
    """[H, W] float32: a view's depth as measured, in its colour camera; drawn anew where its depth camera stands elsewhere."""
    if np.array_equal(view.camera.T_world_cam, view.depth_camera.T_world_cam):
        return view.depth_m
    inverse = np.divide(1.0, view.depth_m, out=np.zeros_like(view.depth_m), where=view.depth_m > 0.0)
    ones = np.ones_like(inverse)
    layer = warp(Source(view.number, view.depth_camera, FittedDepth(inverse, ones), view.rgb, ones), view.camera)
    return np.where(layer.weight > 0.0, layer.depth_m, np.float32(0.0))


def warp(source: Source, camera: Camera, factor: float = 1.0) -> Layer:
    """The source as `camera` sees it; its weights times `factor`."""
    k, inverse = camera.intrinsics, source.fitted.inverse
    pixels, z = _carry(inverse, source.camera, camera)
    triangles = _join(inverse, z)
    depth, drawn = draw_triangles(pixels, z, triangles, (k.height, k.width), EDGE_SLACK, True)
    shares = corner_weights(pixels, triangles, drawn)
    weight = source.weight * np.float32(factor)
    painted = _paint(drawn, shares, triangles, pixels, weight, source.rgb)
    return Layer(depth.astype(np.float32), *painted)


def _lift(inverse: NDArray[np.float32], k: Intrinsics) -> Array:
    """[N, 3]: the points, in camera coordinates, of the pixels that have depth."""
    rows, columns = np.nonzero(inverse > 0.0)
    return unproject(rows, columns, 1.0 / inverse[rows, columns].astype(np.float64), k)


def _carry(inverse: NDArray[np.float32], source: Camera, target: Camera) -> tuple[NDArray[np.float32], ...]:
    """(u and v [h * w, 2], z [h * w]): pixels of the target with centres on integers; z is 0 where nothing is in front of it."""
    m, T = target.intrinsics, invert(target.T_world_cam) @ source.T_world_cam
    seen = project_pixels(_lift(inverse, source.intrinsics), T, (m.fx, m.fy, m.cx, m.cy))
    pixels, depth = np.zeros((inverse.size, 2), np.float32), np.zeros(inverse.size, np.float32)
    known = inverse.ravel() > 0.0
    pixels[known], depth[known] = seen[:, :2] - 0.5, seen[:, 2]
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
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(weight, rgb) of a layer, between the corners of the triangle that is drawn at each pixel."""
    height, width = drawn.shape
    weights, colours = np.zeros((height, width), np.float32), np.zeros((height, width, 3), np.uint8)
    weight_of, rgb_of = weight.ravel(), rgb.reshape(-1, 3)
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
    return weights, colours


STEP_M = 0.01
"""Depths that differ by more are of two surfaces; a pixel that both touch belongs to the farther one."""


def fill_holes(rgb: NDArray[np.uint8], depth_m: Array, size_px: int) -> Images:
    """(rgb, depth_m) where small holes are filled from their rims inwards, and outer edges stay as they are.

    Small are gaps of up to about 2 * size_px across, and holes that are enclosed and have at most (4 * size_px)^2 pixels.
    """
    holes = np.argwhere(_small_holes(depth_m > 0.0, size_px))
    framed = [np.pad(image, [(1, 1), (1, 1), (0, 0)][: image.ndim]) for image in (rgb, depth_m)]
    while len(holes):
        around = [[image[holes[:, 0] + i, holes[:, 1] + j] for i in range(3) for j in range(3)] for image in framed]
        colours, depths = (np.array(values, np.float64) for values in around)
        farthest = depths.max(axis=0)
        rim = farthest > 0.0
        if not rim.any():
            break
        shares = (depths > farthest - STEP_M)[:, rim]
        count = shares.sum(axis=0)
        at = tuple((holes[rim] + 1).T)
        framed[0][at] = (colours[:, rim] * shares[..., None]).sum(axis=0) / count[:, None] + 0.5
        framed[1][at] = (depths[:, rim] * shares).sum(axis=0) / count
        holes = holes[~rim]
    colour, depth = (image[1:-1, 1:-1] for image in framed)
    return np.asarray(colour, np.uint8), np.asarray(depth, np.float64)


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

LEAST_M = 0.01
"""What floats beside the object and is narrower is mixed pixels."""

SHARPNESS = 8
"""Power of the cosine between two optical axes that weighs a view: one 30 degrees off counts a third."""


def choose_sources(axes: Mapping[int, Array], camera: Camera, spec: Synthesis) -> list[int]:
    """Numbers of the views that a picture is made of, best first, of the z-axes [3] of all views by number.

    The best is the one with the largest cosine between its axis and the camera's; the first among equals.
    """
    numbers = sorted(axes)
    cosines = np.array([axes[number] for number in numbers]).reshape(-1, 3) @ camera.T_world_cam[:3, 2]
    return [numbers[n] for n in np.argsort(-cosines, kind="stable")[: spec.views]]


def synthesize_view(sources: Sequence[Source], camera: Camera, body: Mesh) -> SynthesizedView:
    """What `camera` would see, made of sources, with small holes filled as `fill_holes` does.

    The object's pixels are those of its surface down to the board, `body`, whether or not a source shows them, and what a
    source shows elsewhere is a mixed pixel. Raises CaptureError where none of them shows anything to the camera.
    """
    numbers, layers, body_m = [source.number for source in sources], [], draw_depth(body, camera)
    for source in sources:
        cosine = max(float(source.camera.T_world_cam[:3, 2] @ camera.T_world_cam[:3, 2]), 0.0)
        layer = warp(source, camera, max(cosine**SHARPNESS, 1e-6))
        wrong = (layer.weight > 0.0) & ~_agrees(layer.depth_m, body_m, camera)
        depth, weight = (np.where(wrong, np.float32(0.0), image) for image in (layer.depth_m, layer.weight))
        layers.append(Layer(depth, weight, layer.rgb))
    if not any(layer.weight.any() for layer in layers):
        raise CaptureError(
            "nothing_seen",
            f"none of the {len(numbers)} nearest views ({', '.join(map(str, numbers))}) shows anything to this camera",
        )
    rgb, merged_m = merge_layers(layers)
    unseen = _unseen_holes(body_m > 0.0, merged_m > 0.0)
    rgb[unseen], merged_m[unseen] = 0, 0.0
    rgb, depth_m = fill_holes(rgb, merged_m, FILL_PX)
    mask, measured = (body_m > 0.0) | unseen, (merged_m > 0.0) & ~_between(merged_m, body_m)
    share = float(measured.sum() / max(int(((depth_m > 0.0) | mask).sum()), 1))
    return SynthesizedView(rgb, depth_m, mask, measured, share, tuple(numbers))


def _agrees(depth_m: NDArray[np.float32], body_m: Array, camera: Camera) -> NDArray[np.bool_]:
    """[H, W] bool: depth that is the body's, which may be a pixel off; beside it, the board's or behind, or a wider thing's."""
    k, T, (height, width) = camera.intrinsics, camera.T_world_cam, depth_m.shape
    x, y = pinhole_rays(k, depth_m.shape)
    height_m = depth_m * (T[2, 0] * x + T[2, 1] * y + T[2, 2]) + T[2, 3]
    framed, on_body, drawn = np.pad(body_m, 1), np.zeros(depth_m.shape, np.bool_), body_m > 0.0
    for i, j in np.ndindex(3, 3):
        on_body |= np.abs(framed[i : i + height, j : j + width] - depth_m) < AGREE_M
    floats = (height_m >= AGREE_M) & ~drawn & (depth_m > 0.0)
    size = 1 + round(LEAST_M * k.fx / float(np.median(depth_m[floats]))) if floats.any() else 1
    thing = cv2.morphologyEx(floats.view(np.uint8), cv2.MORPH_OPEN, np.ones((size, size), np.uint8)) > 0
    return np.asarray(np.where(drawn, on_body, ~floats | thing))


def _between(depth_m: Array, body_m: Array) -> NDArray[np.bool_]:
    """[H, W] bool: pixels of the body whose depth is not one place's: it is not the body's, or that jumps on both sides."""
    framed = np.pad(np.where(body_m > 0.0, body_m, np.inf), 1, constant_values=np.inf)
    middle, apart = framed[1:-1, 1:-1], np.abs(depth_m - body_m) > STEP_M
    with np.errstate(invalid="ignore"):  # beside the body
        for before, after in ((framed[:-2, 1:-1], framed[2:, 1:-1]), (framed[1:-1, :-2], framed[1:-1, 2:])):
            apart |= np.minimum(np.abs(before - middle), np.abs(after - middle)) > STEP_M
    return apart & (body_m > 0.0)


def _unseen_holes(body: NDArray[np.bool_], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[H, W] bool: holes in the body through which less than half is known: they are the object's, as what no view saw."""
    label, count = ndimage.label(~body)
    few = np.append(False, ndimage.mean(known, label, np.arange(1, count + 1)) < 0.5)
    few[[0, *label[[0, -1]].ravel(), *label[:, [0, -1]].ravel()]] = False
    return np.asarray(few[label])


def merge_layers(layers: Sequence[Layer]) -> Images:
    """(rgb, depth_m): at each pixel the mean of the layers' nearest surface; empty where one is seen from behind."""
    shape = layers[0].depth_m.shape
    nearest, hidden, total, depth = (np.full(shape, start) for start in (np.inf, np.inf, 0.0, 0.0))
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
    known = np.where(shown, total, 1.0)
    rgb = np.where(shown[..., None], colour / known[..., None] + 0.5, 0.0).astype(np.uint8)
    return rgb, depth / known
