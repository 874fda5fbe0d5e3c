"""The `start` branch of a job: how objects begin, and how many there are."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, PlainSerializer

from schemas.base import Counts, Frozen, Interval, NonNegativeInt, Range

MOST_OBJECTS = 20
"""Largest number of objects in a scene."""

ONE_OBJECT = Counts(1, 1)


def _read_count(value: object) -> object:
    """`Counts` from [low, high], or from one whole number for both. Raises ValueError."""
    ends = [value, value] if isinstance(value, int) else list(value) if isinstance(value, list | tuple) else []
    if len(ends) != 2 or not all(type(end) is int and 1 <= end <= MOST_OBJECTS for end in ends):
        raise ValueError(f"write a whole number from 1 to {MOST_OBJECTS}, or two of them as [low, high]")
    if ends[0] > ends[1]:
        raise ValueError(f"the range {ends} is empty: write the smaller number first")
    return Counts(*ends)


ObjectCount = Annotated[
    Counts,
    BeforeValidator(_read_count),
    PlainSerializer(lambda count: count.low if count.low == count.high else list(count)),
]
"""A range of counts, written as one number where both ends are equal."""


class Start(Frozen):
    """How an object begins."""

    pose: Literal["upright", "tumbled", "placed"] = "upright"
    """upright: uniform yaw; tumbled: uniform rotation; placed: set down at rest, no drop unless it would tip."""
    offset_m: Interval = Range(-0.25, 0.25)
    """Offset from the centre of the table top, along x and along y."""
    arrange: Literal["spread", "pile"] = "spread"
    """Arrangement of several objects. spread: each has its own place on the table; pile: they fall onto one another."""
    pile_offset_m: Interval = Range(-0.03, 0.03)
    """Offset of each further object of a pile from the first, along x and along y."""
    clearance_m: Interval = Range(0.005, 0.05)
    """Height of the lowest point above the table, or above what is below it in a pile, at the start of a drop."""
    max_redraws: NonNegativeInt = 20
    """Largest number of redraws of a position with no table under the centre of mass or no room beside other objects."""
