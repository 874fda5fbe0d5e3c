"""The branch `look` of a job: light and surroundings of a scene. They change colour, and what else stands in a picture."""

from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, Tag, field_validator, model_validator

from schemas.base import (
    Counts,
    Folder,
    Frozen,
    Interval,
    Range,
    Share,
    among_kinds,
    read_counts,
    write_counts,
)
from schemas.job.assets import CategoryWeights
from schemas.job.cameras import OneOrRange
from schemas.job.physics import ObjectCount

Rgb = tuple[Share, Share, Share]


def _within(low: float, high: float) -> AfterValidator:
    """An interval that lies between two bounds."""

    def check(value: Range) -> Range:
        if value.low < low or value.high > high:
            raise ValueError(f"must lie within {low:g} and {high:g}")
        return value

    return AfterValidator(check)


MOST_LIGHTS = 6
"""Of a scene: more do not fit into the 60 floats between the two shaders that OpenGL 4.1 guarantees."""


class Lights(Frozen):
    """Distant lights, drawn anew for each scene. The first casts shadows and gives as much as all others together."""

    number: Annotated[
        Counts, BeforeValidator(lambda value: read_counts(value, MOST_LIGHTS)), PlainSerializer(write_counts)
    ] = Counts(1, 3)
    """How many."""
    elevation_deg: Annotated[OneOrRange, _within(1, 90)] = Range(30.0, 75.0)
    """Angle of each above the horizon."""
    azimuth_deg: Annotated[OneOrRange, _within(-360, 360)] = Range(-180.0, 180.0)
    """Direction of each about the vertical, from the x axis of the world."""
    size_deg: Annotated[OneOrRange, _within(0.1, 40)] = Range(1.0, 8.0)
    """Angle across each: how soft its shadow is."""
    temperature_k: Annotated[OneOrRange, _within(1700, 25_000)] = Range(3500.0, 8000.0)
    """Colour temperature of each; 6500 is white."""
    share: Annotated[OneOrRange, _within(0, 1)] = Range(0.5, 0.85)
    """What they give together of the light on a level surface; the rest comes from all around."""
    total: Annotated[OneOrRange, _within(0.01, 10)] = Range(0.8, 1.05)
    """All light on a level surface: at 1 a white one is just below what clips."""


BuiltIn = Literal["clear_sky", "low_sun", "overcast", "window_room", "office", "softboxes"]
BUILT_IN: tuple[BuiltIn, ...] = get_args(BuiltIn)


class Environment(Frozen):
    """A picture of the light from all directions: one of these for each scene, turned about the vertical."""

    folder: Folder | None = None
    """A folder of equirectangular maps, .hdr or .exr."""
    built_in: Annotated[tuple[BuiltIn, ...], Field(min_length=1)] | None = None
    """Skies and rooms made by formula. Without this and `folder`, all of them."""
    turn_deg: Annotated[OneOrRange, _within(-360, 360)] = Range(-180.0, 180.0)
    """Turn about the vertical."""


class Surface(Frozen):
    """What a floor or a table is made of: a picture or a colour, drawn for each scene."""

    folder: Folder | None = None
    """A folder of .jpg and .png pictures, with the folders in it, relative to the job file."""
    tile_m: Annotated[OneOrRange, _within(0.01, 100.0)] = Range(1.0, 1.0)
    """Metres after which a picture repeats along its width; its height follows."""
    colours: Annotated[tuple[Rgb, ...], Field(max_length=1000)] = ()
    """sRGB colours instead of pictures, each number from 0 to 1."""

    @model_validator(mode="after")
    def _is_either(self) -> "Surface":
        if (self.folder is None) == (not self.colours):
            raise ValueError("needs either a folder of pictures or colours")
        return self


class Room(Frozen):
    """Four walls, without a ceiling, about the middle of the table, with a skirting and a window on the key light's side."""

    size_m: Annotated[OneOrRange, _within(1.0, 59.0)] = Range(5.5, 8.0)
    """Length and width inside, each drawn by itself."""
    height_m: Annotated[OneOrRange, _within(0.5, 20.0)] = Range(2.6, 3.2)
    """Height of the walls."""


