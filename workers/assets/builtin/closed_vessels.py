"""Pure: closed vessels: bottles with neck and cap, for wine, beer, water, oil, shampoo, medicine; and cans and tins with rims."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Material
from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import Color, Texture, chance, pick
from workers.assets.builtin.parts import Model, Surface, over_top
from workers.assets.builtin.solid import lathe
from workers.assets.builtin.sweeps import bezier, fillet, rounded_sections, squircle

BODY, LABEL, CAP = 0, 1, 2
SEGMENTS = 48


@dataclass(frozen=True)
class Kind:
    """Ranges of one kind of bottle. Lengths are shares of the height but for `height_m`; radii are half widths.

    body: where the straight body ends; shoulder: its height; neck: its radius as a share of the body's; cap: `cork`,
    `crown`, `screw`, `wide` (as wide as the shoulder lets it be) or `foil`; material: `glass`, `clear`, `plastic` or
    `metal`; sections: squareness of the body's section; depth: of the section as a share of its width; ribs: share of
    bottles with grooves around the body.
    """

    height_m: tuple[float, float]
    radius: tuple[float, float]
    body: tuple[float, float]
    shoulder: tuple[float, float]
    neck: tuple[float, float]
    cap: str
    material: str
    sections: tuple[int, ...] = (0,)
    depth: tuple[float, float] = (1.0, 1.0)
    ribs: float = 0.0


KINDS = (
    # bordeaux, burgundy, beer, soda, water, sauce, oil, shampoo, medicine, flask
    Kind((0.28, 0.32), (0.118, 0.13), (0.58, 0.64), (0.09, 0.13), (0.36, 0.4), "foil", "glass"),
    Kind((0.28, 0.31), (0.13, 0.145), (0.36, 0.44), (0.28, 0.34), (0.34, 0.4), "foil", "glass"),
    Kind((0.2, 0.26), (0.118, 0.14), (0.48, 0.58), (0.15, 0.22), (0.38, 0.46), "crown", "glass"),
    Kind((0.2, 0.33), (0.13, 0.155), (0.55, 0.66), (0.18, 0.26), (0.36, 0.44), "screw", "clear", ribs=0.4),
    Kind((0.19, 0.31), (0.13, 0.17), (0.62, 0.74), (0.12, 0.18), (0.36, 0.46), "screw", "clear", (0, 0, 1), ribs=0.7),
    Kind((0.16, 0.24), (0.13, 0.17), (0.5, 0.62), (0.12, 0.2), (0.36, 0.5), "screw", "glass", (0, 1, 2), (0.75, 1.0)),
    Kind((0.24, 0.32), (0.105, 0.13), (0.58, 0.68), (0.1, 0.16), (0.36, 0.44), "cork", "glass", (0, 1, 2)),
    Kind((0.15, 0.24), (0.17, 0.24), (0.68, 0.8), (0.06, 0.12), (0.4, 0.6), "wide", "plastic", (0, 1), (0.5, 0.8)),
    Kind((0.08, 0.13), (0.22, 0.28), (0.68, 0.75), (0.06, 0.09), (0.6, 0.75), "wide", "glass"),
    Kind((0.2, 0.28), (0.125, 0.16), (0.72, 0.8), (0.05, 0.1), (0.6, 0.85), "wide", "metal"),
)


def make_bottle(rng: np.random.Generator) -> Model:
    """A closed bottle, 80 to 330 mm high."""
    kind = pick(rng, KINDS)
    height = rng.uniform(*kind.height_m)
    radius = height * rng.uniform(*kind.radius)
    body = height * rng.uniform(*kind.body)
    shoulder = body + height * rng.uniform(*kind.shoulder)
    neck = radius * rng.uniform(*kind.neck)
    corners, radii, surface = _outline(rng, kind, height, radius, (body, shoulder), neck)
    profile, owner = fillet(corners, radii, 3)
    squareness, depth = int(rng.choice(kind.sections)), rng.uniform(*kind.depth)
    section = _sections(profile, body, shoulder, squareness, max(depth, 1.12 * neck / radius))
    solid = lathe(profile, surface[owner], SEGMENTS, section)
    return Model(solid, _surfaces(rng, kind, corners, surface))


def _outline(
    rng: np.random.Generator, kind: Kind, height: float, radius: float, levels: tuple[float, float], neck: float
) -> tuple[Array, list[float], Array]:
    """Corners [P, 2] of the profile, their fillet radii, and the surface number of each segment [P - 1]."""
    body, shoulder = levels
    foot = radius * rng.uniform(0.08, 0.22)
    low, high = 0.12 * body + foot, body * rng.uniform(0.86, 0.97)
    base = np.array([[0.0, 0.03 * radius], [0.55 * radius, 0.03 * radius], [0.62 * radius, 0.0], [radius, 0.0]])
    side = _side(rng, kind, radius, low, high)
    steep, flat = rng.uniform(0.45, 0.75), rng.uniform(0.25, 0.5)
    rise = shoulder - body
    arc = bezier([radius, body], [radius, body + steep * rise], [neck, shoulder - flat * rise], [neck, shoulder], 9)
    top, top_surface = _closure(rng, kind, height, radius, shoulder, neck)
    corners = np.concatenate([base, side, arc, top])
    radii = [0.0, 0.0, 0.0, foot, *[0.0] * (len(side) + len(arc)), *[0.0012] * (len(top) - 1), 0.0]
    surface = np.full(len(corners) - 1, BODY)
    surface[len(base) : len(base) + len(side) - 1] = LABEL
    surface[-len(top_surface) :] = top_surface
    return corners, radii, surface


def _side(rng: np.random.Generator, kind: Kind, radius: float, low: float, high: float) -> Array:
    """[S, 2]: the part of the side profile with the label or the grooves."""
    if not chance(rng, kind.ribs):
        return np.array([[radius, low], [radius, high]])
    count, depth = int(rng.integers(3, 7)), radius * rng.uniform(0.03, 0.07)
    pitch = (high - low) / count
    levels = np.linspace(low, high, count + 1)[:-1, None] + pitch * np.array([0.0, 0.55, 0.68, 0.84])
    radii = np.tile([radius, radius, radius - depth, radius - depth], count)
    return np.column_stack([[*radii, radius], [*levels.ravel(), high]])


def _closure(
    rng: np.random.Generator, kind: Kind, height: float, radius: float, shoulder: float, neck: float
) -> tuple[Array, list[int]]:
    """The profile above the shoulder, up to the axis, and the surface numbers of its last segments."""
    room = height - shoulder
    if kind.cap == "foil":
        start, lip = shoulder + room * rng.uniform(0.15, 0.5), height - 0.018 * height / 0.3
        foil, ring, surface = neck + 0.0004, neck * 1.12, [CAP] * 5
        radii, levels = [neck, foil, foil, ring, ring], [start, start + 0.0004, lip, lip + 0.001, height]
    elif kind.cap == "cork":
        ring, cork, lip, surface = neck * 1.18, neck * 0.72, height - 0.34 * room, [BODY, BODY, BODY, CAP, CAP]
        radii, levels = [neck, ring, ring, cork, cork * 1.06], [lip - 0.25 * room, lip - 0.22 * room, lip, lip, height]
    elif kind.cap == "crown":
        ring, cap, low, surface = neck * 1.08, neck * 1.16, height - 0.0062, [BODY, BODY, CAP, CAP, CAP]
        radii, levels = [neck, ring, ring, cap * 1.07, cap], [low - 0.004, low - 0.002, low, low + 0.0004, height]
    elif kind.cap == "screw":
        ring, surface = neck * 1.25, [BODY, BODY, BODY, CAP, CAP, CAP]
        start = max(height - max(0.4 * room, 0.014), shoulder + 0.1 * room)
        radii = [neck, ring * 1.04, neck, neck, ring, ring * 0.97]
        levels = [start - 0.08 * room, start - 0.05 * room, start - 0.02 * room, start, start, height]
    else:
        ring, surface = min(radius * rng.uniform(0.75, 0.96), neck * 1.5), [CAP, CAP, CAP]
        start, taper = shoulder + 0.06 * room, rng.uniform(0.8, 1.0)
        radii, levels = [neck, ring, ring * taper], [start, start, height]
    return np.column_stack([[*radii, 0.0], [*levels, height]]), surface


def _sections(profile: Array, body: float, shoulder: float, squareness: int, depth: float) -> Array | None:
    """[P - 2, n, 2]: the body's section up to the shoulder, which becomes a circle at the neck."""
    if squareness == 0 and depth == 1.0:
        return None
    z = profile[1:-1, 1]
    share = np.clip((shoulder - z) / (shoulder - body), 0.0, 1.0)
    outline = squircle(SEGMENTS, squareness) * np.array([1.0, min(depth, 1.0)])
    return rounded_sections(outline, share * share * (3.0 - 2.0 * share))


