import cv2
import numpy as np
import pytest

from schemas.errors import CorruptError
from services.look.pictures import metres_of, read_pair
from services.read.dataset_reader import file_reader, find_scene


def pair_of(store):
    stored = find_scene(store, 1)
    views, _ = next(stored.pairs(1))
    return stored, stored.scene(1)["category"], views


def test_the_images_of_a_pair_are_those_in_its_files(shown):
    stored, category, views = pair_of(shown)
    images = read_pair(file_reader(shown.read, stored), views)
    assert len(images) == 8 and not any(role == "aligned" for role, _ in images)
    folder = shown.root / category
    for key, name in ((("input", "depth"), "depth00002"), (("mirror", "depth"), "depth00003")):
        assert np.array_equal(images[key], cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED))
    projected = cv2.imread(str(folder / "RGBprojected00002.png"))[..., ::-1]
    assert np.array_equal(images["projected", "rgb"], projected)


def test_stored_depth_is_told_in_metres():
    assert metres_of(np.array([[0, 5000, 12_500]], np.uint16), {"depth_units_per_m": 5000.0}).tolist() == [[0, 1, 2.5]]


def test_a_damaged_image_is_told_by_name(shown):
    _stored, _, views = pair_of(shown)
    with pytest.raises(CorruptError, match=r"box/RGB00002\.png is not a PNG"):
        read_pair(lambda path: b"no PNG", views)
