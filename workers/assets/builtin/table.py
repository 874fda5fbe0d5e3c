"""Pure: tables: round, oval, square and rectangular, of wood, stone or paint, on legs, pedestals, sleds or panels."""

import functools
from dataclasses import dataclass, replace

import numpy as np

from schemas.base import Array
from workers.assets.builtin import materials as paint
from workers.assets.builtin.materials import chance, pick
from workers.assets.builtin.parts import Model, Surface
from workers.assets.builtin.solid import Indices, Solid, circle, combine, lathe, level_ring, loft, union
from workers.assets.builtin.sweeps import bezier, prism, rounded_rectangle, squircle

TOP, LEG, FRAME = 0, 1, 2
"""Surface numbers of a table."""


@dataclass(frozen=True)
class TableSize:
    """Sizes of one table, metres: the top's width along x, depth along y and thickness, and its height."""

    width: float
    depth: float
    thick: float
    height: float
    round_top: bool

    @property
    def under(self) -> float:
        """Height of the underside of the top."""
        return self.height - self.thick


def make_table(rng: np.random.Generator) -> Model:
    """A table 0.45 to 0.9 m high, its flat top 0.9 to 1.8 m across and 15 to 45 mm thick, exactly level."""
    round_top = chance(rng, 0.35)
    width = rng.uniform(0.9, 1.4) if round_top else rng.uniform(0.9, 1.8)
    depth = width if round_top and chance(rng, 0.6) else max(0.8, width * rng.uniform(0.55, 1.0))
    height = rng.uniform(0.68, 0.8) if chance(rng, 0.6) else rng.uniform(0.45, 0.9)
    plan = TableSize(width, depth, rng.uniform(0.015, 0.045), height, round_top)
    return Model(union([_top(rng, plan), *make_base(rng, plan)]), _surfaces(rng, plan))


def make_tray(rng: np.random.Generator) -> Model:
    """A tray on legs, 0.3 to 0.55 m wide, its floor level and its rim 2 to 6 cm high."""
    return _vessel(rng, rng.uniform(0.3, 0.55), rng.uniform(0.02, 0.06), rng.uniform(0.0, 0.02))


def make_bin(rng: np.random.Generator) -> Model:
    """A bin on legs, 0.4 to 0.6 m wide as stacking boxes are, its floor level and its walls 12 to 26 cm high."""
    return _vessel(rng, rng.uniform(0.4, 0.6), rng.uniform(0.12, 0.26), rng.uniform(0.01, 0.025))


def _vessel(rng: np.random.Generator, width: float, deep: float, draft: float) -> Model:
    """A rectangular vessel this wide and deep inside, whose walls lean outwards by `draft`, on the legs of a table."""
    depth, thick, wall = width * rng.uniform(0.65, 0.9), rng.uniform(0.012, 0.018), rng.uniform(0.005, 0.009)
    radius = draft + wall + rng.uniform(0.004, 0.03)
    plan = TableSize(width - 2 * draft, depth - 2 * draft, thick, rng.uniform(0.45, 0.75), False)
    low, floor, rim = plan.under, plan.height, plan.height + deep
    edge = 0.2 * wall
    outside = [[draft + edge, low], [draft, low + edge], [0.0, rim - edge], [edge, rim]]
    profile = np.array([*outside, [wall - edge, rim], [wall, rim - edge], [draft + wall, floor]])
    vessel = prism(profile, (width, depth), radius, [TOP] * 8, 4)
    return Model(union([vessel, *pick(rng, (_legs, _apron_legs, _sled))(rng, plan)]), _surfaces(rng, plan))


def _top(rng: np.random.Generator, plan: TableSize) -> Solid:
    edge = min(rng.uniform(0.001, 0.008), 0.3 * plan.thick)
    low, high = plan.under, plan.height
    levels = [low, low + edge, high - edge, high - 0.3 * edge, high]
    profile = np.column_stack([[edge, 0.0, 0.0, 0.3 * edge, edge], levels])
    if plan.round_top:
        outline = squircle(48, 0) * np.array([0.5 * plan.width, 0.5 * plan.depth])
        rings = [level_ring(outline * (1 - 2 * inset / plan.depth), z) for inset, z in profile]
        ends = np.array([[0.0, 0.0, low], [0.0, 0.0, high]])
        return loft(np.stack(rings), ends[0], ends[1], [TOP] * 6, [0, 1, 2, 3, 3, 4])
    radius = edge + (rng.uniform(0.002, 0.02) if chance(rng, 0.6) else rng.uniform(0.03, 0.15))
    return prism(profile, (plan.width, plan.depth), radius, [TOP] * 6, 4)


