"""The base of every configuration model, and the value types that they share."""

import unicodedata
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

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


def _ordered(value: Range) -> Range:
    if not value.low <= value.high:
        raise ValueError(f"the range [{value.low}, {value.high}] is empty: write the smaller number first")
    return value


Interval = Annotated[Range, AfterValidator(_ordered)]
"""A `Range` whose ends are in order."""


def _plain(value: str) -> str:
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in value):
        raise ValueError("holds a control character: write it without")
    return value


Text = Annotated[str, Field(max_length=1000), AfterValidator(_plain)]
"""Words of the user's, which travel into messages, tables and file names: one line."""

Folder = Annotated[str, Field(max_length=4000), AfterValidator(_plain)]
"""A path, not longer than Linux takes."""

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
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
