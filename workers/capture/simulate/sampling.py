"""How a photograph is averaged: points over a pixel's area and moments of the exposure, and sums in linear light."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.view import Intrinsics
from workers.geometry.colour import SRGB_STEPS
from workers.geometry.jit import compiled

SAMPLES = 9
"""Images that are averaged into one photograph."""

DOWN, WHEN = (7, 0, 5, 2, 4, 6, 3, 8, 1), (6, 3, 0, 7, 4, 1, 8, 5, 2)
"""Row and moment of each sample, whose column is its number. No two of column, row and moment are correlated; samples n and
8 - n lie opposite one another; and of all such orders none spreads the points farther apart."""


@dataclass(frozen=True)
class Sample:
    """One image of the average: a point in the pixel, from its centre, and a moment of the exposure in [-0.5, 0.5]."""

    right_px: float
    down_px: float
    moment: float


CENTRE = Sample(0.0, 0.0, 0.0)
"""The sample of a picture that is antialiased already."""


def make_samples() -> tuple[Sample, ...]:
    """Nine samples with nine columns, nine rows and nine moments: an edge along a row or a column moves in steps of 1/9 px.

    Their mean is the pixel's centre at the exposure's middle, which is sample 4.
    """
    step = 1.0 / SAMPLES
    middle = (SAMPLES - 1) / 2
    return tuple(
        Sample((n - middle) * step, (down - middle) * step, (when - middle) * step)
        for n, (down, when) in enumerate(zip(DOWN, WHEN, strict=True))
    )


def shift_camera(k: Intrinsics, sample: Sample) -> Intrinsics:
    """The camera whose pixel centres lie at the sample's point of each pixel."""
    return k.model_copy(update={"cx": k.cx - sample.right_px, "cy": k.cy - sample.down_px})


def light_table(samples: int) -> Array:
    """[256]: what each code adds to the mean of so many samples, in linear light."""
    return SRGB_STEPS / samples


@compiled
def add_light(total: Array, rgb: NDArray[np.uint8], light_of: Array) -> None:
    """Adds the linear light of rgb [H, W, 3] to total [H, W, 3], in place; light_of [256]: of each code."""
    height, width = total.shape[:2]
    for row in range(height):
        for column in range(width):
            for channel in range(3):
                total[row, column, channel] += light_of[rgb[row, column, channel]]