def _surfaces(rng: np.random.Generator, plan: TableSize) -> tuple[Surface, ...]:
    light, dark = paint.wood_colors(rng)
    long = max(plan.width, plan.depth)
    timber = paint.textured(paint.wood(rng, light, dark, planks=int(rng.integers(0, 8))), rng.uniform(0.35, 0.7))
    kind = rng.random()
    if kind < 0.55:
        top = timber
    elif kind < 0.72:
        greys, brown = ((0.2, 0.2, 0.21), (0.5, 0.5, 0.5)), ((0.75, 0.68, 0.6), (0.5, 0.42, 0.35))
        pair = pick(rng, ((paint.WHITE, (0.6, 0.6, 0.62)), greys, brown))
        top = paint.textured(paint.stone(rng, *pair), rng.uniform(0.15, 0.4))
    elif kind < 0.8:
        ground = paint.pale(rng)
        top = paint.textured(paint.speckled(rng, ground, paint.mix(ground, paint.BLACK, 0.5), 0.04, 192, 192), 0.4)
    else:
        coat = pick(rng, (paint.WHITE, (0.85, 0.85, 0.84), paint.BLACK, (0.3, 0.32, 0.34), paint.vivid(rng)))
        top = paint.solid_color(paint.jitter(rng, coat), rng.uniform(0.3, 0.6))
    matching = top is timber and chance(rng, 0.7)
    legs = timber if matching or not chance(rng, 0.5) else paint.metal(rng)
    parts = (("top", top, 0), ("legs", legs, 2), ("frame", legs, 0))
    return tuple(Surface(name, material, "box", size=long, grain=grain) for name, material, grain in parts)


def make_base(rng: np.random.Generator, plan: TableSize) -> list[Solid]:
    """One or two solids, standing at height 0, that reach into the table top from below."""
    if plan.round_top:
        return pick(rng, (_pedestal, _legs, _panels))(rng, plan)
    return pick(rng, (_legs, _legs, _apron_legs, _apron_legs, _sled, _trestle, _panels))(rng, plan)


def _leg_spots(plan: TableSize, inset: float) -> list[tuple[float, float]]:
    """Where four legs stand, under the corners or within the ellipse of a round top."""
    share = 0.62 if plan.round_top else 1.0
    x, y = 0.5 * plan.width * share - inset, 0.5 * plan.depth * share - inset
    return [(x, y), (-x, y), (-x, -y), (x, -y)]


def _leg(
    rng: np.random.Generator, plan: TableSize, spots: list[tuple[float, float]], splay: float, size: float
) -> Solid:
    """Four equal legs, square or round, tapered, leaning outwards with the slope `splay`."""
    is_round, taper = chance(rng, 0.5), rng.uniform(0.55, 1.0)
    outline = circle(12) * 0.5 if is_round else rounded_rectangle(1.0, 1.0, 0.08, 1)
    top = plan.under + 0.4 * plan.thick
    legs = []
    for spot in np.array(spots):
        away = np.copysign(splay, spot)
        foot = level_ring(outline * size * taper + spot + away * plan.under, 0.0)
        head = level_ring(outline * size + spot - away * (top - plan.under), top)
        ends = np.array([*(spot + away * plan.under), 0.0]), np.array([*spot, top])
        legs.append(loft(np.stack([foot, head]), *ends, [LEG] * 3, range(3)))
    return combine(legs)


def _legs(rng: np.random.Generator, plan: TableSize) -> list[Solid]:
    """Legs straight into the top, upright or splayed."""
    size = rng.uniform(0.03, 0.06)
    splay = rng.uniform(0.04, 0.16) if chance(rng, 0.5) else 0.0
    inset = 0.6 * size + 0.02 + (splay * plan.under if not plan.round_top else 0.0)
    return [_leg(rng, plan, _leg_spots(plan, inset), splay, size)]


