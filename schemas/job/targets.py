"""The branch `targets` of a job: what networks are trained on beside the images of the article, by view and by shape."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from schemas.base import Frozen

ViewTarget = Literal["normals", "coordinates", "albedo", "amodal", "layers"]
ShapeTarget = Literal["surface", "volume"]

MOST_LAYERS = 16
"""Surfaces along a pixel's ray that are stored at most; one of the images `back` shows the last of however many there are."""


class Targets(Frozen):
    """Images of drawn views, and samples of shapes; none by default. Sensor effects never change them."""

    views: tuple[ViewTarget, ...] = ()
    """Image targets of input, aligned and mirror views: normals, coordinates, albedo, amodal, layers."""
    smooth: bool = False
    """Whether `normals` are shading normals, interpolated between vertices, in place of those of the faces."""
    layers: Annotated[int, Field(ge=1, le=MOST_LAYERS)] = 4
    """Surfaces along a pixel's ray that `layers` stores, from the front, beside the last one."""
    shape: tuple[ShapeTarget, ...] = ()
    """Samples of each shape in assets/<category>/<instance>.npz: surface, volume."""
    points: Annotated[int, Field(ge=1, le=10_000_000)] = 100_000
    """Number of points of each of them."""

    @field_validator("views", "shape")
    @classmethod
    def _once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError(f"names a target twice: {', '.join(names)}")
        return names
