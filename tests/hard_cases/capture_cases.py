"""The table of hard cases for captures: how well cameras must be placed, or why they cannot be.

Four views around a board with a box on it, half the size of the Kinect's, depth with 2 mm of noise. What a case changes is
done to the files or to the images; what comes out is what `estimate_poses` says of the folder.
"""

import functools
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from schemas.base import Pose
from schemas.capture import CaptureCamera, CapturedView, CaptureEstimate
from schemas.job.captures import Board, Estimation
from tests.hard_cases.case import refuse
from tests.workers.capture.drawn import (
    HALF,
    draw_view,
    errors,
    hand_held,
    photograph,
    printed,
    surface_depth,
    true_corners,
)
from workers.capture.board import marker_corners
from workers.capture.folder import CaptureFile, open_folder, write_description, write_view
from workers.capture.reconstruct import estimate_poses, given_files
from workers.geometry.camera import look_at, orbit_pose

HOLD, FLAG = "must hold", "must flag view 0"
BOARD = Board()
ORBIT = tuple(hand_held(np.random.default_rng(0), 4))
Change = Callable[[CapturedView, Pose], CapturedView]
Spoil = Callable[[Path], None]


@dataclass(frozen=True, eq=False)
class CaptureCase:
    """One row: poses of the views, what is done to each view and to the folder, and how it must end.

    `bound` millimetres for the worst pose of a used view; `first` looks at view 0 alone. `words` must be in the reason.
    """

    name: str
    outcome: str
    bound: float = 0.5
    poses: Sequence[Pose] = ORBIT
    change: Change | None = None
    spoil: Spoil | None = None
    words: str = ""
    first: bool = False


def run(case: CaptureCase, path: Path, seed: int = 0) -> tuple[float | None, str, str]:
    """(worst error in mm, how it ended, the reason of view 0), with the seed of the noise.

    Raises CaptureError; asserts that nothing is nan.
    """
    write_description(path, CaptureFile(name="case"), CaptureCamera(HALF, np.zeros(8)), BOARD)
    for number, T in enumerate(case.poses):
        view = replace(drawn(T.tobytes(), seed), number=number)
        write_view(path, view if case.change is None else case.change(view, T))
    if case.spoil is not None:
        case.spoil(path)
    estimates = estimate_poses(given_files(open_folder(path)), Estimation())
    for estimate in estimates.by_name.values():
        assert_finite(estimate)
    views = estimates.estimate.views
    used = [view for view in (views[:1] if case.first else views) if view.status == "used"]
    reasons = "; ".join([*views[0].reasons, *estimates.estimate.notes])
    if not used:
        return None, FLAG, reasons
    placed = [(view.T_board_cam, case.poses[view.number]) for view in used if view.T_board_cam is not None]
    return max(errors(found, true)[0] for found, true in placed), HOLD, reasons


def assert_finite(estimate: CaptureEstimate) -> None:
    for view in estimate.views:
        numbers = [view.T_board_cam, view.covariance, view.reprojection_px, view.depth_mm]
        assert all(np.isfinite(values).all() for values in numbers if values is not None), view
        assert view.T_board_cam is not None or (view.status == "refused" and view.reasons)


@functools.cache
def drawn(pose_bytes: bytes, seed: int) -> CapturedView:
    """The view from a pose, drawn once."""
    T = np.frombuffer(pose_bytes).reshape(4, 4)
    return draw_view(0, T, np.random.default_rng(1 + seed), picture=_print())


@functools.cache
def _print() -> np.ndarray:
    return printed(BOARD)


# ------------------------------------------------------------------------------------------- what is done to a view


def only(ids: Sequence[int], numbers: Sequence[int] = (0, 1, 2, 3)) -> Change:
    """Paper over all other markers in the views of these numbers."""

    def change(view: CapturedView, T: Pose) -> CapturedView:
        rgb = view.rgb.copy()
        for marker in set(range(35)) - set(ids) if view.number in numbers else ():
            quad = marker_corners(BOARD)[marker]
            wide = quad + 0.15 * (quad - quad.mean(axis=0))
            cv2.fillConvexPoly(rgb, np.rint(true_corners(wide, T, HALF) - 0.5).astype(np.int32), (205, 205, 205))
        return replace(view, rgb=rgb)

    return change


def blurred(sigma_px: float, numbers: Sequence[int] = (0, 1, 2, 3)) -> Change:
    """Photographed anew out of focus."""

    def change(view: CapturedView, T: Pose) -> CapturedView:
        if view.number not in numbers:
            return view
        rgb = photograph(BOARD, T, HALF, np.random.default_rng(2), blur_px=sigma_px, picture=_print())
        return replace(view, rgb=rgb)

    return change


def exposed(times: float) -> Change:
    """Photographed anew with so much more light."""

    def change(view: CapturedView, T: Pose) -> CapturedView:
        rgb = photograph(BOARD, T, HALF, np.random.default_rng(2), exposure=times, picture=_print())
        return replace(view, rgb=rgb)

    return change


