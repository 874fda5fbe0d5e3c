"""Pure: materials of one colour or one texture, drawn at random."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from schemas.scene.shape import Material
from workers.assets.builtin.palette import BLACK, WHITE, Color, jitter, pale, pick, vivid

_STEELS: tuple[Color, ...] = ((0.78, 0.79, 0.8), (0.7, 0.7, 0.71), (0.86, 0.86, 0.85))
_BRASSES: tuple[Color, ...] = ((0.83, 0.69, 0.4), (0.8, 0.56, 0.42))


def solid_color(color: Color, roughness: float, metallic: float = 0.0) -> Material:
    """A material of one colour."""
    return Material((color[0], color[1], color[2], 1.0), metallic=metallic, roughness=float(roughness))


def clear_glass(color: Color, roughness: float) -> Material:
    """Glass or clear plastic, which most renderers draw as an opaque body of this colour."""
    return replace(solid_color(color, roughness), transmission=1.0)


def textured(texture: NDArray[np.uint8], roughness: float, metallic: float = 0.0) -> Material:
    """A material with a texture [h, w, 3] uint8, which becomes read-only."""
    texture.setflags(write=False)
    return Material((1.0, 1.0, 1.0, 1.0), metallic=metallic, roughness=float(roughness), texture=texture)


def plastic(rng: np.random.Generator) -> Material:
    """Moulded plastic of any colour."""
    color = pick(rng, (WHITE, BLACK, vivid(rng), vivid(rng), pale(rng)))
    return solid_color(jitter(rng, color, 0.03), rng.uniform(0.3, 0.6))


def steel(rng: np.random.Generator) -> Material:
    """Bare steel or aluminium."""
    return solid_color(jitter(rng, pick(rng, _STEELS), 0.02), rng.uniform(0.28, 0.5), metallic=1.0)


def metal(rng: np.random.Generator) -> Material:
    """Steel, brass or copper, or painted metal."""
    kind = rng.random()
    if kind < 0.45:
        return steel(rng)
    if kind < 0.6:
        return solid_color(jitter(rng, pick(rng, _BRASSES), 0.03), rng.uniform(0.25, 0.4), metallic=1.0)
    return solid_color(jitter(rng, pick(rng, (BLACK, WHITE, (0.2, 0.21, 0.22))), 0.03), rng.uniform(0.35, 0.6))
