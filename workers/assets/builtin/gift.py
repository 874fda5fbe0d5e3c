"""Pure: boxes with a separate lid, some with a ribbon; and the sizes and faces that all boxes share."""

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Material
from workers.assets.builtin.draws import chance, pick
from workers.assets.builtin.materials import solid_color, textured
from workers.assets.builtin.palette import BLACK, WHITE, Color, ink_on, jitter, mix, pale, vivid
from workers.assets.builtin.parts import Model, Surface, over_top
from workers.assets.builtin.solid import Solid, circle, combine, lathe, union
from workers.assets.builtin.sweeps import prism, straight_prism
from workers.assets.builtin.textures import dots, label, upright_stripes

SIDE, LID, TOP, BOTTOM, EXTRA, OTHER = 0, 1, 2, 3, 4, 5

Size = tuple[float, float, float]
"""Width along x, depth along y, height; metres."""


def draw_size(
    rng: np.random.Generator, width: tuple[float, float], depth: tuple[float, float], height: tuple[float, float]
) -> Size:
    """Draws a size: width in metres, depth and height as shares of the width."""
    w = rng.uniform(*width)
    return w, w * rng.uniform(*depth), w * rng.uniform(*height)


def on_front(name: str, material: Material, size: Size, back: bool) -> Surface:
    """A material mapped once over the front or the back, upright seen from outside."""
    w, d, h = size
    sign = -1.0 if back else 1.0
    origin = (-sign * w / 2, sign * -d / 2, 0.0)
    return Surface(name, material, "plane", origin=origin, across=(sign * w, 0, 0), up=(0, 0, h))


def make_lidded(rng: np.random.Generator) -> Model:
    """A box whose lid is a little wider than it: a shoe box, or a gift box with a ribbon."""
    size = draw_size(rng, (0.08, 0.34), (0.5, 1.0), (0.3, 0.8))
    w, d, h = size
    step, deep = rng.uniform(0.0015, 0.003), h * rng.uniform(0.15, 0.5)
    b = 0.0012
    profile = np.array(
        [[step + b, 0.0], [step, b], [step, 0.5 * (h - deep)], [step, h - deep], [0.0, h - deep], [0.0, h - b], [b, h]]
    )
    body = prism(
        profile, (w, d), rng.uniform(0.0035, 0.006), [BOTTOM, SIDE, SIDE, SIDE, BOTTOM, LID, LID, TOP], 3, (6, 6)
    )
    color: Color = pick(rng, (vivid(rng), pale(rng), WHITE, BLACK))
    cover = color if chance(rng, 0.4) else jitter(rng, vivid(rng))
    roughness = rng.uniform(0.4, 0.8)
    side = Surface("side", solid_color(color, roughness))
    top = Surface("top", solid_color(cover, roughness))
    ribbon = Surface("ribbon", solid_color(vivid(rng), 0.35))
    if chance(rng, 0.5):
        body = union([body, *_ribbon(rng, size)])
    elif chance(rng, 0.7):
        top = over_top("top", textured(label(rng, cover, height=128, width=128, faces=1), roughness), w, d)
    if chance(rng, 0.4):
        patterns = (
            dots(rng, color, mix(color, ink_on(rng, color), 0.7), 256),
            upright_stripes(rng, [color, mix(color, WHITE, 0.5)]),
        )
        side = Surface("side", textured(pick(rng, patterns), roughness), "box", size=max(size))
    surfaces = (
        side,
        Surface("lid", solid_color(cover, roughness)),
        top,
        Surface("bottom", solid_color(mix(color, BLACK, 0.2), 0.8)),
        ribbon,
    )
    return Model(body, surfaces)


def _ribbon(rng: np.random.Generator, size: Size) -> list[Solid]:
    """Two bands around the box and a bow of two loops and a knot."""
    w, d, h = size
    width, lift = min(w, d) * rng.uniform(0.08, 0.16), 0.0009
    bands_around = [
        straight_prism((w + 2 * lift, width), 0.0, h + lift, 0.0008, EXTRA),
        straight_prism((width, d + 2 * lift), 0.0, h + lift, 0.0008, EXTRA),
    ]
    if chance(rng, 0.3):
        return bands_around
    loop = min(w, d) * rng.uniform(0.13, 0.2)
    bow = []
    for sign in (-1.0, 1.0):
        petal = _ellipsoid(np.array([loop, 0.55 * width, 0.5 * loop]))
        turn = rng.uniform(0.2, 0.6)
        axes = _turned(sign, turn)
        bow.append(petal.placed(axes, np.array([sign * 1.08 * loop, 0.0, h + 0.3 * loop])))
    knot = _ellipsoid(np.array([0.4 * loop, 0.6 * width, 0.42 * loop])).moved(z=h + 0.25 * loop)
    return [*bands_around, combine(bow), knot]


def _turned(sign: float, slope: float) -> Array:
    """[3, 3]: rotation about y under which x rises with `slope` towards the side `sign`."""
    length = float(np.sqrt(1.0 + slope * slope))
    c, s = 1.0 / length, sign * slope / length
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _ellipsoid(radii: Array) -> Solid:
    """An ellipsoid about the origin."""
    half = circle(16)[4:13]
    profile = np.stack([-half[:, 0], -half[:, 1]], axis=1)
    ball = lathe(profile, [EXTRA] * (len(profile) - 1), 12)
    return ball.stretched(radii)
