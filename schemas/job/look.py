"""The branch `look` of a job: light and surroundings of a scene. They change colour, and what else stands in a picture."""

from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer

from schemas.base import Counts, Folder, Frozen, Range, read_counts, write_counts
from schemas.job.cameras import OneOrRange


def _between(least: float, most: float) -> AfterValidator:
    """Refuses an interval that reaches beyond these."""

    def check(ends: Range) -> Range:
        if ends.low < least or ends.high > most:
            raise ValueError(f"must lie between {least:g} and {most:g}")
        return ends

    return AfterValidator(check)


MOST_LIGHTS = 6
"""As many as the renderer has room for."""


class Lights(Frozen):
    """Distant lights, drawn anew for each scene. The first casts shadows and gives as much as all others together."""

    number: Annotated[
        Counts, BeforeValidator(lambda value: read_counts(value, MOST_LIGHTS)), PlainSerializer(write_counts)
    ] = Counts(1, 3)
    """How many."""
    elevation_deg: Annotated[OneOrRange, _between(1, 90)] = Range(30.0, 75.0)
    """Angle of each above the horizon."""
    azimuth_deg: Annotated[OneOrRange, _between(-360, 360)] = Range(-180.0, 180.0)
    """Direction of each about the vertical, from the x axis of the world."""
    size_deg: Annotated[OneOrRange, _between(0.1, 40)] = Range(1.0, 8.0)
    """Angle across each: how soft its shadow is."""
    temperature_k: Annotated[OneOrRange, _between(1700, 25_000)] = Range(3500.0, 8000.0)
    """Colour temperature of each; 6500 is white."""
    share: Annotated[OneOrRange, _between(0, 1)] = Range(0.5, 0.85)
    """What they give together of the light on a level surface; the rest comes from all around."""
    total: Annotated[OneOrRange, _between(0.01, 10)] = Range(0.8, 1.05)
    """All light on a level surface: at 1 a white one is just below what clips."""


BuiltIn = Literal["clear_sky", "low_sun", "overcast", "window_room", "office", "softboxes"]
BUILT_IN: tuple[BuiltIn, ...] = get_args(BuiltIn)


class Environment(Frozen):
    """A picture of the light from all directions: one of these for each scene, turned about the vertical."""

    folder: Folder | None = None
    """A folder of equirectangular maps, .hdr or .exr."""
    built_in: Annotated[tuple[BuiltIn, ...], Field(min_length=1)] | None = None
    """Skies and rooms made by formula. Without this and `folder`, all of them."""
    turn_deg: Annotated[OneOrRange, _between(-360, 360)] = Range(-180.0, 180.0)
    """Turn about the vertical."""


class Look(Frozen):
    """Light and surroundings; every branch is off unless asked for, and what is off leaves the scene as it was."""

    lights: Lights | None = None
    """Lights, drawn from ranges."""
    environment: Environment | None = None
    """Light from all around, by a picture. With `lights` it is the rest of the light."""
