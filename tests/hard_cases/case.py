"""One row of the table of hard cases."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from tests.hard_cases.drops import Drop
from tests.hard_cases.groups import Group
from tests.hard_cases.measures import Measure

SETTLE, FALL, EITHER = "must settle", "must fall", "either"
UNDEFINED = "either, or refused"

Made = Drop | Group
Make = Callable[[], Made]


def refuse(reason: str) -> str:
    """Must be refused with this reason."""
    return f"must refuse: {reason}"


@dataclass(frozen=True, eq=False)
class Case:
    """One row; `physics` are settings other than the defaults, `spin` is the first object's angular velocity at release, rad/s.

    `measure` is required of whatever may settle. `tier` is the marker of the tests that settle it (`minute`, `slow`, or
    none), `again` that of the tests that settle it once more or let it go again.
    """

    name: str
    outcome: str
    measure: Measure | None
    make: Make
    physics: dict[str, float] = field(default_factory=dict)
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tier: str = ""
    again: str = ""


def settles(
    name: str, measure: Measure | None, make: Make, physics: dict[str, float] | None = None, **more: Any
) -> Case:
    """A row of what must settle."""
    return Case(name, SETTLE, measure, make, physics or {}, **more)


def falls(name: str, make: Make, physics: dict[str, float] | None = None, **more: Any) -> Case:
    """A row of what must leave the table."""
    return Case(name, FALL, None, make, physics or {}, **more)