class Palette(Frozen):
    """Where the colours of built-in objects go. Greys stay."""

    hue: Annotated[tuple[Interval, ...], Field(min_length=1, max_length=16)]
    """Ranges of hue in turns (0 red, 1/3 green, 2/3 blue), ascending; one over red ends above 1: [0.95, 1.1]. Every hue goes
    into the range that is nearest to it, in order."""
    saturation: Annotated[Interval, _within(0.0, 1.0)] = Range(0.0, 1.0)
    """Saturation up to the first stays; what is above is pressed together so that 1 becomes the second."""

    @field_validator("hue")
    @classmethod
    def _apart(cls, hue: tuple[Range, ...]) -> tuple[Range, ...]:
        ends = [end for one in hue for end in one]
        if ends != sorted(ends) or ends[0] < 0.0 or ends[0] >= 1.0 or ends[-1] > ends[0] + 1.0:
            raise ValueError("ranges of hue must ascend, not overlap, begin in [0, 1), and span one turn at most")
        return hue


Recolour = Annotated[
    Annotated[Literal["as_made", "packaging"], Tag("[word]")] | Annotated[Palette, Tag("[map]")],
    among_kinds("[word]", "[map]"),
]


RECOLOUR_VERSION = 1
"""Of what `recolour` makes of a colour, part of a catalogue's digest: raise it with every change."""


class Clutter(Frozen):
    """Objects that stand about with the others and have no row: in images, masks and depth alone."""

    count: ObjectCount = Counts(1, 4)
    """How many; a range is drawn from evenly, and fewer stand where there is no room."""
    categories: CategoryWeights | None = Field(default=None, min_length=1)
    """Weights of their categories, or a list of them; by default the job's."""


class Look(Frozen):
    """Light and surroundings; every branch is off unless asked for, and what is off leaves the scene as it was."""

    lights: Lights | None = None
    """Lights, drawn from ranges."""
    environment: Environment | None = None
    """Light from all around, by a picture. With `lights` it is the rest of the light."""
    recolour: Recolour = "as_made"
    """Colours of built-in objects: as_made (any hue), packaging (red to yellow, deep green, blue, kraft, white, black), or
    ranges of hue and saturation. A job file that names none has packaging."""
    floor: Surface | None = None
    """Pictures or colours of the floor."""
    table: Surface | None = None
    """Pictures or colours of the table, but for its metal."""
    room: Room | None = None
    """Walls around the scene, of the floor's region; `true` for the default sizes."""
    background: Folder | None = None
    """A folder of .jpg and .png pictures, one of which stands still behind everything where no thing is: unphysical."""
    clutter: Clutter | None = None
    """Objects without rows; `{}` for one to four of the job's categories."""

    @field_validator("room", mode="before")
    @classmethod
    def _switch(cls, value: object) -> object:
        return {} if value is True else None if value is False else value

    def asks_for(self, branch: str) -> bool:
        """Whether a branch has another value than its default."""
        return bool(getattr(self, branch) != Look.model_fields[branch].default)

    def without(self, *branches: str) -> "Look":
        """The look with these of its branches off, whatever their defaults."""
        return self.model_copy(update={name: OFF.get(name) for name in branches}) if branches else self

    @property
    def folders(self) -> dict[str, str]:
        """The folders of pictures, by the key that names them."""
        named = {
            "look.floor.folder": self.floor and self.floor.folder,
            "look.table.folder": self.table and self.table.folder,
            "look.background": self.background,
        }
        return {key: folder for key, folder in named.items() if folder}


OFF = {"recolour": "as_made"}
"""The value of a branch that is off; None of any other."""

OF_COLOUR = ("recolour", "floor", "table", "background", "lights", "environment")
"""Branches of the look that change colour alone."""
