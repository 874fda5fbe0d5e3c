import base64
import io

import numpy as np
from PIL import Image

from services.look.pictures import (
    FIXED_REGIONS,
    MOST_WIDTH,
    OBJECT_REGIONS,
    depth_span,
    picture_of_colour,
    picture_of_depth,
    picture_of_projection,
    picture_of_regions,
)

VIRIDIS_ENDS = ((253, 231, 37), (68, 1, 84))
"""The last and the first colour of viridis, as its authors published them."""


def decoded(picture) -> np.ndarray:
    image = Image.open(io.BytesIO(picture.data))
    assert image.size == (picture.width, picture.height)
    return np.asarray(image.convert("RGB")).astype(int)


def test_near_is_the_bright_end_of_viridis_far_the_dark_one_and_no_depth_is_black():
    depth = np.zeros((48, 96))
    depth[:, 32:64], depth[:, 64:] = 1.0, 3.0
    shown = decoded(picture_of_depth(depth, (1.0, 3.0), "depth"))
    for column, color in ((8, (0, 0, 0)), (48, VIRIDIS_ENDS[0]), (88, VIRIDIS_ENDS[1])):
        assert np.abs(shown[24, column] - color).max() <= 6  # JPEG


def test_the_span_of_depth_leaves_out_what_is_unknown_and_rare():
    depth = np.concatenate([np.zeros(50), np.linspace(1.0, 2.0, 1001)])
    low, high = depth_span(depth)
    assert (round(low, 2), round(high, 2)) == (1.01, 1.99)
    assert depth_span(np.zeros(4)) == (0.0, 0.0)


def test_the_floor_takes_no_colours_from_what_stands_on_it():
    depth, regions = np.array([1.0, 1.5, 7.0, 7.5]), np.array([3, 2, 1, 1])
    low, high = depth_span(depth, regions)
    assert 1.0 <= low < high <= 1.5
    assert depth_span(depth, np.ones(4, int))[1] > 7.0


def test_every_region_has_its_own_colour():
    regions = np.repeat(np.arange(6, dtype=np.uint8), 4)[None].repeat(4, axis=0)
    shown = decoded(picture_of_regions(regions, "regions"))
    expected = [*FIXED_REGIONS, *OBJECT_REGIONS[:3]]
    assert [tuple(shown[0, 4 * i]) for i in range(6)] == expected


def test_what_was_projected_is_bright_over_the_dimmed_mirror_view():
    mirror = np.full((32, 64, 3), 200, np.uint8)
    projected = np.zeros_like(mirror)
    projected[:, 32:] = (20, 180, 60)
    shown = decoded(picture_of_projection(mirror, projected, "over"))
    assert np.abs(shown[16, 8] - 70).max() <= 3
    assert np.abs(shown[16, 56] - (20, 180, 60)).max() <= 6


def test_a_large_image_is_shrunk_and_a_small_one_kept():
    large = picture_of_colour(np.zeros((960, 1280, 3), np.uint8), "large")
    assert (large.width, large.height) == (MOST_WIDTH, MOST_WIDTH * 3 // 4)
    small = picture_of_colour(np.zeros((12, 16, 3), np.uint8), "small")
    assert (small.width, small.height) == (16, 12)


def test_the_address_holds_the_bytes_and_the_name_follows_from_them():
    picture = picture_of_colour(np.zeros((12, 16, 3), np.uint8), "small")
    kind, _, data = picture.inline.partition(",")
    assert kind == "data:image/jpeg;base64" and base64.b64decode(data) == picture.data
    assert picture.name != picture_of_colour(np.ones((12, 16, 3), np.uint8) * 9, "small").name