def _surfaces(rng: np.random.Generator, kind: Kind, corners: Array, surface: Array) -> tuple[Surface, ...]:
    body = _body_material(rng, kind)
    color: Color = body.base_color[:3]
    paper = pick(rng, (paint.pale(rng), (0.93, 0.92, 0.88), paint.vivid(rng)))
    on_label = np.flatnonzero(surface == LABEL)
    low, high = float(corners[on_label[0], 1]), float(corners[on_label[-1] + 1, 1])
    printed = body
    if chance(rng, 0.8):
        rows = paint.band_height(low, high, float(corners[on_label[0], 0]))
        picture = (
            paint.label(rng, paper, rows) if chance(rng, 0.8) else paint.bands(rng, [paper, paint.vivid(rng), color])
        )
        printed = paint.textured(picture, rng.uniform(0.4, 0.7))
    return (
        Surface("body", body),
        Surface("label", printed, "cylinder", low=low, high=high),
        Surface("cap", _cap_material(rng, kind)),
    )


def _body_material(rng: np.random.Generator, kind: Kind) -> Material:
    if kind.material == "glass":
        return paint.clear_glass(paint.glass_color(rng), rng.uniform(0.08, 0.18))
    if kind.material == "clear":
        tint = pick(
            rng, ((0.72, 0.82, 0.85), (0.6, 0.74, 0.82), (0.66, 0.8, 0.66), (0.28, 0.12, 0.06), (0.78, 0.5, 0.16))
        )
        return paint.clear_glass(paint.jitter(rng, tint, 0.04), rng.uniform(0.1, 0.25))
    if kind.material == "metal":
        return (
            paint.steel(rng)
            if chance(rng, 0.3)
            else paint.solid_color(paint.jitter(rng, paint.vivid(rng)), rng.uniform(0.35, 0.65))
        )
    return paint.plastic(rng)


