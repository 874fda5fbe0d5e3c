"""Pictures of stored images for a page: colour, depth in viridis, regions, the projection over the mirror view. Pure."""

import base64
import hashlib
import io
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR

MOST_WIDTH = 480
"""Wider images are shrunk to this for the page, pixels."""

JPEG_QUALITY = 82

DEPTH_STRETCH = (1.0, 99.0)
"""Percentiles of depth that get the first and the last colour."""

DIMMED = 0.35
"""Brightness of the mirror view below the projection, where nothing was projected."""

FIXED_REGIONS = ((24, 26, 30), (203, 205, 209), (139, 144, 153))
"""Nothing, floor, table."""

OBJECT_REGIONS = ((46, 111, 197), (224, 123, 57), (62, 146, 104), (160, 84, 160), (196, 160, 42), (72, 165, 178))
"""Objects in turn, told apart also by those who do not see red and green alike."""


@dataclass(frozen=True)
class Picture:
    """An encoded picture with its size in pixels and what it shows in words."""

    data: bytes
    kind: str
    """`jpeg` or `png`."""
    width: int
    height: int
    words: str

    @property
    def name(self) -> str:
        """A file name that follows from the content."""
        return f"{hashlib.sha256(self.data).hexdigest()[:24]}.{self.kind}"

    @property
    def inline(self) -> str:
        """A `data:` address."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.data).decode('ascii')}"


def picture_of_colour(rgb: NDArray[np.uint8], words: str) -> Picture:
    """An RGB image as JPEG."""
    return _jpeg(Image.fromarray(rgb), words)


def picture_of_depth(depth_m: NDArray, span_m: tuple[float, float], words: str) -> Picture:
    """Depth in viridis, near is yellow; pixels without depth (0) are black. `span_m`: depth of first and last colour."""
    low, high = span_m
    share = np.clip((depth_m - low) / max(high - low, 1e-6), 0.0, 1.0)
    bgr = cv2.applyColorMap((255 * (1.0 - share)).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return _jpeg(Image.fromarray(np.where(depth_m[..., None] > 0, bgr[..., ::-1], np.uint8(0))), words)


def depth_span(depth_m: NDArray, regions: NDArray | None = None) -> tuple[float, float]:
    """The depth of the first and the last colour, metres: of the table and what stands on it, as far as regions are known.

    (0, 0) where there is no depth.
    """
    known = depth_m > 0
    above = known if regions is None else known & (regions > REGION_FLOOR)
    values = depth_m[above if above.any() else known]
    low, high = np.percentile(values, DEPTH_STRETCH) if values.size else (0.0, 0.0)
    return float(low), float(high)


def picture_of_regions(regions: NDArray[np.uint8], words: str) -> Picture:
    """Each region in its colour, as PNG, whose edges stay sharp."""
    image = Image.fromarray(np.minimum(regions, 255), "L")
    image = image.resize(_size_of(image), Image.Resampling.NEAREST)
    image.putpalette(_palette())
    sink = io.BytesIO()
    image.save(sink, "PNG", optimize=True)
    return Picture(sink.getvalue(), "png", image.width, image.height, words)


def picture_of_projection(mirror: NDArray[np.uint8], projected: NDArray[np.uint8], words: str) -> Picture:
    """What the input view knows of the mirror view, bright over the dimmed mirror view."""
    known = (projected > 0).any(axis=-1, keepdims=True)
    dimmed = (mirror * DIMMED).astype(np.uint8)
    return _jpeg(Image.fromarray(np.where(known, projected, dimmed)), words)


def _jpeg(image: Image.Image, words: str) -> Picture:
    size = _size_of(image)
    if size != image.size:
        image = image.resize(size, Image.Resampling.BOX)
    sink = io.BytesIO()
    image.save(sink, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return Picture(sink.getvalue(), "jpeg", *size, words)


def _size_of(image: Image.Image) -> tuple[int, int]:
    width = min(image.width, MOST_WIDTH)
    return width, max(1, round(image.height * width / image.width))


def _palette() -> list[int]:
    objects = np.resize(np.array(OBJECT_REGIONS), (256 - REGION_FIRST_OBJECT, 3))
    return [int(value) for value in np.concatenate([np.array(FIXED_REGIONS), objects]).ravel()]
