"""The `render` branch of a job: how RGB is made."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Frozen

Tier = Literal["flat", "raster", "pathtraced"]


class Render(Frozen):
    """RGB."""

    rgb: bool = True
    """Whether there are RGB images; without them no colour is worked out."""
    tier: Tier = "raster"
    """raster: textured floors, a key light with soft shadows, contact shadows, transparent texels cut out, smooth edges;
    flat: albedo and light from two directions, in less than half the time; pathtraced: global illumination, glass and
    metal by Mitsuba, in seconds an image (`./verso extra pathtraced` installs it). Depth and masks are the same in all."""
    samples: Literal[1, 4] = 1
    """Of colour in a pixel that shows an edge, for tier raster: 1 smooths edges by their neighbours, 4 draws them at three
    more points, which takes twice as long. Labels are the pixel centre's either way."""
    path_samples: Annotated[int, Field(ge=1, le=65_536)] = 16
    """Paths through each pixel, for tier pathtraced: time grows with them. They fill a grid of nearly equal
    sides, and are rounded up where they do not: 16 is 4 x 4, 13 becomes 15."""
    path_bounces: Annotated[int, Field(ge=1, le=64)] = 8
    """How often a path may be scattered or cross glass, for tier pathtraced."""
