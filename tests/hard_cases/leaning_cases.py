"""Rows of the table of hard cases: what leans, and stays by friction alone.

The friction of a contact is `MU`, the square of a body's. A board of length L and thickness t leans at the angle a from the
level, its lower face's two ends on the floor and on a wall. With c, s = cos a, sin a, its centre of mass is
x = (L c - t s) / 2 inside of its foot, and the wall's force N with friction f N gives, about the foot, N (s + f c) L = W x.
The floor's friction must be N of the W - f N that stand on it. Taking all of the wall's friction, f = MU, it stays where
N (1 + MU^2) <= MU W, that is tan a >= (1 - MU^2) / (2 MU + (1 + MU^2) t / L): for a cube a >= 45 degrees - atan MU.
"""

import math

import shapely

from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, Table
from tests.hard_cases.case import settles
from tests.hard_cases.drops import Drop, Y, level, turn
from tests.hard_cases.groups import FREE_M, LEAN_DEG, SMALL_M, Group, leaning, place, prism, put, together, tray
from tests.hard_cases.measures import below, both, flat, heights, moved, tilts
from tests.hard_cases.measures import leaning as at_angle
from tests.kit.shapes import asset_of, box

MU = Job(name="t").physics.friction_of("table") ** 2

LADDER_M = (0.18, 0.006)
"""Length and thickness: it reaches less high than the walls of the tray."""


def steepest_deg(thickness_to_length: float) -> float:
    """The least angle from the level at which a board stays on a wall: the limit above."""
    return math.degrees(math.atan2(1.0 - MU**2, 2.0 * MU + (1.0 + MU**2) * thickness_to_length))


CUBE_DEG, THIN_DEG = steepest_deg(1.0), steepest_deg(LADDER_M[1] / LADDER_M[0])
"""18.9 and 36.7 degrees."""


def on_a_wall(asset_m: tuple[float, float], angle_deg: float) -> Drop:
    """A board, its lower face that far from the level, `FREE_M` over the floor of a tray and before its wall."""
    table, (length_m, thick_m) = tray(), asset_m
    start = put(asset_of(box(length_m, 0.05, thick_m)), table, FREE_M, R=turn(Y, -angle_deg))
    reach = start.hull.vertices @ start.T_world_obj[:3, :3].T + start.T_world_obj[:3, 3]
    return Drop(put(start.asset, table, FREE_M, (0.15 - FREE_M - reach[:, 0].max(), 0.0), turn(Y, -angle_deg)), table)


# ---------------------------------------------------------------------------------------------- rafters


CARD_M = (0.09, 0.06, 0.003)
"""Length, width and thickness."""


def rafter(angle_deg: float) -> tuple[tuple[float, float], ...]:
    """The outline of a card cut level at its foot and plumb at its ridge, x = 0; it falls off towards -x."""
    a, (length, _, thick) = math.radians(angle_deg), CARD_M
    run, rise = length * math.cos(a), math.tan(a)
    outer = -run - thick / math.sin(a)
    return (outer, 0.0), (-run, 0.0), (0.0, run * rise), (0.0, -outer * rise)


def demand(angle_deg: float, load: float = 0.0) -> float:
    """The least friction by which two rafters hold one another up, with so many weights of one of them on each ridge end.

    The ridge's thrust H is level by symmetry. It has the longest arm at the ridge's top, about the foot's inner edge:
    H z = W (x_com - x_foot) + load W (x_ridge - x_foot) is the least, and the floor bears W (1 + load).
    """
    (_, (foot, _), _, (_, top)) = outline = rafter(angle_deg)
    com = shapely.Polygon(outline).centroid.x
    return ((com - foot) + load * (0.0 - foot)) / top / (1.0 + load)


def pair(angle_deg: float, table: Table, x_m: float) -> list[ObjectStart]:
    """Two rafters with their ridge over x."""
    left = prism(rafter(angle_deg), CARD_M[1], 0.005)
    right = prism([(-x, z) for x, z in reversed(rafter(angle_deg))], CARD_M[1], 0.005)
    return [place(left, table, (x_m, 0.0, 0.0)), place(right, table, (x_m, 0.0, 0.0))]


def a_frame(angle_deg: float) -> Group:
    """Two cards that lean on one another."""
    table = level()
    return together(table, pair(angle_deg, table, 0.0))


def house(angle_deg: float) -> Group:
    """Two pairs of cards side by side, and one of the same weight across their ridges."""
    table, outline = level(), rafter(angle_deg)
    apart_m, top_m = -2.0 * outline[0][0] + 0.002, outline[3][1]
    roof = asset_of(box(apart_m + 0.03, CARD_M[1], CARD_M[2]), mass_kg=0.005)
    cards = [*pair(angle_deg, table, -apart_m / 2), *pair(angle_deg, table, apart_m / 2)]
    return together(table, [*cards, put(roof, table, top_m + FREE_M)])


STEEP_DEG, LOW_DEG = 55.0, 32.0
"""Of a pair alone: its demand is 0.32 and 0.72 of the weight on a foot, where friction gives 0.49."""

HOUSE_STEEP_DEG, HOUSE_LOW_DEG = 62.0, 36.0
"""With a quarter of a card's weight on each rafter's ridge end: 0.29 and 0.75."""


LEANING = (
    settles(
        "cube against a wall, 4 degrees inside of what friction holds",
        at_angle(lambda: CUBE_DEG + 4.0, 1.0),
        lambda: on_a_wall((SMALL_M, SMALL_M), CUBE_DEG + 4.0),
    ),
    settles(
        "cube against a wall, 4 degrees outside of what friction holds",
        both(flat(0.1), heights(SMALL_M / 2, bound_mm=0.01)),
        lambda: on_a_wall((SMALL_M, SMALL_M), CUBE_DEG - 4.0),
    ),
    settles(
        "ladder 8 degrees inside of what friction holds",
        at_angle(lambda: THIN_DEG + 8.0, 1.0),
        lambda: on_a_wall(LADDER_M, THIN_DEG + 8.0),
    ),
    settles(
        "ladder 8 degrees outside of what friction holds",
        both(flat(0.1), heights(LADDER_M[1] / 2, bound_mm=0.01)),
        lambda: on_a_wall(LADDER_M, THIN_DEG - 8.0),
    ),
    settles("plank leaning on a cube's edge", tilts(0.0, 90.0 - LEAN_DEG, bound_deg=0.1), leaning),
    settles("two cards that lean on one another at 55 degrees", moved(0.5), lambda: a_frame(STEEP_DEG)),
    settles(
        "two cards that lean on one another at 32 degrees",
        both(below(0.006, 0), below(0.006, 1)),
        lambda: a_frame(LOW_DEG),
    ),
    settles("house of five cards at 62 degrees", moved(0.7), lambda: house(HOUSE_STEEP_DEG)),
    settles("house of five cards at 36 degrees", below(0.02, 4), lambda: house(HOUSE_LOW_DEG)),
)