def _cap_material(rng: np.random.Generator, kind: Kind) -> Material:
    if kind.cap == "cork":
        return paint.solid_color(paint.jitter(rng, (0.72, 0.56, 0.38)), 0.85)
    if kind.cap == "crown":
        return paint.steel(rng) if chance(rng, 0.5) else paint.solid_color(paint.vivid(rng), 0.35, metallic=0.4)
    if kind.cap == "foil":
        return paint.solid_color(paint.mix(paint.vivid(rng), (0.1, 0.05, 0.05), 0.5), 0.4, metallic=0.3)
    return paint.steel(rng) if chance(rng, 0.15) else paint.plastic(rng)


# ---------------------------------------------------------------------------------------------- cans

SIDE, METAL, LID, TOP = 0, 1, 2, 3

Outline = tuple[Sequence[float], Sequence[float], Sequence[float], Sequence[int]]
"""A can from the bottom of the axis to its top: radius, height and fillet radius of each of P corners, metres, and the
surface number of the segment that begins there."""


def make_can(rng: np.random.Generator) -> Model:
    """A closed can with rims, 35 to 200 mm high."""
    builders = ((0.4, _drink), (0.75, _food), (0.88, _spray), (1.0, _paint))
    kind = rng.random()
    build = next(build for share, build in builders if kind < share)
    radii, levels, fillets, numbers = (np.array(column) for column in build(rng))
    surface = numbers[:-1]
    profile, owner = fillet(np.column_stack([radii, levels]), fillets, 3)
    solid = lathe(profile, surface[owner], SEGMENTS)
    on_side = np.flatnonzero(surface == SIDE)
    low, high = float(levels[on_side[0]]), float(levels[on_side[-1] + 1])
    lid_radius = float(radii[np.flatnonzero(surface == LID)[0]])
    rows = paint.band_height(low, high, float(radii[on_side[0]]))
    return Model(solid, _surfaces_can(rng, build is _drink, low, high, rows, lid_radius))


