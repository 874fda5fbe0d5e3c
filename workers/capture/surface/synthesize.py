"""A view from any pose, made of captured ones: ranked, warped, merged, holes filled.

- Small holes of a synthesised view, filled from their rim.
- Views from poses that were not captured: the nearest views, merged and drawn from there (Staszak and Belter 2024,
  step 4).
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.capture import SynthesizedView
from schemas.errors import CaptureError
from schemas.job.captures import Synthesis
from schemas.scene.view import Camera
from workers.capture.surface.warp import Layer, Source, warp
from workers.geometry.jit import compiled

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


def rank_views(axes: Array, camera: Camera) -> NDArray[np.int64]:
    """[V] indices, best first: by the cosine between each view's z-axis [V, 3] and the camera's; the first among equals."""
    return np.argsort(-(axes @ camera.T_world_cam[:3, 2]), kind="stable")


def choose_sources(axes: Mapping[int, Array], camera: Camera, spec: Synthesis) -> list[int]:
    """Numbers of the views that a picture is made of, best first, of the z-axes [3] of all views by number."""
    numbers = sorted(axes)
    order = rank_views(np.array([axes[number] for number in numbers]).reshape(-1, 3), camera)
    return [numbers[n] for n in order[: spec.views]]


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
            f"none of the {len(numbers)} nearest views ({_words(numbers)}) shows anything to this camera",
        )
    rgb, depth_m, mask = merge_layers(layers, camera)
    filled = fill_holes(rgb, depth_m, mask, spec.fill_px)
    measured = depth_m > 0.0
    return SynthesizedView(
        rgb=filled[0],
        depth_m=filled[1],
        mask=filled[2],
        measured=measured,
        measured_share=float(measured.sum() / max(int((filled[1] > 0.0).sum()), 1)),
        sources=tuple(numbers),
    )


def _words(numbers: Sequence[int]) -> str:
    return ", ".join(str(number) for number in numbers)


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
