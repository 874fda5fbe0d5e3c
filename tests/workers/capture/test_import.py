"""Imported recordings against the analytic scene that they show; frames paired, chosen, and those that are lost."""

import json

import cv2
import numpy as np
import pytest

from tests.workers.door.recordings import (
    BOARD,
    COLOR,
    COLOR_LENS,
    PERIOD_US,
    START_US,
    photograph,
    poses,
    recording,
    true_depth,
)
from workers.capture.board import marker_corners, open_dictionary
from workers.capture.detect import detect_markers
from workers.capture.folder import CaptureFile, CaptureFolder, open_folder, read_view
from workers.capture.import_recording import (
    Imported,
    Losses,
    choose_frames,
    describe_losses,
    import_recording,
    measure_frame,
    pair_frames,
)

ABOUT = CaptureFile(name="made-up", category="ball")
COUNT = 3
QUANTA_MM = 1.3
"""Half a millimetre of the recording, half a unit of the folder, and the former once more where a surface is steep."""


def imported(folder, data: bytes, views: int = 40) -> tuple[Imported, CaptureFolder]:
    (folder / "r.mkv").write_bytes(data)
    out = folder / "capture"
    out.mkdir()
    made = import_recording(folder / "r.mkv", out, ABOUT, BOARD, views)
    return made, open_folder(out)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Imported, CaptureFolder]:
    return imported(tmp_path_factory.mktemp("whole"), recording(COUNT))


def test_every_frame_becomes_a_view_with_its_time_and_the_recordings_camera(whole):
    made, folder = whole
    assert folder.numbers == tuple(range(COUNT))
    assert [view.color_us for view in made.views] == [START_US + i * PERIOD_US for i in range(COUNT)]
    assert (made.losses.dropped, made.losses.without_depth, made.losses.damaged, made.losses.cut) == (0, 0, 0, 0)
    assert json.loads((folder.path / "recording.json").read_text())["serial_number"] == "000123"
    for name, value in COLOR.model_dump().items():
        assert getattr(folder.camera.intrinsics, name) == pytest.approx(value, abs=1e-9)
    assert folder.camera.lens == pytest.approx(COLOR_LENS)
    assert folder.board == BOARD and folder.about == ABOUT
    stored = json.loads((folder.path / "camera.json").read_text())
    assert stored["pixel_centre"] == "0" and stored["cx"] == pytest.approx(COLOR.cx - 0.5)


def test_depth_is_the_scenes_in_the_colour_camera(whole):
    _, folder = whole
    for number, T in enumerate(poses(COUNT)):
        depth_mm = read_view(folder, number).depth.astype(np.float64)
        true, ball = true_depth("color", T)
        drawn, wide = ball.astype(np.uint8), np.ones((41, 41))
        edge = cv2.dilate(drawn, wide) - cv2.erode(drawn, wide) > 0
        seen, error = (depth_mm > 0) & ~edge, np.abs(depth_mm - true * 1000)
        assert error[seen & ~ball].max() < QUANTA_MM
        assert error[seen & ball].max() < QUANTA_MM + 1.0  # the sag of a triangle of 3 mm on the sphere's slope
        assert np.median(error[seen]) < 0.45
        assert (depth_mm > 0)[200:600, 400:900][~edge[200:600, 400:900]].mean() > 0.97
        near = cv2.dilate(drawn, np.ones((9, 9))) > 0  # the table that the sphere hides is hidden, and nothing floats
        assert (near & (depth_mm > 0) & (error > 20.0)).sum() < 0.06 * ball.sum()


def test_markers_of_an_imported_view_are_where_the_pose_puts_them(whole):
    _, folder = whole
    found = detect_markers(read_view(folder, 1).rgb, BOARD, open_dictionary(BOARD), folder.camera)
    T, k = np.linalg.inv(poses(COUNT)[1]), folder.camera.intrinsics
    matrix = np.array([[k.fx, 0, k.cx_opencv], [0, k.fy, k.cy_opencv], [0, 0, 1]])
    points = marker_corners(BOARD)[found.ids].reshape(-1, 3)
    at, _ = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], matrix, folder.camera.lens)
    miss = found.corners_px.reshape(-1, 2) - 0.5 - at[:, 0]
    assert len(found.ids) >= 25 and np.median(np.linalg.norm(miss, axis=1)) < 0.3
    assert np.abs(np.median(miss, axis=0)).max() < 0.1, "half a pixel would be another convention"


def test_other_colour_formats_show_the_same(tmp_path):
    for fourcc in ("BGRA", "NV12", "YUY2"):
        (tmp_path / fourcc).mkdir()
        _, folder = imported(tmp_path / fourcc, recording(1, fourcc))
        difference = np.abs(read_view(folder, 0).rgb.astype(int) - photograph(poses(1)[0]))
        assert np.median(difference) <= 2 and difference.mean() < (0.01 if fourcc == "BGRA" else 4.0)


