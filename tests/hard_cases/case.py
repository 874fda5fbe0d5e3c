"""One row of the table of hard cases."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from schemas.base import frozen_array
from schemas.scene.scene import ObjectStart
from tests.hard_cases.drops import Drop, X, Y, turn
from tests.hard_cases.groups import Group
from tests.hard_cases.measures import Measure, Z
from workers.geometry.frames import translation

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


ASIDE_M, TURNED_DEG = 1e-5, 2e-3
"""The most by which a seed moves an object at release, along each axis and about it; up, so that none begins inside another."""


def nudged(made: Made, seed: int) -> Made:
    """The objects where they are let go, each moved a little; seed 0 as they are."""
    if seed == 0:
        return made
    starts = tuple(_moved(start, np.random.default_rng([seed, k])) for k, start in enumerate(made.starts))
    return dataclasses.replace(made, start=starts[0]) if isinstance(made, Drop) else Group(starts, made.table)


def _moved(start: ObjectStart, rng: np.random.Generator) -> ObjectStart:
    x, y = rng.uniform(-ASIDE_M, ASIDE_M, 2)
    T = np.array(start.T_world_obj)
    for axis in (X, Y, Z):
        T[:3, :3] = turn(axis, rng.uniform(-TURNED_DEG, TURNED_DEG)) @ T[:3, :3]
    return dataclasses.replace(start, T_world_obj=frozen_array(translation(x, y, float(rng.uniform(0.0, ASIDE_M))) @ T))