def _drink(rng: np.random.Generator) -> Outline:
    """A drinks can: domed base on a ring, tapered below and above, a rim around a sunken lid."""
    r = float(pick(rng, (0.0265, 0.0289, 0.0331, 0.0331, 0.038)))
    h = r * rng.uniform(3.2, 4.9)
    ring, rim, waist = 0.74 * r, 0.82 * r, 0.06 * (0.13 * r / 0.033) + 0.0032
    return (
        [0.0, 0.6 * ring, ring - 0.003, ring, r, r, rim * 0.985, rim, rim, rim - 0.0022, rim - 0.004, 0.0],
        [0.009, 0.006, 0, 0, waist, h - 0.012 * r / 0.033, h - 0.0024, h - 0.002, h, h, h - 0.006, h - 0.006],
        [0.0, 0.004, 0.0, 0.0, 0.006, 0.006, 0.0, 0.0, 0.0006, 0.0006, 0.0006, 0.0],
        [*[METAL] * 4, SIDE, *[METAL] * 5, LID, LID],
    )


def _food(rng: np.random.Generator) -> Outline:
    """A food tin: straight, often with beads, a double seam at both ends; flat fish tins too."""
    r = rng.uniform(0.03, 0.055)
    h = r * (rng.uniform(0.7, 1.0) if chance(rng, 0.25) else rng.uniform(1.8, 3.2))
    seam, lid = r + 0.0014, h - 0.0045
    count, bead_r, bead_z = 0, np.zeros(0), np.zeros(0)
    if h > 1.5 * r and chance(rng, 0.5):
        count, depth = int(rng.integers(4, 9)), rng.uniform(0.0006, 0.0012)
        step = 0.1 * h / count
        bead_r = np.tile([r, r - depth, r], count)
        bead_z = (np.linspace(0.3 * h, 0.7 * h, count)[:, None] + [-step, 0.0, step]).ravel()
    radii = [0.0, r - 0.004, r - 0.003, seam, seam, r, *bead_r, r, seam, seam]
    levels = [0.003, 0.003, 0.0, 0.0, 0.0042, 0.005, *bead_z, h - 0.005, h - 0.0042, h, h]
    return (
        [*radii, r - 0.0012, r - 0.0025, r * 0.72, r * 0.68, 0.0],
        [*levels, lid, lid, lid + 0.0014, lid + 0.0014],
        [*[0.0] * 3, *[0.0008] * 2, *[0.0] * (2 + 3 * count), *[0.0008] * 2, *[0.0006] * 4, 0.0],
        [*[METAL] * 5, *[SIDE] * (1 + 3 * count), *[METAL] * 4, *[LID] * 4],
    )


def _spray(rng: np.random.Generator) -> Outline:
    """A spray can: tall, domed shoulder, a cap on top."""
    r = rng.uniform(0.022, 0.033)
    h = r * rng.uniform(4.6, 6.4)
    body = h * rng.uniform(0.74, 0.8)
    cap = r * rng.uniform(0.72, 0.97)
    start, seam, crown = body + 0.32 * r, r + 0.0012, cap * rng.uniform(0.85, 1.0)
    return (
        [0.0, 0.7 * r, r - 0.003, seam, seam, r, r, r + 0.001, r + 0.001, cap * 0.95, cap, crown, 0.0],
        [0.006, 0.003, 0.0, 0.0, 0.004, 0.005, body, body + 0.0006, body + 0.003, start, start, h, h],
        [0.0, 0.004, 0.0, 0.0008, 0.0008, 0.0, 0.0, 0.0008, 0.001, 0.0, 0.0, 0.25 * r, 0.0],
        [*[METAL] * 5, SIDE, *[METAL] * 3, TOP, TOP, LID, LID],
    )


