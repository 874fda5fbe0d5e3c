import json

import cv2
import numpy as np
import pytest

from schemas.capture import CaptureCamera, CapturedView
from schemas.errors import CaptureError
from schemas.job.captures import Board
from schemas.scene.view import Intrinsics
from workers.capture.folder import (
    CaptureFile,
    derive_name,
    open_folder,
    read_board,
    read_pose,
    read_view,
    write_description,
    write_pose,
    write_view,
)
from workers.geometry.frames import pose, rotation_about

K = Intrinsics(width=40, height=30, fx=35.5, fy=35.25, cx=20.25, cy=15.75)
CAMERA = CaptureCamera(K, np.array([0.1, -0.05, 1e-3, 0, 0, 0, 0, 0]))
RNG = np.random.default_rng(0)
VIEW = CapturedView(
    0,
    RNG.integers(0, 256, (30, 40, 3), np.uint8),
    RNG.integers(0, 65536, (30, 40)).astype(np.uint16),
    RNG.random((30, 40)) < 0.5,
)


@pytest.fixture
def folder(tmp_path):
    write_description(tmp_path, CaptureFile(name="cup", category="mug"), CAMERA, Board(columns=3))
    write_view(tmp_path, VIEW)
    write_view(tmp_path, CapturedView(3, VIEW.rgb, None, None))
    return tmp_path


def change(folder, name, **keys):
    """A JSON file with keys changed, or taken out where None."""
    spec = json.loads((folder / name).read_text()) | keys
    (folder / name).write_text(json.dumps({key: value for key, value in spec.items() if value is not None}))


def refused(folder, reason, words, number=None):
    with pytest.raises(CaptureError, match=words) as error:
        open_folder(folder) if number is None else read_view(open_folder(folder), number)
    assert error.value.reason == reason


def test_what_was_written_is_read(folder):
    opened = open_folder(folder)
    assert opened.numbers == (0, 3) and opened.about.category == "mug" and opened.board.columns == 3
    assert opened.camera.intrinsics == K and np.array_equal(opened.camera.lens, CAMERA.lens) and opened.camera.has_lens
    view = read_view(opened, 0)
    assert all(np.array_equal(getattr(view, name), getattr(VIEW, name)) for name in ("rgb", "depth", "mask"))
    assert read_view(opened, 3).depth is None and read_view(opened, 3).mask is None
    assert read_board(folder / "board.json") == opened.board


@pytest.mark.parametrize(("pixel_centre", "cx"), [("0", 20.5), ("0.5", 20.0)])
def test_the_principal_point_is_where_its_pixel_convention_says(folder, pixel_centre, cx):
    change(folder, "camera.json", cx=20.0, pixel_centre=pixel_centre)
    assert open_folder(folder).camera.intrinsics.cx == cx


@pytest.mark.parametrize(
    ("name", "keys", "words"),
    [
        ("camera.json", {"fx": None}, "camera.json: fx: Field required"),
        ("camera.json", {"fx": -1}, "camera.json: fx: Input should be greater than 0"),
        ("camera.json", {"fx": float("nan")}, "camera.json is no JSON: NaN"),
        ("camera.json", {"cx": float("inf")}, "camera.json is no JSON: Infinity"),
        ("camera.json", {"pixel_centre": "1"}, "pixel_centre"),
        ("camera.json", {"distortion": [0.0] * 9}, "distortion"),
        ("camera.json", {"zoom": 2}, "zoom: Extra inputs"),
        ("board.json", {"marker_m": 0.5}, "columns|width_m is"),
        ("board.json", {"columns": "many"}, "columns"),
        ("board.json", {"measured_ruler_m": 2.0}, "measured_ruler_m over ruler_m is 10"),
        ("capture.json", {"category": "../etc"}, "category"),
        ("capture.json", {"frame": "left"}, "frame"),
    ],
)
def test_a_wrong_description_names_file_and_key(folder, name, keys, words):
    change(folder, name, **keys)
    refused(folder, "unreadable", words)


@pytest.mark.parametrize("text", [b"", b"{", b"[1]", b"\xff\xfe", b"[" * 100_000, b"null"])
@pytest.mark.parametrize("name", ["camera.json", "board.json", "capture.json"])
def test_no_text_that_is_no_description_is_more_than_refused(folder, name, text):
    (folder / name).write_bytes(text)
    refused(folder, "unreadable", name)


@pytest.mark.parametrize("name", ["camera.json", "board.json"])
def test_a_missing_description_is_named(folder, name):
    (folder / name).unlink()
    refused(folder, "missing", f"has no {name}")