def without_depth(where: str) -> Change:
    """No depth on half of the board, on its markers, or anywhere."""

    def change(view: CapturedView, T: Pose) -> CapturedView:
        assert view.depth is not None
        depth = view.depth.copy()
        if where == "everywhere":
            depth[:] = 0
        elif where == "half":
            depth[:, : depth.shape[1] // 2] = 0
        else:
            hole = np.zeros(depth.shape, np.uint8)
            for quad in marker_corners(BOARD):
                cv2.fillConvexPoly(hole, np.rint(true_corners(quad, T, HALF) - 0.5).astype(np.int32), 1)
            depth[(hole > 0) & (surface_depth(T, HALF, box=False) * 1000 - depth < 15)] = 0
        return replace(view, depth=depth)

    return change


def mirrored(view: CapturedView, T: Pose) -> CapturedView:
    """A print seen in a mirror."""
    return replace(view, rgb=np.ascontiguousarray(view.rgb[:, ::-1]))


def marker_twice(view: CapturedView, T: Pose) -> CapturedView:
    """A copy of marker 0 lies where marker 1 was printed."""
    picture = _print().copy()
    picture[80:320, 440:680] = picture[80:320, 120:360]
    return replace(view, rgb=photograph(BOARD, T, HALF, np.random.default_rng(3), picture=picture))


# ----------------------------------------------------------------------------------------- what is done to the folder


def keys(name: str, **changes: object) -> Spoil:
    """Other values in a JSON file."""

    def spoil(path: Path) -> None:
        (path / name).write_text(json.dumps(json.loads((path / name).read_text()) | changes))

    return spoil


def take(name: str) -> Spoil:
    """A file is missing."""
    return lambda path: (path / name).unlink()


def cut(name: str) -> Spoil:
    """A file is half as long."""

    def spoil(path: Path) -> None:
        (path / name).write_bytes((path / name).read_bytes()[: (path / name).stat().st_size // 2])

    return spoil


def one_more(path: Path) -> None:
    """Depth of a view that nobody photographed."""
    shutil.copy(path / "depth_00000.png", path / "depth_00004.png")


def smaller(path: Path) -> None:
    """One photograph of another camera."""
    cv2.imwrite(str(path / "rgb_00002.png"), np.zeros((480, 640, 3), np.uint8))


TOP = look_at(np.array([0.0, 0, 0.8]), np.zeros(3))
LOW = tuple(orbit_pose(np.zeros(3), np.radians(10), yaw, 0.7) for yaw in (1.5, 1.6, 1.7, 1.8))
FAR = orbit_pose(np.zeros(3), np.radians(80), 0.3, 1.6)

CAPTURES = (
    CaptureCase("nothing wrong", HOLD),
    CaptureCase("one marker in one view", FLAG, change=only([3], [0]), words="uncertain", first=True),
    CaptureCase("one marker in every view", refuse("poses"), change=only([3]), words="uncertain"),
    CaptureCase("three markers in one view", HOLD, 4.0, change=only([3, 17, 31], [0]), first=True),
    CaptureCase("markers of one row only", HOLD, 5.0, change=only(range(7))),
    CaptureCase("board at 80 degrees", HOLD, 5.0, poses=LOW),
    CaptureCase("frontal board", HOLD, 1.0, poses=[TOP, *ORBIT[1:]], first=True),
    CaptureCase("small marker", FLAG, poses=[FAR, *ORBIT[1:]], change=only([3], [0]), words="ambiguous", first=True),
    CaptureCase("print seen in a mirror", refuse("poses"), change=mirrored, words="mirrored"),
    CaptureCase("wrong board", refuse("poses"), spoil=keys("board.json", rows=7, columns=5, width_m=0.4, height_m=0.6)),
    CaptureCase("a marker twice", HOLD, change=marker_twice),
    CaptureCase("one view out of focus", FLAG, change=blurred(12.0, [0]), words="no markers", first=True),
    CaptureCase("all views a little out of focus", HOLD, 2.5, change=blurred(1.2)),
    CaptureCase("all views out of focus", refuse("markers"), change=blurred(15.0), words="sharp"),
    CaptureCase("over-exposed, white at 255", HOLD, 4.0, change=exposed(3.0)),
    CaptureCase("over-exposed, black at 255", refuse("markers"), change=exposed(60.0), words="over-exposed"),
    CaptureCase("no depth on half of the board", HOLD, change=without_depth("half")),
    CaptureCase("no depth on the markers", HOLD, change=without_depth("markers")),
    CaptureCase("no depth anywhere", HOLD, change=without_depth("everywhere"), words="no depth"),
    CaptureCase("truncated photograph", refuse("unreadable"), spoil=cut("rgb_00001.png"), words="rgb_00001.png"),
    CaptureCase("truncated depth", refuse("unreadable"), spoil=cut("depth_00003.png"), words="depth_00003.png"),
    CaptureCase("photograph missing", refuse("counts"), spoil=take("rgb_00001.png"), words="depth_00001"),
    CaptureCase("camera.json missing", refuse("missing"), spoil=take("camera.json"), words="camera.json"),
    CaptureCase("more depth than photographs", refuse("counts"), spoil=one_more, words="depth_00004"),
    CaptureCase("photograph of another size", refuse("size"), spoil=smaller, words="640 x 480"),
    CaptureCase(
        "wrong dictionary",
        refuse("markers"),
        spoil=keys("board.json", dictionary="DICT_6X6_100"),
        words="markers of DICT_4X4_50",
    ),
    CaptureCase(
        "unknown dictionary", refuse("dictionary"), spoil=keys("board.json", dictionary="DICT_9X9"), words="DICT_9X9"
    ),
)