def _beam(size: tuple[float, float, float], at: tuple[float, float, float], surface: int) -> Solid:
    """A box of a size, centred at a point."""
    x, y, z = (0.5 * s for s in size)
    corners = np.array([[x, y], [-x, y], [-x, -y], [x, -y]]) + np.array(at[:2])
    low, high = (np.array([*at[:2], at[2] + dz]) for dz in (-z, z))
    return _edged(np.stack([level_ring(corners, end[2]) for end in (low, high)]), low, high, surface)


def _edged(rings: Array, start: Array, end: Array, surface: int) -> Solid:
    """The loft through rings [L, 4, 3] whose four sides are shaded apart."""
    bands = len(rings) + 1
    solid = loft(rings, start, end, [surface] * bands, range(bands))
    side = np.concatenate([np.zeros(4), np.tile(np.repeat(np.arange(4), 2), bands - 2), np.zeros(4)])
    return replace(solid, smooth=solid.smooth * 4 + side.astype(np.int64))


def _apron_legs(rng: np.random.Generator, plan: TableSize) -> list[Solid]:
    """Four upright legs joined by an apron, and often by a shelf or by stretchers."""
    size = rng.uniform(0.045, 0.08)
    spots = _leg_spots(plan, 0.5 * size + rng.uniform(0.012, 0.05))
    x, y = spots[0]
    legs = _leg(rng, plan, spots, 0.0, size)
    deep, thin = rng.uniform(0.06, 0.11), 0.4 * size
    middle = plan.under - 0.5 * deep + 0.3 * plan.thick
    solids = [_frame((2 * x + thin, 2 * y + thin), thin, middle - 0.5 * deep, middle + 0.5 * deep)]
    kind = rng.random()
    low = plan.height * rng.uniform(0.15, 0.3)
    if kind < 0.35:
        solids.append(_beam((2 * x + 0.2 * thin, 2 * y + 0.2 * thin, 0.02), (0.0, 0.0, low), FRAME))
    elif kind < 0.6:
        solids.append(_frame((2 * x + thin, 2 * y + thin), thin, low - 0.5 * thin, low + 0.5 * thin))
    return [legs, combine(solids)]


def _frame(size: tuple[float, float], wide: float, low: float, high: float) -> Solid:
    """A rectangular frame of four bars, `wide` thick, between two heights."""
    square = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    outer, inner = square * np.array(size), square * (np.array(size) - 2 * wide)
    loops = [level_ring(xy, z) for xy, z in ((inner, low), (outer, low), (outer, high), (inner, high))]
    faces, smooth = _frame_faces()
    return Solid(np.concatenate(loops), faces, np.full(len(faces), FRAME), smooth)


@functools.cache
def _frame_faces() -> tuple[Indices, Indices]:
    """The faces [32, 3] of every frame, through its four loops of four corners, and the smoothing group [32] of each."""
    j = np.arange(4)
    faces, smooth = [], []
    for k in range(4):
        a, b, c, d = 4 * k + j, 4 * k + (j + 1) % 4, 4 * ((k + 1) % 4) + (j + 1) % 4, 4 * ((k + 1) % 4) + j
        faces.append(np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1).reshape(-1, 3))
        smooth.append(np.repeat(4 * k + j, 2))
    table = np.concatenate(faces), np.concatenate(smooth)
    for array in table:
        array.setflags(write=False)
    return table


