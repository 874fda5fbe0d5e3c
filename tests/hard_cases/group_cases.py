"""The table of hard cases with several objects: what must happen, by mechanics and geometry, said before it is tried."""

import dataclasses
from dataclasses import dataclass

from tests.hard_cases.bodies import cube
from tests.hard_cases.case import EITHER, SETTLE
from tests.hard_cases.group_measures import GroupMeasure, apart, gaps, heights, tilts
from tests.hard_cases.groups import (
    LEAN_DEG,
    MakeGroup,
    dominoes,
    heavy,
    in_a_bowl,
    in_a_tray,
    leaning,
    lintel,
    onto_another,
    pile,
    stack,
    two_in_one_place,
)


@dataclass(frozen=True, eq=False)
class GroupCase:
    """One row. `miss` says why the case itself is not met, `moves` why things move when they are let go again.

    `slow`, `minute`: letting go again takes minutes or half of one, and is left to `--all` or `--ci`.
    """

    name: str
    outcome: str
    measure: GroupMeasure
    make: MakeGroup
    miss: str = ""
    moves: str = ""
    slow: bool = False
    minute: bool = False


S = 0.05
"""Metres: the side of a cube in a stack of ten."""

ROWS = (
    GroupCase(
        "cube of 10 g on one of 10 kg",
        SETTLE,
        heights(0.03, 0.09),
        lambda: stack(heavy(cube(0.06), 10.0), heavy(cube(0.06), 0.01)),
    ),
    GroupCase(
        "cube of 10 kg on one of 10 g",
        SETTLE,
        heights(0.03, 0.09),
        lambda: stack(heavy(cube(0.06), 0.01), heavy(cube(0.06), 10.0)),
        slow=True,
    ),
    GroupCase(
        "stack of ten cubes",
        SETTLE,
        heights(*(S * (k + 0.5) for k in range(10))),
        lambda: stack(*[cube(S)] * 10),
        slow=True,
    ),
    GroupCase(
        "stack of ten cubes, each turned by 7 degrees",
        SETTLE,
        heights(*(S * (k + 0.5) for k in range(10))),
        lambda: stack(*[cube(S)] * 10, turned_deg=7.0),
        slow=True,
    ),
    GroupCase("pile of twenty boxes", SETTLE, gaps(), lambda: pile(20), slow=True),
    # The motion of what overlaps is not defined. It may be refused or pushed apart, by no more than its own length beyond
    # where it is free.
    GroupCase("two cubes in one place", EITHER, apart(200.0), two_in_one_place),
    GroupCase("cube in an open box", SETTLE, heights(6.8 / 280, 0.025), in_a_tray),
    GroupCase("ball in a bowl", SETTLE, gaps(), in_a_bowl, minute=True),
    GroupCase("plank leaning on a cube's edge", SETTLE, tilts(0.0, 90.0 - LEAN_DEG, bound_deg=0.1), leaning),
    GroupCase("row of six dominoes", SETTLE, tilts(*[0.0] * 6, bound_deg=0.1), lambda: dominoes(6, 0.0)),
    # The last lies flat, and each before it leans on the next: all have gone beyond 45 degrees.
    GroupCase(
        "row of six dominoes, the first leaning 14 of 8.9 degrees",
        SETTLE,
        tilts(*[67.5] * 5, 90.0, bound_deg=22.5),
        lambda: dominoes(6, 14.0),
    ),
    GroupCase("board on two cubes", SETTLE, heights(S / 2, S / 2, S + 0.005), lintel),
    GroupCase("cube of 50 mm from 300 mm onto one of 100 mm", SETTLE, heights(0.05, 0.125), onto_another),
)

SWAYS = (
    "its top sways by a tenth of a millimetre for each half a metre that it is high, and turns, in the finest steps "
)
SWAYS += "more than in longer ones: the solver's error of each step adds up"

MOVES = {
    "pile of twenty boxes": "one that leans slips by 0.6 mm and 0.7 degrees, more slowly than the 1 mm/s that counts as moving",
    "stack of ten cubes": SWAYS,
    "stack of ten cubes, each turned by 7 degrees": SWAYS,
}
"""Cases whose objects move by more than 0.1 mm or 0.1 degrees in the second after they are let go again, and why."""

GROUPS = tuple(dataclasses.replace(case, moves=MOVES.get(case.name, "")) for case in ROWS)
