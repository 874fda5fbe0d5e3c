"""The base of every configuration model, the value types that they share, and dotted keys of a tree of values."""

import copy
import unicodedata
from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field

Array = NDArray[np.float64]
"""A float64 array; the docstring that uses it gives the shape."""

Pose = NDArray[np.float64]
"""[4, 4] float64 rigid transform, metres; `T_a_b` takes coordinates in frame b to coordinates in frame a."""


class Frozen(BaseModel):
    """A model that cannot change and that refuses keys it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class Range(NamedTuple):
    """A closed interval, written `[low, high]` in a job file."""

    low: float
    high: float


class Counts(NamedTuple):
    """Whole numbers from `low` to `high`, both included."""

    low: int
    high: int


def ordered(value: Range) -> Range:
    """The interval. Raises ValueError where its ends are not in order."""
    if not value.low <= value.high:
        raise ValueError(f"the range [{value.low}, {value.high}] is empty: write the smaller number first")
    return value


Interval = Annotated[Range, AfterValidator(ordered)]
"""A `Range` whose ends are in order."""


def _plain(value: str) -> str:
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in value):
        raise ValueError("holds a control character: write it without")
    return value


def read_counts(value: object, most: int) -> Counts:
    """`Counts` from [low, high], or from one whole number for both. Raises ValueError outside of 1 to `most`."""
    ends = [value, value] if isinstance(value, int) else list(value) if isinstance(value, list | tuple) else []
    if len(ends) != 2 or not all(type(end) is int and 1 <= end <= most for end in ends):
        raise ValueError(f"write a whole number from 1 to {most}, or two of them as [low, high]")
    if ends[0] > ends[1]:
        raise ValueError(f"the range {ends} is empty: write the smaller number first")
    return Counts(*ends)


def write_counts(count: Counts) -> int | list[int]:
    """One number where both ends are equal."""
    return count.low if count.low == count.high else list(count)


Text = Annotated[str, Field(max_length=1000), AfterValidator(_plain)]
"""Words of the user's, which travel into messages, tables and file names: one line."""

Folder = Annotated[str, Field(max_length=4000), AfterValidator(_plain)]
"""A path, not longer than Linux takes."""

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
VALUE_KINDS: Mapping[str, tuple[type, ...]] = {
    "[word]": (str,),
    "[list]": (list, tuple),
    "[map]": (dict, BaseModel),
    "[number]": (object,),
}
"""Marks of the kinds of value that a key may have, of which an error is told of the right one; anything else is a number."""


def among_kinds(*kinds: str) -> Discriminator:
    """Chooses among the kinds that a key may have by that of its value; the first of them for a value of another kind."""

    def kind_of(value: object) -> str:
        kind = next(name for name, types in VALUE_KINDS.items() if isinstance(value, types))
        return kind if kind in kinds else kinds[0]

    return Discriminator(kind_of)


Share = Annotated[float, Field(ge=0, le=1)]
PositiveInt = Annotated[int, Field(ge=1)]
NonNegativeInt = Annotated[int, Field(ge=0)]
Weight = Annotated[float, Field(gt=0, le=1e12)]
"""A share of the sum of all weights, which must not overflow."""
Seed = Annotated[int, Field(ge=0, le=10**18)]


def frozen_array(values: object, dtype: type = np.float64) -> NDArray:
    """A read-only copy of `values`, for frozen dataclasses: no step can change another's data."""
    array: NDArray = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def with_defaults(tree: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a tree with values by dotted key where it has none; a path through a value without keys is left out."""
    filled = copy.deepcopy(dict(tree))
    for path, value in defaults.items():
        with suppress(ValueError):
            set_key(filled, path, value, keep=True)
    return filled


def set_key(tree: dict[str, Any], path: str, value: object, keep: bool = False) -> None:
    """Set one key, such as `assets.objects.0.weight`, in place; missing branches are made, positions in a list count from 0.

    With `keep`, a value that is there already stays. Raises ValueError where the path leads through a value that has no keys.
    """
    branch: Any = tree
    keys = path.split(".")
    for depth, key in enumerate(keys, 1):
        if isinstance(branch, list) and not (key.isdigit() and int(key) < len(branch)):
            raise ValueError(f"'{key}' must be a position from 0 to {len(branch) - 1}")
        if not isinstance(branch, list | dict):
            raise ValueError(f"'{'.'.join(keys[: depth - 1])}' is {branch!r} and has no key '{key}'")
        place: Any = int(key) if isinstance(branch, list) else key
        if depth == len(keys):
            break
        branch = branch[place] if isinstance(branch, list) else branch.setdefault(place, {})
    if not (keep and isinstance(branch, dict) and place in branch):
        branch[place] = value
