"""Rows of the table of hard cases: centres of mass a millimetre to either side of what holds them."""

import math
from functools import partial

import trimesh

from schemas.scene.shape import Asset
from tests.hard_cases.bodies import cube
from tests.hard_cases.case import falls, settles
from tests.hard_cases.drops import EDGE_M, Drop, Y, level, turn, with_peg
from tests.hard_cases.groups import TOUCH_M, Group, heavy, place, prism, put, together
from tests.hard_cases.measures import below, both, height, heights, leaning, moved, tilts
from tests.kit.shapes import asset_of, box

BOARD_M = (0.3, 0.04, 0.01)
STAND_M, STAND_HALF_M = 0.05, 0.005
"""Height and half the width of what a see-saw lies on."""


# ---------------------------------------------------------------------------------------------- overhangs


def ell() -> Asset:
    """An L lying down, as seen from the side: a foot 60 mm long at the end of a beam of 180 mm. Its mass is off its middle."""
    return prism([(-0.09, 0.0), (0.09, 0.0), (0.09, 0.06), (0.07, 0.06), (0.07, 0.02), (-0.09, 0.02)], 0.04)


def ell_over_edge(inside_m: float) -> Drop:
    """The L with its thick end beyond the table's edge, its centre of mass so far inside of it."""
    table = level()
    return Drop(put(ell(), table, TOUCH_M, (EDGE_M - inside_m, 0.0)), table)


def board_over_block(inside_m: float) -> Group:
    """A board on a heavy cube of 100 mm, its centre of mass so far inside of the cube's edge."""
    table, board = level(), asset_of(box(*BOARD_M), mass_kg=0.1)
    starts = [put(heavy(cube(), 5.0), table, TOUCH_M), put(board, table, 0.1 + 2 * TOUCH_M, (0.05 - inside_m, 0.0))]
    return together(table, starts)


def _see_saw(x_m: float) -> Group:
    """A board on a heavy stand 10 mm wide, its centre of mass so far from over the stand's middle."""
    table, board = level(), asset_of(box(*BOARD_M), mass_kg=0.1)
    stand = asset_of(box(2 * STAND_HALF_M, 0.06, STAND_M), mass_kg=5.0)
    return together(table, [put(stand, table, TOUCH_M), put(board, table, STAND_M + 2 * TOUCH_M, (x_m, 0.0))])


def balanced(side: int) -> Group:
    """The see-saw 1 mm inside of an edge of its stand."""
    return _see_saw(side * (STAND_HALF_M - 0.001))


def see_saw(side: int) -> Group:
    """The see-saw 1 mm outside."""
    return _see_saw(side * (STAND_HALF_M + 0.001))


def tipped_deg(height_m: float, over_m: float) -> float:
    """Lean of a board that lies over an edge so high, its centre of mass so far beyond, its lower end on the table.

    Its weight is on the edge but for a hundredth: it needs the tangent of the lean as friction, 0.35 of the 0.49 there are.
    """
    return math.degrees(math.asin(height_m / (BOARD_M[0] / 2 + over_m)))


# ---------------------------------------------------------------------------------------------- hooks


LEG_M, ARM_THICK_M = 0.08, 0.02
"""How far the leg of a hook goes down from its inner corner, and the thickness of its arm."""

SLAB_M = 0.03
"""Of the table's top: how far down the leg can press against it."""


def hook(arm_m: float, leg_thick_m: float) -> Asset:
    """An arm along -x and a leg down from its end; the inner corner is the origin."""
    arm, leg = [(0.0, -LEG_M), (leg_thick_m, -LEG_M)], [(leg_thick_m, ARM_THICK_M), (-arm_m, ARM_THICK_M)]
    return prism([(-arm_m, 0.0), (0.0, 0.0), *arm, *leg], 0.04)


def hooked(arm_m: float, leg_thick_m: float) -> Drop:
    """The hook with its arm on the table and its leg before the edge, `TOUCH_M` from both."""
    table, asset = level(), hook(arm_m, leg_thick_m)
    return Drop(place(asset, table, (EDGE_M + TOUCH_M, 0.0, TOUCH_M)), table)


def hook_demand(arm_m: float, leg_thick_m: float) -> float:
    """The least friction by which a hook hangs, its centre of mass d beyond the edge; 0 inside, inf where none would do.

    The leg presses with N at the slab's lower corner: N SLAB_M = W d about the edge. With friction f there too, W - f N
    stand on the edge, whose friction must be N: N (1 + f^2) <= f W.
    """
    share = float(hook(arm_m, leg_thick_m).mass.com[0]) / SLAB_M
    if share <= 0.0:
        return 0.0
    return math.inf if share > 0.5 else (1.0 - math.sqrt(1.0 - 4.0 * share**2)) / (2.0 * share)


def ring_on_finger() -> Drop:
    """A ring hung on a tongue 8 mm wide that goes on from the table's edge, 1 mm above it."""
    table = with_peg()
    hoop = asset_of(trimesh.creation.annulus(r_min=RING_M[0], r_max=RING_M[1], height=0.01, sections=72))
    R = turn(Y, 90.0)
    inner = RING_M[0]
    return Drop(place(hoop, table, (0.72, 0.0, -math.sqrt(inner**2 - 0.004**2) + 0.001), R), table)


RING_M = (0.02, 0.026)

BALANCE = (
    settles("centre of mass 1 mm inside of the table's edge", moved(0.3), lambda: ell_over_edge(0.001)),
    falls("centre of mass 1 mm outside of the table's edge", lambda: ell_over_edge(-0.001)),
    settles(
        "board's centre of mass 1 mm inside of a block's edge",
        heights(0.05, 0.105, bound_mm=0.02),
        lambda: board_over_block(0.001),
    ),
    # Its end comes down to the table. It may lean there on the edge, 100 mm high, which its middle is beyond and so below.
    settles("board's centre of mass 1 mm outside of a block's edge", below(0.1, 1), lambda: board_over_block(-0.001)),
    *(
        settles(
            f"see-saw balanced 1 mm inside of its {side} edge",
            both(heights(STAND_M / 2, STAND_M + 0.005, bound_mm=0.02), tilts(0.0, 0.0, bound_deg=0.05)),
            partial(balanced, sign),
        )
        for side, sign in (("left", -1), ("right", 1))
    ),
    *(
        settles(
            f"see-saw 1 mm outside of its {side} edge",
            leaning(lambda: tipped_deg(STAND_M, 0.001), 1.0, body=1),
            partial(see_saw, sign),
        )
        for side, sign in (("left", -1), ("right", 1))
    ),
    # It needs a friction of 0.14 of the 0.49 that there are.
    settles("hook with its centre of mass 4 mm beyond the edge it hangs on", moved(0.5), lambda: hooked(0.03, 0.02)),
    # At 15 mm and more no friction would do.
    falls("hook with its centre of mass 26 mm beyond the edge", lambda: hooked(0.03, 0.06)),
    settles("hook with its centre of mass inside of the edge", moved(0.3), lambda: hooked(0.1, 0.02)),
    # As high as the ring's inner side reaches over a tongue 8 mm wide; a corner of the ring may lie on it or a side.
    settles(
        "ring hung on a finger",
        both(height(-math.sqrt(RING_M[0] ** 2 - 0.004**2), 0.3), leaning(lambda: 90.0, 2.0)),
        ring_on_finger,
    ),
)
