"""The table of hard cases with objects at rest: what must happen, by mechanics and geometry, said before it is tried.

A case that the program does not meet yet keeps its outcome and its bounds: `waiting.py` lists it.
"""

from tests.hard_cases.arch_cases import ARCHES
from tests.hard_cases.balance_cases import BALANCE
from tests.hard_cases.case import UNDEFINED, Case
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

# The motion of what overlaps is not defined. It may be refused or pushed apart, by no more than its own length beyond where
# it is free.
SEVERAL: tuple[Case, ...] = (
    *STACKS,
    *LEANING,
    *BALANCE,
    *SLOPES,
    *ARCHES,
    *HOLLOWS,
    Case("two cubes in one place", UNDEFINED, apart(200.0), two_in_one_place),
)

CASES = (*SINGLE, *SEVERAL)
