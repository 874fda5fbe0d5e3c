"""Corners of printed squares from straight lines along their edges in linear light: no detector, hence without its bias.

A pixel holds the mean light of its area, so the integral of a profile across an edge between two even greys gives the
edge's place whatever the grid. OpenCV's `cornerSubPix` pulls corners inwards by 0.1 to 0.3 px on ideally drawn squares too.
"""

import cv2
import numpy as np

from workers.capture.board.layout import marker_corners
from workers.geometry.colour import SRGB_STEPS
from workers.geometry.frames import invert

REACH_PX, STEP_PX = 3.0, 0.1
MOST_RESIDUAL_PX = 0.15
"""Edges whose points scatter more about their line are hidden, or cross a shadow."""


def grey(rgb):
    """[H, W] linear light of rgb [H, W, 3] uint8."""
    return (SRGB_STEPS[rgb] @ [0.2126, 0.7152, 0.0722]).astype(np.float32)


def project_opencv(camera, T_board_cam, points):
    """[N, 2] float64: OpenCV's own projection of points [N, 3] of the board, pixel centres at integers."""
    k = camera.intrinsics
    K = np.array([[k.fx, 0.0, k.cx_opencv], [0.0, k.fy, k.cy_opencv], [0.0, 0.0, 1.0]])
    T = invert(T_board_cam)
    return cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, camera.lens)[0][:, 0]


def corner_errors(rgb, camera, T_board_cam, board):
    """(errors [N, 2] px of measured corners against OpenCV's projection, the outward direction [N, 2] at each)."""
    light, errors, outwards = grey(rgb), [], []
    for corners in marker_corners(board):
        true = project_opencv(camera, T_board_cam, corners)
        measured = measure_square(light, true)
        if measured is not None:
            away = true - true.mean(axis=0)
            errors.append(measured - true)
            outwards.append(away / np.linalg.norm(away, axis=1, keepdims=True))
    return np.concatenate(errors), np.concatenate(outwards)


def measure_square(light, start):
    """[4, 2] corners of a dark square near `start` [4, 2], pixel centres at integers; None where its edges are not clear."""
    height, width = light.shape
    room = 2.0 * REACH_PX
    if (start < room).any() or (start > [width - room, height - room]).any():
        return None
    lines = [_fit_edge(light, a, b) for a, b in zip(start, np.roll(start, -1, axis=0), strict=True)]
    if any(line is None for line in lines):
        return None
    return np.array([np.linalg.solve(*_pair(lines[n - 1], lines[n])) for n in range(4)])


def _pair(one, other):
    return np.stack([one[0], other[0]]), np.array([one[1], other[1]])


def _fit_edge(light, a, b):
    """(unit normal [2], its product with the line's points) of the edge near a to b; None where it is not straight."""
    along = b - a
    length = np.linalg.norm(along)
    normal = np.array([along[1], -along[0]]) / length  # out of a square whose corners run clockwise in the image
    places = a + np.linspace(0.25, 0.75, max(int(length), 8))[:, None] * along
    s = np.arange(-REACH_PX, REACH_PX + 0.5 * STEP_PX, STEP_PX)
    at = (places[:, None] + s[:, None] * normal).astype(np.float32)
    profile = cv2.remap(light, at[..., 0].copy(), at[..., 1].copy(), cv2.INTER_LINEAR).astype(np.float64)
    ends = round(1.0 / STEP_PX)
    dark, bright = profile[:, :ends].mean(axis=1), profile[:, -ends:].mean(axis=1)
    if (bright - dark < 0.1).any():
        return None
    lit = np.trapezoid((profile - dark[:, None]) / (bright - dark)[:, None], dx=STEP_PX, axis=1)
    points = places + (REACH_PX - lit)[:, None] * normal
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle)
    if spread[1] / np.sqrt(len(points)) > MOST_RESIDUAL_PX:
        return None
    return axes[1], axes[1] @ middle