def test_as_many_views_as_asked_are_taken_and_the_same_each_time(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    made, folder = imported(tmp_path / "a", recording(COUNT), views=2)
    _, again = imported(tmp_path / "b", recording(COUNT), views=2)
    assert made.frames == COUNT and len(made.views) == 2
    names = sorted(path.name for path in folder.path.iterdir())
    assert names == sorted(path.name for path in again.path.iterdir())
    assert all((folder.path / name).read_bytes() == (again.path / name).read_bytes() for name in names)


# ---------------------------------------------------------------------------------------------- pairs and losses

PERIOD = 33_333.0
TEN = (np.arange(10) * PERIOD).astype(np.int64)


def test_each_frame_gets_the_depth_less_than_half_a_period_away():
    own = {i: i for i in range(10)}
    for delay in (0.0, 160.0, -5_000.0, 12_000.0):
        assert pair_frames(TEN, (TEN + delay).astype(np.int64), PERIOD, delay) == own
    assert pair_frames(TEN, (TEN + 0.4 * PERIOD).astype(np.int64), PERIOD) == own
    assert pair_frames(TEN, (TEN + 0.6 * PERIOD).astype(np.int64), PERIOD) == {i: i - 1 for i in range(1, 10)}
    depth = np.delete(TEN, [3, 4, 9])
    assert pair_frames(TEN, depth, PERIOD) == {0: 0, 1: 1, 2: 2, 5: 3, 6: 4, 7: 5, 8: 6}
    assert pair_frames(TEN, depth[:0], PERIOD) == {} and pair_frames(TEN[:0], depth, PERIOD) == {}


def test_losses_are_told_in_numbers():
    assert describe_losses(Losses(0, 0, 0, 0)) == []
    told = "; ".join(describe_losses(Losses(3, 4, 5, 6)))
    assert all(word in told for word in ("about 6 frames", "3 frames are missing", "5 frames are damaged", "4 colour"))
    assert "interrupted and wrote no length: nobody knows" in describe_losses(Losses(0, 0, 0, None))[0]


# ------------------------------------- the choice of frames: a camera that moves, stands still, comes back and blurs


def filmed(seed, places, blurred):
    """Frames of 320 x 180 at horizontal places, pixels of a random texture; sensor noise is another in each frame."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.integers(0, 256, (5, 30)).astype(np.uint8), (2400, 400), interpolation=cv2.INTER_CUBIC)
    scene = (0.8 * coarse + 0.2 * rng.integers(0, 256, coarse.shape)).astype(np.uint8)
    noise, made = rng.normal(0, 2, (360, 320)), []
    for place, is_blurred in zip(places, blurred, strict=True):
        frame = scene[100:280, int(place) : int(place) + 320]
        frame, start = (cv2.blur(frame, (9, 1)) if is_blurred else frame), rng.integers(180)
        made.append(measure_frame(np.clip(frame + noise[start : start + 180], 0, 255).astype(np.uint8)))
    return made


def test_chosen_frames_cover_the_path_and_a_stand_counts_once():
    ways = [(0, 900, 60), (900, 900, 120), (900, 300, 40), (300, 2000, 80)]
    places = np.concatenate([np.linspace(*way) for way in ways])
    for seed in range(4):
        chosen = choose_frames(filmed(seed, places, np.zeros(len(places), bool)), 24)
        at = np.sort(places[chosen])
        assert len(chosen) == 24 and chosen == sorted(set(chosen))
        assert np.diff(at).max() < 250 and at[0] < 85 and at[-1] > 1915, "at most three times the even spacing"
        assert sum(60 <= i < 180 for i in chosen) <= 2, "40 % of the time is spent standing"


def test_blurred_frames_are_not_chosen_where_others_are_sharp():
    places = np.linspace(0, 2000, 300)
    for seed in range(3):
        blurred = np.random.default_rng(seed).random(300) < 0.6
        assert not blurred[choose_frames(filmed(seed, places, blurred), 30)].any()
    stretch = (np.arange(300) >= 100) & (np.arange(300) < 140)
    assert not stretch[choose_frames(filmed(1, places, stretch), 20)].any()


def test_all_frames_are_taken_where_there_are_not_more():
    measures = filmed(0, np.linspace(0, 500, 7), np.zeros(7, bool))
    assert choose_frames(measures, 7) == choose_frames(measures, 50) == list(range(7))
    assert len(choose_frames(measures, 6)) == 6, "even where few are the sharpest of their time"
    assert choose_frames([], 5) == []
    black = measure_frame(np.zeros((180, 320), np.uint8))
    assert black.sharpness == 0.0 and not black.look.any() and len(choose_frames([black] * 10, 4)) == 4
    frame = np.random.default_rng(0).integers(0, 256, (180, 320)).astype(np.uint8)
    darker = (frame * 0.5 + 20).astype(np.uint8)  # brightness and contrast do not change the look
    assert measure_frame(darker).look == pytest.approx(measure_frame(frame).look, abs=0.05)
