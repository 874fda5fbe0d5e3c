"""The table of hard cases with objects at rest: what must happen, by mechanics and geometry, said before it is tried.

A case that the program does not meet yet keeps its outcome and its bounds: `waiting.py` lists it.
"""

import dataclasses

from tests.hard_cases.arch_cases import ARCHES
from tests.hard_cases.balance_cases import BALANCE
from tests.hard_cases.case import UNDEFINED, Case
from tests.hard_cases.file_cases import FROM_FILES
from tests.hard_cases.groups import two_in_one_place
from tests.hard_cases.hollow_cases import HOLLOWS
from tests.hard_cases.leaning_cases import LEANING
from tests.hard_cases.measures import apart
from tests.hard_cases.mesh_cases import OUTSIDE
from tests.hard_cases.rolling_cases import ROLLING, SPINS
from tests.hard_cases.slope_cases import SLOPES
from tests.hard_cases.stack_cases import STACKS
from tests.hard_cases.standing_cases import HIGH, TIPPING, VESSELS
from tests.hard_cases.table_cases import EDGES, SURFACES, TABLES
from tests.hard_cases.thin_cases import SMALL_AND_LARGE, THIN

SINGLE: tuple[Case, ...] = (
    *THIN,
    *SMALL_AND_LARGE,
    *HIGH,
    *VESSELS,
    *TIPPING,
    *ROLLING,
    *EDGES,
    *TABLES,
    *SURFACES,
    *SPINS,
    *OUTSIDE,
)

AGAIN_AT_ONCE = {
    "cube of 10 g on one of 10 kg",
    "board on two cubes",
    "cube of 50 mm from 300 mm onto one of 100 mm",
    "row of six dominoes",
    "plank leaning on a cube's edge",
    "cube against a wall, 4 degrees inside of what friction holds",
    "two cards that lean on one another at 55 degrees",
    "centre of mass 1 mm inside of the table's edge",
    "cube in an open box",
}
"""Cases of `SEVERAL` that the default suite too settles once more and lets go again."""

# The motion of what overlaps is not defined. It may be refused or pushed apart, by no more than its own length beyond where
# it is free.
SEVERAL: tuple[Case, ...] = (
    *STACKS,
    *LEANING,
    *BALANCE,
    *SLOPES,
    *ARCHES,
    *HOLLOWS,
    *FROM_FILES,
    Case("two cubes in one place", UNDEFINED, apart(200.0), two_in_one_place),
)

CASES = (
    *SINGLE,
    *(
        case if case.name in AGAIN_AT_ONCE else dataclasses.replace(case, again=case.again or "minute")
        for case in SEVERAL
    ),
)
