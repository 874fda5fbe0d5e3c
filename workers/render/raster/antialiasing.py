"""Antialiasing of colour: pure functions on images. Labels stay those of the pixel's centre.

`smooth_edges` blends each edge pixel with its neighbours along the edge (after FXAA, Lottes 2009) in one to two
milliseconds an image. `blend_samples` averages, in linear light, each edge pixel with the same pixel drawn at three more
points, which takes twice as long as the image itself.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.scene.shape import REGION_FLOOR
from workers.geometry.colour import SRGB_STEPS, encode_srgb
from workers.geometry.jit import compiled, compiled_for

CONTRAST = 24
"""An edge pixel differs from one of its neighbours by more than this, in steps of 8 bits."""

RADIUS_PX = 0.38
OFFSETS_PX = tuple(
    (RADIUS_PX * math.cos(math.radians(a)), RADIUS_PX * math.sin(math.radians(a))) for a in (15, 135, 255)
)
"""The three further sample points about the centre. No two of the four share a row or a column; their mean is the centre."""

SPAN_PX = 8.0
"""Greatest distance, along an edge, of the neighbours that an edge pixel is blended with."""

Color = tuple[np.float32, np.float32, np.float32]

LINEAR_STEPS = 16_383
_LINEAR = np.rint(SRGB_STEPS * LINEAR_STEPS).astype(np.uint16)
_SRGB = np.rint(255.0 * encode_srgb(np.arange(LINEAR_STEPS + 1) / LINEAR_STEPS)).astype(np.uint8)


def find_edges(rgb: NDArray[np.uint8], region: NDArray[np.uint8], walled: bool = False) -> NDArray[np.uint8]:
    """[H, W] uint8: 255 at edge pixels of rgb [H, W, 3], whose colour is more than `CONTRAST` from one of four neighbours.

    Two pixels of the floor (region [H, W]) make no edge: its texture is filtered already. `walled`: with walls they do.
    """
    mask = np.zeros(region.shape, np.uint8)
    _mark_edges(np.ascontiguousarray(rgb), np.ascontiguousarray(region), -1 if walled else REGION_FLOOR, CONTRAST, mask)
    return mask


@compiled_for("u1[:,:,::1], u1[:,::1], i8, i8, u1[:,::1]")
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


@compiled_for("u1[:,:,::1], u1[:,::1], f4")
def _smooth_edges(rgb: NDArray[np.uint8], mask: NDArray[np.uint8], span: np.float32) -> None:
    """Blends all edge pixels before it writes one, so that the image need not be copied."""
    width = mask.shape[1]
    edges = _flat_nonzero(mask.reshape(-1))
    blended = np.empty((len(edges), 3), np.uint8)
    for n in range(len(edges)):
        blended[n, 0], blended[n, 1], blended[n, 2] = _blend_edge(rgb, edges[n] // width, edges[n] % width, span)
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
def _blend_edge(seen: NDArray[np.uint8], y: int, x: int, span: np.float32) -> tuple[np.uint8, np.uint8, np.uint8]:
    """The colour of one edge pixel. Written with scalars, because numba keeps small arrays in memory."""
    half, quarter, one, two = np.float32(0.5), np.float32(0.25), np.float32(1.0), np.float32(2.0)
    above, below, left, right = max(y - 1, 0), min(y + 1, len(seen) - 1), max(x - 1, 0), min(x + 1, seen.shape[1] - 1)
    a, b, c = _grey_at(seen, above, left), _grey_at(seen, above, x), _grey_at(seen, above, right)
    d, e, f = _grey_at(seen, y, left), _grey_at(seen, y, x), _grey_at(seen, y, right)
    g, h, i = _grey_at(seen, below, left), _grey_at(seen, below, x), _grey_at(seen, below, right)
    # Binomial differences across the pixel: exactly 0 and 1 for the directions of level and upright edges.
    along_y = -((c + two * f + i) - (a + two * d + g))
    along_x = (g + two * h + i) - (a + two * b + c)
    least = max(min(abs(along_x), abs(along_y)), one)
    length = max(np.sqrt(along_x * along_x + along_y * along_y), one)
    step_x = min(max(along_x / least, -span), span)
    step_y = min(max(along_y / least, -span), span)
    before = _tap(seen, x - half * along_x / length, y - half * along_y / length)
    after = _tap(seen, x + half * along_x / length, y + half * along_y / length)
    far_before, far_after = (
        _tap(seen, x - half * step_x, y - half * step_y),
        _tap(seen, x + half * step_x, y + half * step_y),
    )
    near = _mix(half, before, half, after)
    far = _mix(one, _mix(quarter, far_before, quarter, far_after), half, near)
    level = _grey(far[0], far[1], far[2])
    between = min(a, b, c, d, e, f, g, h, i) <= level <= max(a, b, c, d, e, f, g, h, i)
    red, green, blue = far if between else near
    return np.uint8(np.rint(red)), np.uint8(np.rint(green)), np.uint8(np.rint(blue))


@compiled
def _mix(p: np.float32, a: Color, q: np.float32, b: Color) -> Color:
    """p a + q b."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@compiled
def _grey_at(seen: NDArray[np.uint8], y: int, x: int) -> np.float32:
    return _grey(seen[y, x, 0], seen[y, x, 1], seen[y, x, 2])


@compiled
def _grey(red: np.floating, green: np.floating, blue: np.floating) -> np.float32:
    return (
        np.float32(0.299) * np.float32(red)
        + np.float32(0.587) * np.float32(green)
        + np.float32(0.114) * np.float32(blue)
    )


@compiled
def _tap(image: NDArray[np.uint8], x: np.floating, y: np.floating) -> Color:
    """The bilinear colour at (x, y); pixels at the border are repeated."""
    height, width = image.shape[:2]
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    left, top = min(max(int(x0), 0), width - 1), min(max(int(y0), 0), height - 1)
    right, bottom = min(max(int(x0) + 1, 0), width - 1), min(max(int(y0) + 1, 0), height - 1)
    return _mix(
        np.float32(1.0) - fy,
        _between(image[top, left], image[top, right], fx),
        fy,
        _between(image[bottom, left], image[bottom, right], fx),
    )


@compiled
def _between(a: NDArray[np.uint8], b: NDArray[np.uint8], share: np.float32) -> Color:
    """The colour at a share of the way from pixel a [3] to pixel b [3]."""
    rest = np.float32(1.0) - share
    return (
        rest * np.float32(a[0]) + share * np.float32(b[0]),
        rest * np.float32(a[1]) + share * np.float32(b[1]),
        rest * np.float32(a[2]) + share * np.float32(b[2]),
    )


def blend_samples(rgb: NDArray[np.uint8], others: Sequence[NDArray[np.uint8]], mask: NDArray[np.uint8]) -> None:
    """Replace `rgb` [H, W, 3], where the mask is not 0, by its mean with the others [H, W, 4], in linear light."""
    chosen = np.flatnonzero(mask)
    pixels = rgb.reshape(-1, 3)
    total = _LINEAR[pixels[chosen]].astype(np.uint32)
    for other in others:
        total += _LINEAR[other.reshape(-1, 4)[chosen, :3]]
    count = 1 + len(others)
    pixels[chosen] = _SRGB[(total + count // 2) // count]
