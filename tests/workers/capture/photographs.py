"""Pictures of a board drawn by OpenCV's own generator and a homography, supersampled: the oracle for detection."""

import cv2
import numpy as np

from schemas.base import Array, Pose
from schemas.job.captures import Board
from schemas.scene.view import Intrinsics
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import encode_srgb
from workers.geometry.frames import invert, rotation_about

KINECT = Intrinsics(width=1920, height=1080, fx=912.37, fy=912.25, cx=961.94, cy=548.79)
HALF = Intrinsics(width=960, height=540, fx=456.185, fy=456.125, cx=480.97, cy=274.395)
QUARTER = Intrinsics(width=480, height=270, fx=228.0925, fy=228.0625, cx=240.485, cy=137.1975)
PX_PER_M = 4000


def printed(board: Board) -> np.ndarray:
    """The board's print, PX_PER_M, by OpenCV's GridBoard: its frame is not ours, its picture is the same."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids = board.first_id + np.arange(board.columns * board.rows)
    grid = cv2.aruco.GridBoard((board.columns, board.rows), board.marker_m, board.gap_m, dictionary, ids)
    size = [round((n * (board.marker_m + board.gap_m) - board.gap_m) * PX_PER_M) for n in (board.columns, board.rows)]
    picture = grid.generateImage(size, marginSize=0, borderBits=1)
    x, y = (
        round((whole * PX_PER_M - inner) / 2)
        for whole, inner in zip((board.width_m, board.height_m), size, strict=True)
    )
    return cv2.copyMakeBorder(picture, y, y, x, x, cv2.BORDER_CONSTANT, value=255)


def hand_held(rng: np.random.Generator, count: int, distance_m=(0.6, 1.0), inclination_rad=(0.5, 1.2)) -> list[Pose]:
    """T_board_cam of views around the board with a roll of 12 degrees (one sigma)."""
    poses = []
    for number in range(count):
        centre = np.array([*rng.normal(0, 0.02, 2), 0.03])
        yaw = 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / count
        T = orbit_pose(centre, rng.uniform(*inclination_rad), yaw, rng.uniform(*distance_m))
        T[:3, :3] = T[:3, :3] @ rotation_about(np.array([0.0, 0.0, 1.0]), np.radians(rng.normal(0, 12)))
        poses.append(T)
    return poses


def homography(T_board_cam: Pose, k: Intrinsics) -> Array:
    """[3, 3]: board (x, y, 1) in metres to pixels with centres at +0.5."""
    T = invert(T_board_cam)
    K = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1.0]])
    return K @ np.column_stack([T[:3, 0], T[:3, 1], T[:3, 3]])


def photograph(
    board: Board,
    T_board_cam: Pose,
    k: Intrinsics,
    rng: np.random.Generator,
    *,
    blur_px=0.6,
    noise=2.5,
    exposure=1.0,
    picture=None,
) -> np.ndarray:
    """[H, W, 3] uint8: the board on grey ground, four samples a pixel each way, lens blur in linear light, sRGB, noise."""
    picture, times = printed(board) if picture is None else picture, 4
    to_board = np.array([[1 / PX_PER_M, 0, -board.width_m / 2], [0, -1 / PX_PER_M, board.height_m / 2], [0, 0, 1]])
    from_edge = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV warps between pixel centres at integers
    H = np.linalg.inv(from_edge) @ np.diag([times, times, 1.0]) @ homography(T_board_cam, k) @ to_board @ from_edge
    size = (k.width * times, k.height * times)
    large = cv2.warpPerspective(
        picture, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110
    )
    light = 0.03 + 0.57 * cv2.resize(large, (k.width, k.height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    light = exposure * cv2.GaussianBlur(light, (0, 0), blur_px)
    gray = 255 * encode_srgb(light) + rng.normal(0, noise, light.shape)
    return np.repeat(np.clip(np.rint(gray), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def true_corners(board_points: Array, T_board_cam: Pose, k: Intrinsics) -> Array:
    """[N, 2] pixels, centres at +0.5, of points [N, 3] on the board's plane."""
    p = np.column_stack([board_points[:, :2], np.ones(len(board_points))]) @ homography(T_board_cam, k).T
    return p[:, :2] / p[:, 2:]
