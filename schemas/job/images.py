"""The `images` branch of a job: encodings, patches, and the projection of the input cloud."""

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from schemas.base import Frozen, Interval, Positive, PositiveInt, Range


class Patch(Frozen):
    """Size of the crop about each object, pixels [A]."""

    width: PositiveInt = 128
    """Pixels."""
    height: PositiveInt = 96
    """Pixels."""


class Projection(Frozen):
    """How the input cloud is carried into the mirror view."""

    enabled: bool = True
    """Whether there are projected images; they need `cameras.mirror.enabled`."""
    splat: Annotated[int, Field(ge=1, le=15)] = 1
    """Side of the square of pixels that each point fills; odd."""
    hidden_point_removal: bool = False
    """Leave out points whose surface faces away from the mirror camera."""

    @field_validator("splat")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError(
                f"splat {value} is even: a point's square needs a middle pixel, use {value - 1} or {value + 1}"
            )
        return value


class Images(Frozen):
    """Encodings [C, D]."""

    depth_units_per_m: Positive = 5000.0
    """Units of a depth image in a metre."""
    depth_range_m: Interval = Range(0.2, 8.0)
    """Depth outside this open interval is stored as 0."""
    patch: Patch = Patch()
    """Size of the crop about each object."""
    projection: Projection = Projection()
    """How the input cloud is carried into the mirror view."""
    png_level: Annotated[int, Field(ge=0, le=9)] = 1
    """Compression level of the PNG files; pixels do not change. 1 is the fastest. At 2 a scene's images are a quarter smaller and
    take 12 ms more, at 6 more than a third smaller and 70 ms more."""

    @model_validator(mode="after")
    def _fits_16_bits(self) -> "Images":
        units = self.depth_range_m.high * self.depth_units_per_m
        if units > 65_535:
            raise ValueError(
                f"depth_range_m ends at {self.depth_range_m.high:g} m, which is {units:.0f} "
                f"units of depth_units_per_m {self.depth_units_per_m:g}: a 16-bit image holds at most 65535"
            )
        return self
