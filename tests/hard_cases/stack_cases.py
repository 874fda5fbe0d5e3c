"""Rows of the table of hard cases: what stands on one another."""

import math
from functools import partial

from tests.hard_cases.bodies import ball, cube
from tests.hard_cases.case import settles
from tests.hard_cases.drops import Y, level, turn
from tests.hard_cases.groups import (
    DOMINO_M,
    GAP_M,
    SMALL_M,
    TOUCH_M,
    Group,
    dominoes,
    heavy,
    lintel,
    onto_another,
    put,
    stack,
    together,
    tray,
)
from tests.hard_cases.measures import Measure, apart, below, both, heights, tilts
from tests.kit.shapes import asset_of, box

S = SMALL_M

BRICK_M = (0.12, 0.06, 0.03)


def cubes_up(count: int, side_m: float = S) -> Measure:
    """Each cube of a stack at its height, and none aside by more than its landing may send it."""
    return both(heights(*(side_m * (k + 0.5) for k in range(count)), bound_mm=0.01 * count), apart(1.0))


def stairs(share: float) -> Group:
    """Four bricks, each further over the one below by this share of what balances: L/6, L/4 and L/2 from below up.

    The centre of mass of the k bricks above an edge is then right over it: the harmonic stack.
    """
    table, brick, x = level(), asset_of(box(*BRICK_M)), 0.0
    starts = []
    for number, over in enumerate((0.0, 1 / 6, 1 / 4, 1 / 2)):
        x += share * over * BRICK_M[0]
        starts.append(put(brick, table, TOUCH_M + number * (BRICK_M[2] + TOUCH_M), (x, 0.0)))
    return together(table, starts)


def pyramid_of_cubes() -> Group:
    """Three, two and one cube, each over the gap of 10 mm between the two below."""
    table, starts = level(), []
    for layer, count in enumerate((3, 2, 1)):
        xs = [0.06 * (k - (count - 1) / 2) for k in range(count)]
        starts += [put(cube(S), table, GAP_M + layer * (S + GAP_M), (x, 0.0)) for x in xs]
    return together(table, starts)


BALL_M = 0.02
SNUG_M = 0.0002


def pyramid_of_balls(side: int) -> Group:
    """Balls in squares of side, side - 1, ... 1, the lowest of them snug between a tray's walls."""
    table, starts = tray(0.03, 2.0 * side * BALL_M + SNUG_M), []
    for layer in range(side):
        count, z = side - layer, 1e-4 + layer * (BALL_M * math.sqrt(2.0) + 2e-4)
        at = [(2.0 * BALL_M + SNUG_M / side) * (k - (count - 1) / 2) for k in range(count)]
        starts += [put(ball(BALL_M, 3), table, z, (x, y)) for x in at for y in at]
    return together(table, starts)


def balls_up(side: int) -> Measure:
    """Each layer higher than the last by the radius times root 2: balls on four others that touch one another.

    To 0.3 mm for each layer: what faces of a ball lie below its sphere, and the slack between the walls.
    """
    wanted = [BALL_M * (1.0 + layer * math.sqrt(2.0)) for layer in range(side) for _ in range((side - layer) ** 2)]
    return heights(*wanted, bound_mm=0.3 * side)


def far_dominoes() -> Group:
    """The first of four leans and falls towards the next, which is further away than it is high."""
    table, domino = level(), asset_of(box(*DOMINO_M), mass_kg=0.015)
    starts = [put(domino, table, 0.0002, (0.07 * k, 0.0)) for k in range(1, 4)]
    return together(table, [put(domino, table, 0.0002, (0.0, 0.0), turn(Y, 14.0)), *starts])


def sandwich(top_kg: float, middle_kg: float) -> Group:
    """Three cubes, the lowest as heavy as the highest."""
    return stack(*(heavy(cube(S), kg) for kg in (top_kg, middle_kg, top_kg)))


STACKS = (
    settles(
        "cube of 10 g on one of 10 kg",
        heights(0.03, 0.09, bound_mm=0.02),
        lambda: stack(heavy(cube(0.06), 10.0), heavy(cube(0.06), 0.01)),
    ),
    settles(
        "cube of 10 kg on one of 10 g",
        heights(0.03, 0.09, bound_mm=0.02),
        lambda: stack(heavy(cube(0.06), 0.01), heavy(cube(0.06), 10.0)),
        tier="minute",
        again="slow",
    ),
    settles(
        "cube of 10 g between two of 10 kg", cubes_up(3), lambda: sandwich(10.0, 0.01), tier="minute", again="slow"
    ),
    settles(
        "cube of 10 kg between two of 10 g", cubes_up(3), lambda: sandwich(0.01, 10.0), tier="minute", again="slow"
    ),
    settles("stack of ten cubes", cubes_up(10), lambda: stack(*[cube(S)] * 10), again="slow"),
    settles(
        "stack of ten cubes, each turned by 7 degrees",
        cubes_up(10),
        lambda: stack(*[cube(S)] * 10, turned_deg=7.0),
        again="slow",
    ),
    # Every cube's centre is over the middle of the one below, as at any height.
    settles("stack of twenty-five cubes", cubes_up(25), lambda: stack(*[cube(S)] * 25), tier="slow", again="slow"),
    settles(
        "four bricks over one another by 95 % of what balances",
        heights(*(0.03 * k + 0.015 for k in range(4))),
        lambda: stairs(0.95),
    ),
    settles(
        "four bricks over one another by 105 % of what balances", below(0.09, 3), lambda: stairs(1.05), tier="minute"
    ),
    settles("six cubes in a pyramid", heights(*[S / 2] * 3, *[1.5 * S] * 2, 2.5 * S, bound_mm=0.05), pyramid_of_cubes),
    settles("five balls in a pyramid in a tray", balls_up(2), partial(pyramid_of_balls, 2), again="slow"),
    settles("fourteen balls in a pyramid in a tray", balls_up(3), partial(pyramid_of_balls, 3), tier="slow"),
    settles("row of six dominoes", tilts(*[0.0] * 6, bound_deg=0.1), lambda: dominoes(6, 0.0)),
    # The last lies flat, and each before it leans on the next: all have gone beyond 45 degrees.
    settles(
        "row of six dominoes, the first leaning 14 of 8.9 degrees",
        tilts(*[67.5] * 5, 90.0, bound_deg=22.5),
        lambda: dominoes(6, 14.0),
    ),
    settles(
        "row of six dominoes, the first leaning 8 of 8.9 degrees",
        tilts(*[0.0] * 6, bound_deg=0.1),
        lambda: dominoes(6, 8.0),
    ),
    settles("a domino falls short of the next", tilts(90.0, 0.0, 0.0, 0.0, bound_deg=0.1), far_dominoes),
    settles("board on two cubes", heights(S / 2, S / 2, S + 0.005, bound_mm=0.02), lintel),
    settles("cube of 50 mm from 300 mm onto one of 100 mm", heights(0.05, 0.125, bound_mm=0.02), onto_another),
)