def _paint(rng: np.random.Generator) -> Outline:
    """A paint can: wide, with a channelled lid."""
    r = rng.uniform(0.045, 0.085)
    h = r * rng.uniform(1.7, 2.3)
    seam, deep = r + 0.002, h - 0.005
    side = [0.0, r - 0.006, r - 0.004, seam, seam, r, r, seam, seam, r - 0.004]
    channel = [deep, deep, h - 0.001, h - 0.001, deep + 0.001, deep + 0.001]
    return (
        [*side, 0.9 * r, 0.84 * r, 0.8 * r, 0.77 * r, 0.74 * r, 0.0],
        [0.004, 0.004, 0.0, 0.0, 0.005, 0.006, h - 0.007, h - 0.006, h, h, *channel],
        [0.0, 0.0, 0.0, 0.001, 0.001, 0.0, 0.0, *[0.001] * 8, 0.0],
        [*[METAL] * 5, SIDE, *[METAL] * 4, *[LID] * 6],
    )


def _surfaces_can(
    rng: np.random.Generator, drink: bool, low: float, high: float, rows: int, lid_radius: float
) -> tuple[Surface, ...]:
    bare = paint.steel(rng)
    paper: Color = paint.vivid(rng) if chance(rng, 0.6) else paint.pale(rng)
    if chance(rng, 0.08):
        side = bare
    else:
        if chance(rng, 0.8):
            picture = paint.label(rng, paper, rows, faces=int(rng.integers(2, 4)))
        else:
            picture = paint.bands(rng, [paper, paint.ink_on(rng, paper), paint.vivid(rng)])
        shiny = drink or chance(rng, 0.4)
        roughness = rng.uniform(0.3, 0.5) if shiny else rng.uniform(0.6, 0.8)
        side = paint.textured(picture, roughness, 0.35 if drink else 0.0)
    lid = Surface("lid", bare)
    if drink:
        opener = paint.textured(_opener(bare.base_color[:3]), bare.roughness, 1.0)
        lid = over_top("lid", opener, 2 * lid_radius, 2 * lid_radius)
    top = paint.plastic(rng) if chance(rng, 0.8) else paint.solid_color(paint.mix(paper, (0.95, 0.95, 0.95), 0.5), 0.5)
    return Surface("side", side, "cylinder", low=low, high=high), Surface("metal", bare), lid, Surface("cap", top)


def _opener(color: Color) -> Texture:
    """A drinks lid seen from above: the score line of the mouth, and the ring pull."""
    picture = paint.blank(64, 64, color)
    y, x = (np.arange(64)[:, None] - 31.5) / 32, (np.arange(64)[None] - 31.5) / 32
    mouth = (x / 0.3) ** 2 + ((y - 0.42) / 0.4) ** 2
    picture[np.abs(mouth - 1.0) < 0.14] = paint.rgb(paint.mix(color, (0.2, 0.2, 0.2), 0.6))
    tab = (x / 0.2) ** 2 + ((y + 0.16) / 0.4) ** 2
    hole = (x / 0.11) ** 2 + ((y + 0.3) / 0.14) ** 2
    picture[(tab < 1.0) & (hole > 1.0)] = paint.rgb(paint.mix(color, (1.0, 1.0, 1.0), 0.4))
    picture[(np.abs(tab - 1.0) < 0.16) | (np.abs(hole - 1.0) < 0.3)] = paint.rgb(paint.mix(color, (0.1, 0.1, 0.1), 0.6))
    return picture
