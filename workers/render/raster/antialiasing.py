"""Antialiasing of colour: pure functions on images. Labels stay those of the pixel's centre.

`smooth_edges` blends each edge pixel with its neighbours along the edge (after FXAA, Lottes 2009) in one to two
milliseconds an image. `blend_samples` averages, in linear light, each edge pixel with the same pixel drawn at three more
points, which takes twice as long as the image itself.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.scene.region import REGION_FLOOR
from workers.geometry.jit import compiled
from workers.geometry.srgb import SRGB_STEPS, encode_srgb

CONTRAST = 24
"""An edge pixel differs from one of its neighbours by more than this, in steps of 8 bits."""

RADIUS_PX = 0.38
OFFSETS_PX = tuple(
    (RADIUS_PX * math.cos(math.radians(a)), RADIUS_PX * math.sin(math.radians(a))) for a in (15, 135, 255)
)
"""The three further sample points about the centre. No two of the four share a row or a column; their mean is the centre."""

SPAN_PX = 8.0
"""Greatest distance, along an edge, of the neighbours that an edge pixel is blended with."""

Floats = NDArray[np.float32]

LINEAR_STEPS = 16_383
_LINEAR = np.rint(SRGB_STEPS * LINEAR_STEPS).astype(np.uint16)
_SRGB = np.rint(255.0 * encode_srgb(np.arange(LINEAR_STEPS + 1) / LINEAR_STEPS)).astype(np.uint8)


def find_edges(rgb: NDArray[np.uint8], region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] uint8: 255 at edge pixels of rgb [H, W, 3], whose colour is more than `CONTRAST` from one of four neighbours.

    Two pixels of the floor (region [H, W]) make no edge: the floor's texture is filtered already.
    """
    mask = np.zeros(region.shape, np.uint8)
    _mark_edges(np.ascontiguousarray(rgb), np.ascontiguousarray(region), REGION_FLOOR, CONTRAST, mask)
    return mask


