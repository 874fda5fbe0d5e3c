"""The full images of a stored pair, read by role and kind of pixels."""

from collections.abc import Mapping
from typing import TypeAlias

from numpy.typing import NDArray

from schemas.dataset.codec import Row
from services.read.dataset_reader import ReadFile, read_image
from services.read.stored_paths import view_paths

PairImages: TypeAlias = Mapping[tuple[str, str], NDArray]
"""Images by role (input, mirror, projected) and kind of pixels (rgb, depth, region), as far as they are stored."""


def read_pair(read: ReadFile, views: Mapping[str, Row]) -> PairImages:
    """The stored images of a pair but for aligned ones. Raises CorruptError where one is missing or damaged."""
    return {
        (role, kind): read_image(read, path)
        for role, row in views.items()
        if role != "aligned"
        for kind, path in view_paths(row).items()
    }


def metres_of(depth: NDArray, view: Row) -> NDArray:
    """[H, W] float64, metres; 0 where there is no depth."""
    metres: NDArray = depth / view["depth_units_per_m"]
    return metres
