"""The `render` branch of a job: how RGB is made."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Frozen

Tier = Literal["flat", "raster", "pathtraced"]


class Render(Frozen):
    """RGB."""

    rgb: bool = True
    """Whether there are RGB images; without them no colour is computed."""
    tier: Tier = "raster"
    """raster: textured floors, a key light with soft shadows, contact shadows, transparent texels cut out, smooth edges;
    flat: albedo and light from two directions, in less than half the time; pathtraced: global illumination, glass and
    metal by Mitsuba, in seconds an image (`./verso extra pathtraced` installs it). Depth and masks are the same in all."""
    samples: Literal[1, 4] = 1
    """Colour samples in a pixel at an edge, for tier raster: 1 smooths edges by their neighbours, 4 draws them at three
    more points, in twice the time. Labels are always those of the pixel centre."""
    path_samples: Annotated[int, Field(ge=1, le=65_536)] = 16
    """Paths through each pixel, for tier pathtraced: time grows with them. They fill a grid of nearly equal
    sides, and are rounded up where they do not: 16 is 4 x 4, 13 becomes 15."""
    path_bounces: Annotated[int, Field(ge=1, le=64)] = 8
    """Largest number of scatterings and glass crossings of a path, for tier pathtraced."""
