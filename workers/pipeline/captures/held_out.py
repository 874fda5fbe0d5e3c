"""Views of a simulated capture that were not photographed: what synthesised views are compared with."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.base import Array, Pose
from schemas.capture.view import CaptureCamera, CapturedView
from schemas.job.captures import Board
from schemas.scene.view import Camera
from workers.capture.simulate.effects import ASKED
from workers.capture.simulate.lens import opencv_lens
from workers.capture.simulate.path import plan_path
from workers.geometry.colour import encode_codes
from workers.pipeline.captures.photograph import Studio, draw_labels, take_light
from workers.scene.plan import Stream
from workers.store.capture_folder import CaptureFile, write_description, write_pose, write_view

VIEWS = 3

DEPTH_UNITS_PER_M = 10_000.0
"""Finer than a capture's, so that rounding is no part of an error: 0.1 mm, up to 6.5 m."""


def write_held_out(studio: Studio, board: Board, target: Array, path: Path) -> None:
    """Write `VIEWS` exact views to `path`, a new folder of the same layout as a capture.

    Their poses are drawn as those of a path around `target` [3], board frame, and stand in board_00000.txt. They are pictures
    of the same things without the effects of any sensor or lens: depth and mask are those of the pixel centres.
    """
    path.mkdir(parents=True)
    exact = without_sensors(studio)
    spec = studio.simulate.model_copy(update={"views": VIEWS})
    for number, T_board_cam in enumerate(plan_path(spec, target, studio.chance.stream(Stream.HELD_OUT))):
        write_view(path, take_exact(exact, number, T_board_cam))
        write_pose(path / f"board_{number:05d}.txt", T_board_cam)
    camera = CaptureCamera(studio.rig.color, opencv_lens(None), DEPTH_UNITS_PER_M)
    write_description(path, CaptureFile(name="held-out"), camera, board)


def without_sensors(studio: Studio) -> Studio:
    """The studio with the same things, seen by ideal cameras."""
    simulate = studio.simulate.model_copy(update=dict.fromkeys(ASKED))
    return replace(studio, simulate=simulate, drawn_color=studio.rig.color, lookup=None)


def take_exact(studio: Studio, number: int, T_board_cam: Pose) -> CapturedView:
    """One exact view, its depth in units of `DEPTH_UNITS_PER_M`."""
    T_world_cam = studio.T_world_board @ T_board_cam
    depth_m, mask = draw_labels(studio, Camera(studio.rig.color, T_world_cam))
    depth = np.rint(np.clip(depth_m * DEPTH_UNITS_PER_M, 0.0, 65_535.0)).astype(np.uint16)
    depth[depth == 65_535] = 0
    return CapturedView(number, encode_codes(take_light(studio, number, T_world_cam)), depth, mask)
