"""Pure: photographic cameras: reflex, rangefinder and compact."""

import numpy as np

from schemas.scene.shape import Material
from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import Color, Texture, chance, pick
from workers.assets.builtin.parts import Model, Surface
from workers.assets.builtin.solid import Solid, combine, lathe, level_ring, loft, union_at
from workers.assets.builtin.sweeps import fillet, prism, straight_prism

SKIN, SHELL, LENS, RING, GLASS, DIAL, DISPLAY, SHOE = 0, 1, 2, 3, 4, 5, 6, 7

FORWARD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation that takes +z to -y, the direction of view."""


def make_camera(rng: np.random.Generator) -> Model:
    """A camera on its flat base, looking along -y: a body with a grip, a lens, a viewfinder, dials, a display."""
    kind = int(rng.integers(3))
    width = rng.uniform(*((0.12, 0.15), (0.115, 0.14), (0.09, 0.115))[kind])
    height = width * rng.uniform(*((0.6, 0.7), (0.54, 0.62), (0.54, 0.64))[kind])
    depth = width * rng.uniform(*((0.34, 0.44), (0.24, 0.32), (0.2, 0.28))[kind])
    size = width, depth, height
    on_hump, on_body = _finder(rng, size, kind)
    lens = _lens(rng, size, kind)
    on_body += _controls(rng, size)
    if kind == 0 or chance(rng, 0.35):
        on_body.append(_grip(rng, size, kind))
    # The solids on the body do not touch one another, so that one boolean joins them.
    layers = [_body(rng, size, kind)] + ([combine(on_hump)] if on_hump else [])
    return Model(_joined(lens, on_body, layers, depth), _surfaces(rng, size, kind))


def _body(rng: np.random.Generator, size: tuple[float, float, float], kind: int) -> Solid:
    """The body: a band of leather between a base plate and a top plate; round ends on rangefinders."""
    width, depth, height = size
    radius = depth * (0.42 if kind == 1 and chance(rng, 0.6) else rng.uniform(0.15, 0.3))
    low, high = height * rng.uniform(0.1, 0.16), height * rng.uniform(0.74, 0.84)
    b, line = 0.0022, 0.0006
    profile = np.column_stack(
        [
            [b, 0.3 * b, 0.0, 0.0, line, line, 0.0, 0.0, 0.3 * b, b],
            [0.0, 0.25 * b, b, low, low + line, high - line, high, height - b, height - 0.3 * b, height],
        ]
    )
    return prism(profile, (width, depth), radius, [*[SHELL] * 4, *[SKIN] * 3, *[SHELL] * 4], 4)


def _lens(rng: np.random.Generator, size: tuple[float, float, float], kind: int) -> Solid:
    """A lens of stepped barrels that ends in a sunken glass, its axis along -y."""
    width, depth, height = size
    radius = height * rng.uniform(*((0.34, 0.4), (0.27, 0.36), (0.24, 0.34))[kind])
    length = radius * rng.uniform(*((1.0, 1.7), (0.6, 1.2), (0.35, 0.8))[kind])
    front = radius * rng.uniform(0.8, 1.0)
    a, b = rng.uniform(0.25, 0.4), rng.uniform(0.6, 0.8)
    # Steps and grooves shrink on a short lens: at least a fifth of its length lies between two barrels, and the first
    # barrel's groove, 2 mm, has to end before the second begins.
    detail = min(1.0, length / 0.012)
    steps = [0.0, 1.0, 1.0, 0.94, 0.94, 0.99, 0.99, 0.95, 0.95, 0.84, 0.66, 0.6, 0.34, 0.0]
    starts = np.repeat([-0.2 * depth, a * length, b * length, length], [2, 4, 2, 6])
    sunk = radius * np.array([-0.22, -0.22, -0.1, -0.06])
    ends = starts + np.array([*(detail * np.array([0, 0, 0, 0.0005, 0.0015, 0.002, 0, 0.001, 0, 0])), *sunk])
    corners = np.column_stack([np.repeat([radius, front], 7) * steps, ends])
    radii = [0.0, 0.0, 0.0008, 0.0, 0.0, 0.0, 0.0008, 0.0, 0.001, 0.0, 0.0, 0.0, 0.05 * radius, 0.0]
    surface = np.array([*[LENS] * 3, RING, *[LENS] * 7, GLASS, GLASS])
    profile, owner = fillet(corners, radii, 1)
    barrel = lathe(profile, surface[owner], 28)
    across = width * rng.uniform(0.0, 0.08)
    # The barrel stays above the base, so that the camera stands on its body, and below its upper plate.
    level = max(0.5 * height * rng.uniform(0.92, 1.06), radius + 0.0015)
    level = min(level, height - 0.007 - radius)
    return barrel.placed(FORWARD, np.array([across, -0.5 * depth, level]))


def _joined(lens: Solid, on_body: list[Solid], layers: list[Solid], depth: float) -> Solid:
    """The union of all. Only the first barrel of the lens, up to the first ring before the body, meets the body."""
    along = lens.vertices[:, 1]
    first = along[along < -0.5 * depth].max()
    touched = (along >= first)[lens.faces].all(axis=1)
    return union_at(lens, touched, np.array([lens.vertices[-1, 0], first, lens.vertices[-1, 2]]), layers, on_body)


def _finder(rng: np.random.Generator, size: tuple[float, float, float], kind: int) -> tuple[list[Solid], list[Solid]]:
    """The solids on the viewfinder's hump, and those on the body: a reflex's hump, or a window in the front."""
    width, depth, height = size
    if kind == 0:
        w, h = width * rng.uniform(0.28, 0.33), height * rng.uniform(0.2, 0.3)
        hump = _frustum((w, 0.95 * depth), (0.55 * w, 0.6 * depth), height - 0.004, height + h, SHELL)
        shoe = straight_prism((0.15 * width, 0.13 * width), height + h - 0.001, height + h + 0.0016, 0.0008, SHOE)
        eye = straight_prism((0.55 * w, 0.012), height + 0.2 * h, height + 0.75 * h, 0.002, DIAL, 2)
        return [shoe, eye.moved(y=0.44 * depth)], [hump]
    size_x, size_z = width * rng.uniform(0.09, 0.14), height * rng.uniform(0.09, 0.12)
    middle = height * 0.89 - 0.5 * size_z
    window = straight_prism((size_x, 0.004), middle, middle + size_z, 0.0012, GLASS, 2)
    parts = [window.moved(x=width * rng.uniform(0.3, 0.38), y=-0.5 * depth + 0.0008)]
    if chance(rng, 0.5):
        parts.append(straight_prism((0.14 * width, 0.12 * width), height - 0.001, height + 0.0018, 0.0008, SHOE))
    return [], parts


def _frustum(low: tuple[float, float], high: tuple[float, float], bottom: float, top: float, surface: int) -> Solid:
    """A box that narrows towards its top, with bevelled upper edges."""
    rings = []
    shoulder = bottom + 0.35 * (top - bottom)
    for (w, d), z, inset in ((low, bottom, 0.0), (low, shoulder, 0.0), (high, top - 0.0012, 0.0), (high, top, 0.0016)):
        x, y, cut = 0.5 * w - inset, 0.5 * d - inset, 0.16 * min(w, d)
        outline = [
            [x, x - cut, cut - x, -x, -x, cut - x, x - cut, x],
            [y - cut, y, y, y - cut, cut - y, -y, -y, cut - y],
        ]
        rings.append(level_ring(np.column_stack(outline), z))
    ends = np.array([[0.0, 0.0, bottom], [0.0, 0.0, top]])
    return loft(np.array(rings), ends[0], ends[1], [surface] * 5, range(5))


def _controls(rng: np.random.Generator, size: tuple[float, float, float]) -> list[Solid]:
    """Shutter button, one or two dials on the top, and the display on the back."""
    width, depth, height = size
    solids = []
    # Seen from the front, a right hand holds the side of -x. Places and radii are shares of the width.
    spots = [(-0.4, 0.033, 0.0028), (-0.275, 0.055, 0.005)]
    if chance(rng, 0.5):
        spots.append((0.32, 0.065, 0.0045))
    for x, radius, rise in spots:
        r = min(radius * width * rng.uniform(0.85, 1.1), 0.3 * depth)
        top = height + rise
        profile = np.column_stack(
            [[0.0, r, r, r - 0.0006, 0.0], [height - 0.003, height - 0.003, top - 0.0006, top, top]]
        )
        solids.append(lathe(profile, [DIAL] * 4, 12).moved(x=x * width, y=0.05 * depth))
    w, h = width * rng.uniform(0.48, 0.56), height * rng.uniform(0.5, 0.58)
    display = straight_prism((w, 0.006), 0.18 * height, 0.18 * height + h, 0.0012, DISPLAY)
    return [*solids, display.moved(x=0.08 * width, y=0.5 * depth - 0.0012)]


def _grip(rng: np.random.Generator, size: tuple[float, float, float], kind: int) -> Solid:
    """A round upright grip on the front, at the -x side."""
    width, depth, height = size
    grip_depth = depth * (rng.uniform(0.8, 1.1) if kind == 0 else rng.uniform(0.3, 0.42))
    w = width * rng.uniform(0.15, 0.18)
    top = height * rng.uniform(0.86, 0.93)
    # Its base lies just above the body's, so that the camera stands on its body and no two planes coincide.
    b = min(0.0016, 0.1 * grip_depth)
    profile = np.array([[b, 0.0012], [0.0, 0.0012 + b], [0.0, top - 2.5 * b], [b, top - 0.6 * b], [2.5 * b, top]])
    grip = prism(profile, (w, grip_depth), 0.45 * min(w, grip_depth), [SKIN] * 6, 5)
    return grip.moved(x=-0.5 * width + 0.52 * w, y=-0.5 * depth - 0.12 * grip_depth if kind else -0.5 * depth)


def _surfaces(rng: np.random.Generator, size: tuple[float, float, float], kind: int) -> tuple[Surface, ...]:
    dark: Color = paint.jitter(rng, (0.1, 0.1, 0.105), 0.03)
    if kind == 0:
        shell, skin = paint.solid_color(dark, rng.uniform(0.5, 0.7)), dark
    else:
        plate = paint.steel(rng) if chance(rng, 0.6) else paint.solid_color(dark, 0.4)
        colors = (dark, dark, (0.3, 0.17, 0.1), paint.vivid(rng), paint.mix(paint.vivid(rng), paint.BLACK, 0.4))
        shell, skin = plate, pick(rng, colors)
        if kind == 2 and chance(rng, 0.6):
            coat = paint.solid_color(
                paint.vivid(rng) if chance(rng, 0.5) else paint.jitter(rng, (0.75, 0.75, 0.76)), 0.4
            )
            return _order(paint.textured(_leather(rng, coat.base_color[:3], 0.06), 0.4), coat, rng)
    return _order(paint.textured(_leather(rng, skin, 0.5), 0.75), shell, rng, max(size))


def _order(skin: Material, shell: Material, rng: np.random.Generator, size: float = 0.1) -> tuple[Surface, ...]:
    lens = (
        paint.solid_color(paint.jitter(rng, (0.09, 0.09, 0.095), 0.03), 0.45) if chance(rng, 0.75) else paint.steel(rng)
    )
    ring = pick(rng, (paint.steel(rng), paint.solid_color(paint.jitter(rng, (0.75, 0.1, 0.1)), 0.4), paint.steel(rng)))
    return (
        Surface("skin", skin, "box", size=0.5 * size),
        Surface("shell", shell),
        Surface("lens", lens),
        Surface("ring", ring),
        Surface("glass", paint.solid_color((0.08, 0.09, 0.16), 0.08)),
        Surface("dial", paint.steel(rng) if chance(rng, 0.5) else paint.solid_color(paint.BLACK, 0.5)),
        Surface("display", paint.solid_color((0.04, 0.045, 0.06), 0.15)),
        Surface("shoe", paint.solid_color((0.3, 0.3, 0.31), 0.45)),
    )


def _leather(rng: np.random.Generator, color: Color, depth: float) -> Texture:
    """A texture of grained leather."""
    dark, light = paint.mix(color, paint.BLACK, depth), paint.mix(color, (0.9, 0.9, 0.9), 0.15 * depth)
    return paint.blend(dark, light, paint.noise(rng, 64, 64, 32, 32))
