"""Folders of captures drawn by arithmetic: a board with a grey box on it, with depth, at half the Kinect's size."""

from pathlib import Path

import numpy as np

from schemas.base import Pose
from schemas.capture import CaptureCamera, CapturedView
from schemas.job.captures import Board
from schemas.scene.view import Intrinsics
from tests.workers.capture.depths import DepthErrors, measured_depth, on_object
from tests.workers.capture.photographs import HALF, hand_held, photograph, printed
from workers.capture.folder import CaptureFile, write_description, write_view

QUIET = DepthErrors(sigma_m=0.002)


def draw_view(
    number: int, T: Pose, rng: np.random.Generator, *, board=None, k: Intrinsics = HALF, wrong=QUIET, box=True, **photo
) -> CapturedView:
    """One view's images; `photo` are settings of the photograph."""
    rgb = photograph(board or Board(), T, k, rng, **photo)
    if box:
        rgb[on_object(T, k)] = 90
    return CapturedView(number, rgb, measured_depth(T, k, wrong, rng, box=box), None)


def write_capture(path: Path, count=6, seed=0, *, board=None, k: Intrinsics = HALF, **view) -> list[Pose]:
    """The true poses of a capture that is written to `path`."""
    board, rng = board or Board(), np.random.default_rng(seed)
    path.mkdir(parents=True, exist_ok=True)
    write_description(path, CaptureFile(name=path.name), CaptureCamera(k, np.zeros(8)), board)
    poses = hand_held(rng, count)
    picture = view.pop("picture", None)
    picture = printed(board) if picture is None else picture
    for number, T in enumerate(poses):
        write_view(path, draw_view(number, T, rng, board=board, k=k, picture=picture, **view))
    return poses
