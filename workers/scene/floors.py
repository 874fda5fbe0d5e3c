"""Floor coverings, drawn from a seed: one square of a repeating pattern, [N, N, 3] uint8 sRGB.

A pattern repeats after `PERIOD_M`: more than a camera of the default orbit sees of the floor in one direction nearby.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array

TEXTURE_PX = 512
PERIOD_M = 3.2

Picture = NDArray[np.uint8]


def draw_covering(rng: np.random.Generator) -> tuple[Picture, float]:
    """(a picture [N, N, 3] of `PERIOD_M` of a floor, its roughness)."""
    kind = COVERINGS[int(rng.integers(len(COVERINGS)))]
    shade, roughness = kind(rng)
    return np.rint(255.0 * np.clip(shade, 0.0, 1.0)).astype(np.uint8), roughness


def _planks(rng: np.random.Generator) -> tuple[Array, float]:
    """Boards of one width in rows, each row shifted, grain along them."""
    rows = int(rng.integers(16, 29))
    y = np.arange(TEXTURE_PX) * rows / TEXTURE_PX
    row = y.astype(int)
    shift, length = rng.random(rows), int(rng.integers(2, 4))
    x = np.arange(TEXTURE_PX)[None, :] * length / TEXTURE_PX + shift[row][:, None]
    board = (x.astype(int) % length) + length * row[:, None]
    tone = rng.uniform(0.82, 1.1, rows * length)[board]
    grain = _noise(rng, 8, 128) * 0.06 + _noise(rng, 32, 256) * 0.04
    gap = np.minimum((y % 1.0)[:, None] * TEXTURE_PX / rows, (x % 1.0) * TEXTURE_PX / length) < 1.0
    wood = _pick(rng, [(0.66, 0.5, 0.34), (0.5, 0.36, 0.24), (0.74, 0.63, 0.48), (0.36, 0.27, 0.2), (0.62, 0.58, 0.52)])
    return wood * ((tone + grain) * np.where(gap, 0.6, 1.0))[..., None], float(rng.uniform(0.8, 0.9))


def _tiles(rng: np.random.Generator) -> tuple[Array, float]:
    """Square tiles with joints, each a little different; at times two colours in turn."""
    count = int(rng.choice([6, 8, 10, 12, 16]))
    at = np.arange(TEXTURE_PX) * count / TEXTURE_PX
    cell = at.astype(int)
    tone = rng.uniform(0.94, 1.04, (count, count))
    if rng.random() < 0.3:
        tone *= np.where((np.arange(count)[:, None] + np.arange(count)) % 2, rng.uniform(0.55, 0.8), 1.0)
    inside = (at % 1.0) * TEXTURE_PX / count >= 1.5
    joint = inside[:, None] & inside[None, :]
    stone = _noise(rng, 16, 16) * 0.05
    clay = _pick(rng, [(0.78, 0.76, 0.72), (0.6, 0.6, 0.6), (0.66, 0.45, 0.36), (0.82, 0.8, 0.74), (0.42, 0.46, 0.5)])
    level = np.where(joint, tone[cell][:, cell] + stone, rng.uniform(0.6, 0.85))
    return clay * level[..., None], float(rng.uniform(0.8, 0.9))


def _concrete(rng: np.random.Generator) -> tuple[Array, float]:
    """Blotches of several sizes and fine grit."""
    blotch = _noise(rng, 4, 4) * 0.03 + _noise(rng, 12, 12) * 0.03 + _noise(rng, 64, 64) * 0.03
    grey = rng.uniform(0.4, 0.7) * np.array([1.0, 1.0, 1.0]) + rng.uniform(-0.03, 0.03) * np.array([1.0, 0.0, -1.0])
    return grey * (1.0 + blotch + _noise(rng, 256, 256) * 0.04)[..., None], 0.9


def _carpet(rng: np.random.Generator) -> tuple[Array, float]:
    """Fine pile in a muted colour, a little lighter and darker where it was trodden on."""
    pile = _noise(rng, 256, 256) * 0.1 + _noise(rng, 128, 128) * 0.05 + _noise(rng, 6, 6) * 0.04
    return rng.uniform(0.25, 0.65, 3) * 0.6 * (1.0 + pile)[..., None] + 0.15, 1.0


def _plain(rng: np.random.Generator) -> tuple[Array, float]:
    """Linoleum or paint: nearly one colour."""
    value, warmth = rng.uniform(0.35, 0.75), rng.uniform(-0.08, 0.08)
    return np.array([value + warmth, value, value - warmth]) * (1.0 + _noise(rng, 8, 8) * 0.02)[..., None], 0.85


COVERINGS: tuple[Callable[[np.random.Generator], tuple[Array, float]], ...] = (
    _planks,
    _tiles,
    _concrete,
    _carpet,
    _plain,
)


def _pick(rng: np.random.Generator, colors: list[tuple[float, float, float]]) -> Array:
    """[3]: one of the colours, slightly off."""
    return np.array(colors[int(rng.integers(len(colors)))]) * rng.uniform(0.9, 1.1, 3)


def _noise(rng: np.random.Generator, across: int, down: int) -> Array:
    """[N, N] about within [-1, 1]: values on a lattice of across x down cells, smooth between, repeating."""
    lattice = rng.uniform(-1.0, 1.0, (down, across))
    return _stretch(_stretch(lattice).T).T


def _stretch(lattice: Array) -> Array:
    """Rows to TEXTURE_PX by smoothstep between neighbours, around the end to the first."""
    at = np.arange(TEXTURE_PX) * len(lattice) / TEXTURE_PX
    low = at.astype(int)
    share = (at - low)[:, None]
    share = share * share * (3.0 - 2.0 * share)
    return lattice[low] * (1.0 - share) + lattice[(low + 1) % len(lattice)] * share