@compiled
def _mark_edges(
    rgb: NDArray[np.uint8], region: NDArray[np.uint8], floor: int, contrast: int, mask: NDArray[np.uint8]
) -> None:
    """Compares each pair of neighbours once, and marks both: first all pairs of a row, by a loop that is vectorised."""
    height, width = region.shape
    flat, most = rgb.reshape(-1), np.uint8(contrast)
    differs = np.zeros(24 * (width // 8 + 1), np.uint8)
    words = differs.view(np.uint64)  # three hold eight pixels
    for y in range(height):
        for dy, dx in ((0, 1), (1, 0)):
            if y + dy >= height:
                continue
            row, other = flat[3 * width * y :], flat[3 * (width * (y + dy) + dx) :]
            for n in range(3 * (width - dx)):
                a, b = row[n], other[n]
                high, low = a if a > b else b, b if a > b else a
                differs[n] = np.uint8(high - low) > most
            for eight in range(0, width - dx, 8):
                word = 3 * (eight // 8)
                if not words[word] | words[word + 1] | words[word + 2]:
                    continue
                for x in range(eight, min(eight + 8, width - dx)):
                    edge = differs[3 * x] | differs[3 * x + 1] | differs[3 * x + 2]
                    if edge and (region[y, x] != floor or region[y + dy, x + dx] != floor):
                        mask[y, x] = mask[y + dy, x + dx] = 255


def smooth_edges(rgb: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
    """Blend `rgb` [H, W, 3] along its edges, in place, where the mask [H, W] is not 0.

    The edge is perpendicular to the gradient of brightness over the 3 x 3 neighbours. Two taps lie on it half a pixel away,
    two farther the flatter the edge is, at most `SPAN_PX` away. The farther taps count only where their blend stays
    between the darkest and the brightest neighbour.
    """
    _smooth_edges(rgb, mask, np.float32(SPAN_PX))


@compiled
def _smooth_edges(rgb: NDArray[np.uint8], mask: NDArray[np.uint8], span: np.float32) -> None:
    """Blends all edge pixels before it writes one, so that the image need not be copied."""
    width = mask.shape[1]
    edges = _flat_nonzero(mask.reshape(-1))
    blended = np.empty((len(edges), 3), np.uint8)
    around = np.empty((3, 3), np.float32)
    near, far = np.empty(3, np.float32), np.empty(3, np.float32)
    for n in range(len(edges)):
        _blend_edge(rgb, edges[n] // width, edges[n] % width, span, around, near, far, blended[n])
    pixels = rgb.reshape(-1, 3)
    for n in range(len(edges)):
        for channel in range(3):
            pixels[edges[n], channel] = blended[n, channel]


@compiled
def _flat_nonzero(values: NDArray[np.uint8]) -> NDArray[np.int64]:
    """[N]: the indices of values [M] that are not 0; eight zeros are passed over at once."""
    words = values[: len(values) // 8 * 8].view(np.uint64)
    found, count = np.empty(len(values), np.int64), 0
    for word in range(len(words) + 1):
        if word < len(words) and words[word] == 0:
            continue
        for index in range(8 * word, min(8 * word + 8, len(values))):
            if values[index]:
                found[count] = index
                count += 1
    return found[:count]


@compiled
def _blend_edge(
    seen: NDArray[np.uint8],
    y: int,
    x: int,
    span: np.float32,
    around: Floats,
    near: Floats,
    far: Floats,
    out: NDArray[np.uint8],
) -> None:
    """The colour of one edge pixel into `out` [3]; around [3, 3], near [3] and far [3], float32, are overwritten."""
    height, width = seen.shape[:2]
    half, quarter, one, two = np.float32(0.5), np.float32(0.25), np.float32(1.0), np.float32(2.0)
    low, high = np.float32(255.0), np.float32(0.0)
    for dy in range(3):
        for dx in range(3):
            row, column = min(max(y + dy - 1, 0), height - 1), min(max(x + dx - 1, 0), width - 1)
            grey = _grey(seen[row, column, 0], seen[row, column, 1], seen[row, column, 2])
            around[dy, dx] = grey
            low, high = min(low, grey), max(high, grey)
    # Binomial differences across the pixel: exactly 0 and 1 for the directions of level and upright edges.
    across = (around[0, 2] + two * around[1, 2] + around[2, 2]) - (around[0, 0] + two * around[1, 0] + around[2, 0])
    down = (around[2, 0] + two * around[2, 1] + around[2, 2]) - (around[0, 0] + two * around[0, 1] + around[0, 2])
    along_x, along_y = down, -across
    least = max(min(abs(along_x), abs(along_y)), one)
    length = max(np.sqrt(along_x * along_x + along_y * along_y), one)
    step_x = min(max(along_x / least, -span), span)
    step_y = min(max(along_y / least, -span), span)
    near[:], far[:] = np.float32(0.0), np.float32(0.0)
    for sign in (-half, half):
        _add_tap(seen, x + sign * along_x / length, y + sign * along_y / length, half, near)
        _add_tap(seen, x + sign * step_x, y + sign * step_y, quarter, far)
    for channel in range(3):
        far[channel] += half * near[channel]
    level = _grey(far[0], far[1], far[2])
    for channel in range(3):
        value = far[channel] if low <= level <= high else near[channel]
        out[channel] = np.uint8(np.rint(value))


@compiled
def _grey(red: float, green: float, blue: float) -> np.float32:
    return (
        np.float32(0.299) * np.float32(red)
        + np.float32(0.587) * np.float32(green)
        + np.float32(0.114) * np.float32(blue)
    )


@compiled
def _add_tap(image: NDArray[np.uint8], x: float, y: float, weight: np.float32, total: NDArray[np.float32]) -> None:
    """Add the bilinear colour at (x, y); pixels at the border are repeated."""
    height, width = image.shape[:2]
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    left, top = min(max(int(x0), 0), width - 1), min(max(int(y0), 0), height - 1)
    right, bottom = min(max(int(x0) + 1, 0), width - 1), min(max(int(y0) + 1, 0), height - 1)
    one = np.float32(1.0)
    for channel in range(3):
        above = (one - fx) * np.float32(image[top, left, channel]) + fx * np.float32(image[top, right, channel])
        below = (one - fx) * np.float32(image[bottom, left, channel]) + fx * np.float32(image[bottom, right, channel])
        total[channel] += weight * ((one - fy) * above + fy * below)


def blend_samples(rgb: NDArray[np.uint8], others: Sequence[NDArray[np.uint8]], mask: NDArray[np.uint8]) -> None:
    """Replace `rgb` [H, W, 3], where the mask is not 0, by its mean with the others [H, W, 4], in linear light."""
    chosen = np.flatnonzero(mask)
    pixels = rgb.reshape(-1, 3)
    total = _LINEAR[pixels[chosen]].astype(np.uint32)
    for other in others:
        total += _LINEAR[other.reshape(-1, 4)[chosen, :3]]
    count = 1 + len(others)
    pixels[chosen] = _SRGB[(total + count // 2) // count]
