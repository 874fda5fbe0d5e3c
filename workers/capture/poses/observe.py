"""What one view's images come to: its corners, its pose from markers, and samples of its depth."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from schemas.capture.view import Detection
from workers.capture.poses.markers import MarkerPose, fit_markers
from workers.capture.poses.object_patches import object_patches
from workers.capture.poses.observation import Observation, Setup, corners_of, no_patches
from workers.capture.poses.patches import board_patches, depth_at


def observe_view(
    detection: Detection, depth: NDArray[np.uint16] | None, setup: Setup
) -> tuple[Observation, MarkerPose]:
    """(the view's corners, and samples of its depth [H, W] where it has any; its pose from markers)."""
    seen = Observation(detection.number, corners_of(detection, setup.board, setup.camera))
    found = fit_markers(seen, setup.camera, setup.spec)
    return (seen if depth is None else _with_depth(seen, depth, detection, found, setup)), found


def _with_depth(
    seen: Observation, depth: NDArray[np.uint16], detection: Detection, found: MarkerPose, setup: Setup
) -> Observation:
    corner_depth = depth_at(depth, seen.corners.pixels, setup.camera.depth_units_per_m)
    on_board = board_patches(depth, detection, setup.board, setup.camera)
    on_object = no_patches()
    if found.fit is not None:
        on_object = object_patches(depth, found.fit.T_board_cam, on_board, setup)
    corners = dataclasses.replace(seen.corners, depth_m=corner_depth)
    return dataclasses.replace(seen, corners=corners, board_patches=on_board, object_patches=on_object, has_depth=True)
