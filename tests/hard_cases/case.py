"""One row of the table of hard cases."""

from dataclasses import dataclass, field

from tests.hard_cases.drops import Make
from tests.hard_cases.measures import Measure

SETTLE, FALL, EITHER = "must settle", "must fall", "either"


def refuse(reason: str) -> str:
    """Must be refused with this reason."""
    return f"must refuse: {reason}"


@dataclass(frozen=True, eq=False)
class Case:
    """One row; `physics` are settings other than the defaults, `spin` is the angular velocity at release, rad/s.

    `miss` says why the case itself is not met, `moves` why the object moves when it is let go again.
    """

    name: str
    outcome: str
    measure: Measure
    make: Make
    physics: dict[str, float] = field(default_factory=dict)
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    miss: str = ""
    moves: str = ""