def _pedestal(rng: np.random.Generator, plan: TableSize) -> list[Solid]:
    """One turned column on a round plate or on a wide bell."""
    column, foot = rng.uniform(0.03, 0.07), plan.depth * rng.uniform(0.27, 0.34)
    top = plan.under + 0.4 * plan.thick
    plate = rng.uniform(0.012, 0.03)
    if chance(rng, 0.5):
        levels = [plate, plate + 0.02, 0.4 * plan.under, plan.under - 0.05]
        stem = np.column_stack([[foot, column * 1.1, column, column], levels])
    else:
        waist = column * 0.9
        ends = [foot, plate], [column, plan.under - 0.05]
        stem = bezier(ends[0], [waist, plate + 0.04], [waist, 0.3 * plan.under], ends[1], 8)
    head = [[column * 2.0, plan.under - 0.005], [column * 2.0, top], [0.0, top]]
    profile = np.concatenate([[[0.0, 0.0], [foot - 0.002, 0.0], [foot, 0.003]], stem, head])
    return [lathe(profile, [LEG] * (len(profile) - 1), 32)]


def _sled(rng: np.random.Generator, plan: TableSize) -> list[Solid]:
    """Two frames of square bars, one at each end, sometimes joined below the top."""
    loft = rng.uniform(0.03, 0.055)
    x, y = 0.5 * plan.width - rng.uniform(0.05, 0.18), 0.5 * plan.depth - rng.uniform(0.03, 0.08)
    top = plan.under + 0.4 * plan.thick
    upright = _frame((top, 2 * y), loft, -0.5 * loft, 0.5 * loft)
    # The frame lies flat about the origin; turned about y, its first axis stands up.
    stood = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    ends = [upright.placed(stood, np.array([side, 0.0, 0.5 * top])) for side in (-x, x)]
    legs = combine(ends)
    legs = replace(legs, surface=np.full(len(legs.faces), LEG))
    if not chance(rng, 0.5):
        return [legs]
    return [legs, _beam((2 * x, 0.8 * loft, 0.8 * loft), (0.0, 0.0, plan.under - 0.2 * loft), FRAME)]


def _trestle(rng: np.random.Generator, plan: TableSize) -> list[Solid]:
    """A board on edge at each end with a wide foot, joined by a long rail."""
    x = 0.5 * plan.width - rng.uniform(0.15, 0.25)
    board, thick = plan.depth * rng.uniform(0.25, 0.5), rng.uniform(0.03, 0.06)
    top, foot = plan.under + 0.4 * plan.thick, 0.78 * plan.depth
    # The end view of an upright with a wide foot and a wide head.
    half = np.column_stack(
        [
            [0.5 * foot, 0.5 * foot, 0.42 * foot, 0.5 * board, 0.5 * board, 0.45 * foot, 0.45 * foot],
            [0.0, 0.03, 0.06, 0.075, top - 0.1, top - 0.07, top],
        ]
    )
    return [
        combine([_cheek(half, thick, side) for side in (-x, x)]),
        _beam((2 * x + 0.1, 0.6 * thick, 0.09), (0.0, 0.0, plan.under * rng.uniform(0.3, 0.6)), FRAME),
    ]


def _cheek(half: Array, thick: float, at: float) -> Solid:
    """An upright board in the plane x = at; half [K, 2]: its half width and height (y, z), from foot to head."""
    x = at + 0.5 * thick * np.array([1.0, -1.0, -1.0, 1.0])
    y = half[:, :1] * np.array([1.0, 1.0, -1.0, -1.0])
    rings = np.stack(np.broadcast_arrays(x, y, half[:, 1:]), axis=2)
    return _edged(rings, np.array([at, 0.0, 0.0]), np.array([at, 0.0, half[-1, 1]]), LEG)


def _panels(rng: np.random.Generator, plan: TableSize) -> list[Solid]:
    """Two panels that cross, or two ends like a bench's."""
    thick, top = rng.uniform(0.02, 0.04), plan.under + 0.4 * plan.thick
    reach = 0.62 if plan.round_top else 0.85
    x, y = reach * plan.width, reach * plan.depth
    if plan.round_top or chance(rng, 0.3):
        first = _beam((x, thick, top), (0.0, 0.0, 0.5 * top), LEG)
        return [first, _beam((thick, y, top), (0.0, 0.0, 0.5 * top), LEG)]
    ends = [_beam((thick, y, top), (side * 0.5 * x, 0.0, 0.5 * top), LEG) for side in (-1.0, 1.0)]
    return [combine(ends), _beam((x, thick, 0.25 * plan.height), (0.0, 0.0, 0.72 * plan.under), FRAME)]
