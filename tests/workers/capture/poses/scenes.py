"""Captures of corners and depth by arithmetic, with truth: OpenCV's projectPoints and planes, without any picture."""

import dataclasses

import cv2
import numpy as np

from schemas.base import Pose
from schemas.capture import CaptureCamera
from schemas.job.captures import Board, Estimation
from schemas.scene.view import Intrinsics
from tests.workers.capture.photographs import KINECT
from workers.capture.board.layout import marker_corners
from workers.capture.poses.markers import fit_markers
from workers.capture.poses.observation import Corners, Observation, Setup, rays_of_pixels
from workers.capture.poses.verdict import Evidence
from workers.geometry.frames import angle_between, invert

PINHOLE = CaptureCamera(KINECT, np.zeros(8))
LENS = CaptureCamera(KINECT, np.array([0.08, -0.05, 0.0006, -0.0004, 0.02, 0, 0, 0]))


def project(points, T_board_cam: Pose, camera: CaptureCamera):
    """[N, 2] pixels, centres at +0.5, by OpenCV."""
    k: Intrinsics = camera.intrinsics
    T = invert(T_board_cam)
    K = np.array([[k.fx, 0, k.cx - 0.5], [0, k.fy, k.cy - 0.5], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(points.reshape(-1, 1, 3), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, camera.lens)
    return pixels.reshape(-1, 2) + 0.5


def observe(
    T_board_cam: Pose,
    rng: np.random.Generator,
    *,
    number=0,
    camera=PINHOLE,
    ids=None,
    corner_px=0.2,
    board=None,
    scale=1.0,
) -> Observation:
    """The corners of the markers `ids` (default: all within the image), with normal noise."""
    board = board or Board()
    points = marker_corners(board)
    pixels = project(points.reshape(-1, 3) * scale, T_board_cam, camera).reshape(-1, 4, 2)
    k = camera.intrinsics
    seen = ((pixels > 3) & (pixels < np.array([k.width, k.height]) - 3)).all(axis=(1, 2))
    chosen = np.array([m for m in (range(len(points)) if ids is None else ids) if seen[m]], int)
    found = (
        pixels[chosen].reshape(-1, 2) + rng.normal(0, corner_px, (4 * len(chosen), 2))
        if len(chosen)
        else np.zeros((0, 2))
    )
    corners = Corners(
        points[chosen].reshape(-1, 3), found, rays_of_pixels(found, camera), np.repeat(chosen, 4), np.zeros(len(found))
    )
    return Observation(number, corners)


def with_corner_depth(
    view: Observation,
    T_board_cam: Pose,
    rng: np.random.Generator,
    *,
    sigma_m=0.002,
    bias_m=0.0,
    shift_m=(0, 0, 0),
    scale=1.0,
) -> Observation:
    """The view with the depth that a camera sees at its corners: the board's plane, shifted in camera axes, less a bias."""
    rays = np.column_stack([view.corners.rays, np.ones(len(view.corners.rays))])
    normal, height = T_board_cam[2, :3], T_board_cam[2, 3]
    z = (-height + normal @ np.asarray(shift_m)) / (rays @ normal) / scale - bias_m + rng.normal(0, sigma_m, len(rays))
    return dataclasses.replace(view, corners=dataclasses.replace(view.corners, depth_m=z))


def evidence_of(views: list[Observation], camera=PINHOLE, **spec) -> Evidence:
    """What the estimates are made from; `spec` are settings of the estimation."""
    estimation = Estimation(**spec)
    poses = [fit_markers(view, camera, estimation) for view in views]
    return Evidence.of(Setup(camera, Board(), estimation), views, poses)


def errors(estimated: Pose, true: Pose) -> tuple[float, float]:
    """(millimetres, degrees) between two poses."""
    mm = 1000 * float(np.linalg.norm(estimated[:3, 3] - true[:3, 3]))
    return mm, float(np.degrees(angle_between(estimated[:3, :3], true[:3, :3])))
