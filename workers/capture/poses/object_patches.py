"""Pieces of the surface of what stands on the board, found by depth alone: no mask is needed."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.capture.view import CaptureCamera
from schemas.job.captures import Board, Estimation
from workers.capture.poses.observation import Patches, Setup
from workers.capture.poses.patches import sample_patches
from workers.capture.poses.rays import pixels_of_points, rays_of_pixels
from workers.geometry.frames import transform
from workers.geometry.spread import spread_evenly

SIDE_RAD = 0.012
"""Width of a patch, seen from the camera: 10 mm at 0.8 m."""
ACROSS = 5
"""Samples across a patch: registered depth is coarser than colour, and need not be read at every pixel."""
CLEARANCE_M = 0.01
TALLEST_M = 0.5
"""A patch lies so far above the board, as depth has the board."""
MIN_COSINE = 0.35
"""Patches that are seen at more than 70 degrees from their normal are left out: their depth is mixed."""
NOISY = 3.0
"""A patch with so many times the expected noise is no piece of plane."""
MOST = 200
"""Patches of one view that are kept, evenly over all that there are."""


def object_patches(depth: NDArray[np.uint16], T_board_cam: Pose, on_board: Patches, setup: Setup) -> Patches:
    """The object's patches in one view, at most MOST; heights are over the board's plane as this view's depth has it."""
    board, camera = setup.board, setup.camera
    side = max(ACROSS, round(SIDE_RAD * camera.intrinsics.fx))
    blocks = _blocks_over_board(T_board_cam, board, camera, side)
    if not len(blocks):
        return sample_patches(depth, np.zeros((0, 1, 2), np.int64), camera)
    normal, distance = _plane_by_depth(on_board, T_board_cam)
    middle = blocks + side // 2
    z = depth[middle[:, 1], middle[:, 0]] / camera.depth_units_per_m
    centres: Array = middle.astype(np.float64) + 0.5
    rays = rays_of_pixels(centres, camera)
    points = np.column_stack([rays, np.ones(len(rays))]) * z[:, None]
    with np.errstate(invalid="ignore"):
        blocks = blocks[(z > 0) & (points @ normal - distance > CLEARANCE_M)]
    reach = np.arange(0, side, side // ACROSS)
    offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    found = sample_patches(depth, blocks[:, None] + offsets, camera)
    keep = np.flatnonzero(_is_surface(found, normal, distance, setup.spec) & _over_board(found, T_board_cam, board))
    keep = keep[spread_evenly(len(keep), MOST)]
    return Patches(found.ray_z[keep], found.ray[keep], found.normal[keep], found.pixels[keep], found.sigma_m[keep])


def _blocks_over_board(T_board_cam: Pose, board: Board, camera: CaptureCamera, side: int) -> NDArray[np.int64]:
    """[B, 2]: upper left pixels of the blocks in the rectangle around the board and the space above it."""
    x, y = board.scale * board.width_m / 2, board.scale * board.height_m / 2
    space = np.array([[sx * x, sy * y, z] for sx in (-1, 1) for sy in (-1, 1) for z in (0.0, 0.5 * T_board_cam[2, 3])])
    pixels = pixels_of_points(space, T_board_cam, camera)
    k = camera.intrinsics
    size = np.array([k.width, k.height])
    if np.isfinite(pixels).all():
        low, high = np.clip(pixels.min(axis=0), 0, size), np.clip(pixels.max(axis=0), 0, size)
    else:
        low, high = np.zeros(2), size
    first = np.ceil(low / side).astype(np.int64)
    last = np.floor(high / side).astype(np.int64)
    columns, rows = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]))
    return np.stack([columns.ravel(), rows.ravel()], axis=1) * side


def _plane_by_depth(on_board: Patches, T_board_cam: Pose) -> tuple[Array, float]:
    """(normal [3] up, distance): the board's plane n p = d in camera axes; the pose tells the normal, depth the distance."""
    normal = T_board_cam[2, :3]
    if len(on_board):
        return normal, float(np.median(on_board.ray_z @ normal))
    return normal, float(-T_board_cam[2, 3])


def _is_surface(found: Patches, normal: Array, distance: float, spec: Estimation) -> NDArray[np.bool_]:
    height = found.ray_z @ normal - distance
    z = found.ray_z[:, 2]
    cosine = -(found.normal * found.ray).sum(axis=1) / np.linalg.norm(found.ray, axis=1)
    smooth = found.sigma_m <= NOISY * spec.depth_sigma_m * np.maximum(z, 0.5) ** 2
    return (height > CLEARANCE_M) & (height < TALLEST_M) & (cosine > MIN_COSINE) & smooth


def _over_board(found: Patches, T_board_cam: Pose, board: Board) -> NDArray[np.bool_]:
    half = 0.5 * board.scale * np.array([board.width_m, board.height_m])
    inside: NDArray[np.bool_] = np.abs(transform(T_board_cam, found.ray_z)[:, :2]) < half
    return inside[:, 0] & inside[:, 1]