def test_a_folder_instead_of_a_file_is_named(folder):
    (folder / "camera.json").unlink()
    (folder / "camera.json").mkdir()
    refused(folder, "unreadable", "camera.json cannot be read")


def test_a_folder_without_photographs_or_none_at_all_is_missing(tmp_path):
    refused(tmp_path, "missing", "has no rgb_00000.png")
    refused(tmp_path / "nothing", "missing", "is no folder")


@pytest.mark.parametrize("kind", ["depth", "mask"])
def test_different_counts_are_refused_with_the_view_that_lacks_its_photograph(folder, kind):
    (folder / f"{kind}_00007.png").write_bytes((folder / f"{kind}_00000.png").read_bytes())
    refused(folder, "counts", f"{kind}_00007 has no rgb_00007.png")


def test_a_pose_of_no_view_is_refused(folder):
    write_pose(folder / "correction_00009.txt", np.eye(4))
    refused(folder, "counts", "correction_00009 has no rgb_00009.png")


@pytest.mark.parametrize("name", ["rgb_0000.png", "rgb_000003.png"])
def test_a_number_of_other_width_is_refused_by_name(folder, name):
    (folder / name).write_bytes((folder / "rgb_00000.png").read_bytes())
    refused(folder, "name", f"{name} must be named rgb_0000")


@pytest.mark.parametrize("name", ["rgb_00000.png", "depth_00000.png", "mask_00000.png"])
@pytest.mark.parametrize("keep", [0.0, 0.01, 0.5, 0.98])
def test_a_truncated_image_is_refused(folder, name, keep):
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: int(keep * len(data))])
    refused(folder, "unreadable", f"{name} is no image that can be read", number=0)


@pytest.mark.parametrize("name", ["rgb_00000.png", "depth_00000.png"])
def test_an_image_with_a_wrong_byte_is_refused(folder, name):
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 0xFF
    (folder / name).write_bytes(bytes(data))
    refused(folder, "unreadable", name, number=0)


@pytest.mark.parametrize(
    ("name", "image", "words"),
    [
        ("rgb_00000.png", np.zeros((31, 40, 3), np.uint8), "40 x 31 of uint8"),
        ("depth_00000.png", np.zeros((30, 41), np.uint16), "41 x 30 of uint16"),
        ("depth_00000.png", np.zeros((30, 40), np.uint8), "uint8, 1 channels, and .*uint16"),
        ("depth_00000.png", np.zeros((30, 40, 3), np.uint16), "3 channels"),
        ("mask_00000.png", np.zeros((15, 20), np.uint8), "20 x 15"),
    ],
)
def test_an_image_of_another_size_or_type_is_refused_with_both(folder, name, image, words):
    cv2.imwrite(str(folder / name), image)
    refused(folder, "size", words, number=0)


def test_a_grey_photograph_is_read_as_grey_colour(folder):
    cv2.imwrite(str(folder / "rgb_00000.png"), np.full((30, 40), 77, np.uint8))
    assert (read_view(open_folder(folder), 0).rgb == 77).all()


def test_a_view_that_is_gone_is_missing(folder):
    opened = open_folder(folder)
    (folder / "rgb_00003.png").unlink()
    with pytest.raises(CaptureError, match=r"has no rgb_00003\.png"):
        read_view(opened, 3)


def test_poses_are_read_back_to_the_bit(tmp_path):
    T = pose(rotation_about(np.array([0.0, 0.6, 0.8]), 1.1), np.array([0.1, -1 / 3, 1e-17]))
    write_pose(tmp_path / "board_00000.txt", T)
    assert np.array_equal(read_pose(tmp_path / "board_00000.txt"), T)
    assert len((tmp_path / "board_00000.txt").read_text().splitlines()) == 4
    assert read_pose(tmp_path / "board_00001.txt") is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1 2 3",
        "a b c d\n" * 4,
        "nan 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1",
        "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1",
        "-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1",
        "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 2",
        "1 0 0 inf\n0 1 0 0\n0 0 1 0\n0 0 0 1",
    ],
)
def test_what_is_no_rigid_transform_is_refused(tmp_path, text):
    (tmp_path / "correction_00000.txt").write_text(text)
    with pytest.raises(CaptureError, match=r"correction_00000\.txt"):
        read_pose(tmp_path / "correction_00000.txt")


def test_names_are_made_of_any_words():
    assert derive_name("my cup (2)") == "my_cup_2_" and derive_name("///") == "capture"
    assert len(derive_name("x" * 200)) == 64
