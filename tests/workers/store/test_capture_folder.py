"""Folders as the article lays them out, written here by other means, and what a folder says of files that it cannot use."""

import json

import cv2
import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.capture.view import CaptureCamera, CapturedView
from schemas.errors import CaptureError
from schemas.job.captures import Board
from schemas.scene.camera import Intrinsics
from workers.geometry.frames import pose, rotation_about
from workers.store.capture_folder import (
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

KINECT = {"width": 48, "height": 27, "fx": 22.81, "fy": 22.8, "cx": 23.5, "cy": 13.2, "pixel_centre": "0"}
RNG = np.random.default_rng(4)
RGB = RNG.integers(0, 256, (27, 48, 3)).astype(np.uint8)
DEPTH = RNG.integers(0, 3000, (27, 48)).astype(np.uint16)
MASK = RNG.random((27, 48)) > 0.5


@pytest.fixture
def article(tmp_path):
    """The article's layout by OpenCV and text, without this project's writer; view 3 has an image alone."""
    path = tmp_path / "box 1"
    path.mkdir()
    for number in (0, 3, 12):
        assert cv2.imwrite(str(path / f"rgb_{number:05d}.png"), RGB[:, :, ::-1])
    for number in (0, 12):
        assert cv2.imwrite(str(path / f"depth_{number:05d}.png"), DEPTH)
        assert cv2.imwrite(str(path / f"mask_{number:05d}.png"), MASK.astype(np.uint8) * 255)
        for name in ("board", "correction"):
            (path / f"{name}_{number:05d}.txt").write_text("0 -1 0 0.1\n1 0 0 -2e-1\n0 0 1 0.75\n0 0 0 1\n")
    (path / "camera.json").write_text(json.dumps(KINECT))
    (path / "board.json").write_text("{}")
    return path


def test_the_article_s_folder_is_read(article):
    folder = open_folder(article)
    assert folder.numbers == (0, 3, 12)
    assert (folder.about.name, folder.about.category) == ("box_1", "object")
    assert folder.board == Board()
    k = folder.camera.intrinsics
    assert (k.cx, k.cy) == pytest.approx((24.0, 13.7)) and (k.cx_opencv, k.cy_opencv) == pytest.approx((23.5, 13.2))
    assert folder.camera.depth_units_per_m == 1000.0 and not folder.camera.has_lens
    view = read_view(folder, 12)
    assert np.array_equal(view.rgb, RGB) and np.array_equal(view.depth, DEPTH) and np.array_equal(view.mask, MASK)
    bare = read_view(folder, 3)
    assert np.array_equal(bare.rgb, RGB) and bare.depth is None and bare.mask is None
    for name in ("board", "correction"):
        T = read_pose(article / f"{name}_00012.txt")
        assert T.tolist() == [[0, -1, 0, 0.1], [1, 0, 0, -0.2], [0, 0, 1, 0.75], [0, 0, 0, 1]]
        assert read_pose(article / f"{name}_00003.txt") is None


def test_pixel_centres_at_a_half_are_read_as_they_are(article):
    (article / "camera.json").write_text(
        json.dumps(KINECT | {"pixel_centre": "0.5", "distortion": [0.1, 0, 0, 0, 0.2]})
    )
    camera = open_folder(article).camera
    assert camera.intrinsics.cx == 23.5 and camera.lens.tolist() == [0.1, 0, 0, 0, 0.2, 0, 0, 0]


def test_what_is_written_is_read_back(tmp_path):
    k = Intrinsics(width=48, height=27, fx=22.81, fy=22.8, cx=24.0, cy=13.7)
    camera = CaptureCamera(k, frozen_array([0.1, -0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6]))
    board, about = Board(columns=4, measured_ruler_m=0.199), CaptureFile(name="can", category="can", licence="CC0")
    write_description(tmp_path, about, camera, board)
    write_view(tmp_path, CapturedView(100_000, RGB, DEPTH, MASK))
    folder = open_folder(tmp_path)
    assert (folder.about, folder.board, folder.numbers) == (about, board, (100_000,))
    assert folder.camera.lens.tolist() == camera.lens.tolist()
    assert folder.camera.intrinsics.cx == pytest.approx(24.0, abs=1e-12)
    assert np.array_equal(read_view(folder, 100_000).depth, DEPTH)
    assert read_board(tmp_path / "board.json") == board


@pytest.mark.parametrize("seed", range(5))
def test_a_pose_reads_back_to_the_same_doubles(tmp_path, seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    T = pose(rotation_about(axis / np.linalg.norm(axis), 2.0), rng.normal(size=3))
    write_pose(tmp_path / "t.txt", T)
    assert np.array_equal(read_pose(tmp_path / "t.txt"), T)


NO_POSES = [
    "",
    "1 0 0 0",
    "a b c d\n" * 4,
    "1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1",
    "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1",
    "1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1",
]


@pytest.mark.parametrize("words", NO_POSES)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_a_pose_that_is_none_is_named(tmp_path, words):
    (tmp_path / "t.txt").write_text(words)
    with pytest.raises(CaptureError, match=r"t\.txt"):
        read_pose(tmp_path / "t.txt")


def broken(path, name: str, content: bytes | None) -> None:
    if content is None:
        (path / name).unlink()
    else:
        (path / name).write_bytes(content)


def read_all(path) -> None:
    folder = open_folder(path)
    for number in folder.numbers:
        read_view(folder, number)


PNG_8_BIT = cv2.imencode(".png", MASK.astype(np.uint8))[1].tobytes()
BROKEN = [
    ("camera.json", None, "has no camera.json"),
    ("camera.json", b"{", "no JSON"),
    ("camera.json", json.dumps(KINECT | {"fx": 0}).encode(), "fx"),
    ("camera.json", json.dumps(KINECT | {"pixel_centre": "1"}).encode(), "pixel_centre"),
    ("board.json", b'{"columns": 30}', "width_m"),
    ("capture.json", b'{"name": "a b"}', "name"),
    ("rgb_00003.png", b"", "no image that can be read"),
    ("depth_00000.png", PNG_8_BIT, "uint8"),
    ("mask_00012.png", cv2.imencode(".png", np.zeros((5, 5), np.uint8))[1].tobytes(), "5 x 5"),
]


@pytest.mark.parametrize(("name", "content", "told"), BROKEN, ids=[f"{name}: {told}" for name, _, told in BROKEN])
def test_a_file_that_cannot_be_used_is_named(article, name, content, told):
    broken(article, name, content)
    with pytest.raises(CaptureError, match=told) as caught:
        read_all(article)
    assert name in caught.value.detail


def test_a_folder_without_images_says_how_they_are_named(tmp_path):
    (tmp_path / "rgb_1.png").touch()
    (tmp_path / "rgb_000001.png").touch()
    with pytest.raises(CaptureError, match=r"rgb_00000\.png"):
        open_folder(tmp_path)
    with pytest.raises(CaptureError, match="no folder"):
        open_folder(tmp_path / "none")


@pytest.mark.parametrize(
    ("words", "name"), [("mug", "mug"), ("my mug (2)", "my_mug_2_"), ("._x", "x"), ("", "capture"), ("ü", "capture")]
)
def test_any_words_give_a_name(words, name):
    assert derive_name(words) == name == CaptureFile(name=name).name
