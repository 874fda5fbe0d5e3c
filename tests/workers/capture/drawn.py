"""Captures drawn by arithmetic, with truth: a print by OpenCV's own generator, corners by projectPoints, depth by planes."""

import dataclasses
import functools
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, CapturedView, Detection
from schemas.job.captures import Board, Estimation
from schemas.scene.view import Intrinsics
from workers.capture.board import marker_corners
from workers.capture.folder import CaptureFile, write_description, write_view
from workers.capture.poses.markers import Evidence, fit_markers, observe_view
from workers.capture.poses.observation import Corners, Observation, Setup
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import encode_srgb
from workers.geometry.frames import angle_between, invert, rotation_about, translation
from workers.geometry.pixels import rays_of_pixels

KINECT = Intrinsics(width=1920, height=1080, fx=912.37, fy=912.25, cx=961.94, cy=548.79)
HALF = Intrinsics(width=960, height=540, fx=456.185, fy=456.125, cx=480.97, cy=274.395)
QUARTER = Intrinsics(width=480, height=270, fx=228.0925, fy=228.0625, cx=240.485, cy=137.1975)
PINHOLE = CaptureCamera(KINECT, np.zeros(8))
LENS = CaptureCamera(KINECT, np.array([0.08, -0.05, 0.0006, -0.0004, 0.02, 0, 0, 0]))
PX_PER_M = 4000
GROUND_M = 0.02
"""Thickness of the board above the floor."""
BOX = (np.array([-0.05, -0.03, 0.0]), np.array([0.05, 0.03, 0.09]))
"""Two corners of a box that stands on the board, metres."""


# ---------------------------------------------------------------------------------------------- pictures


@functools.cache
def printed(board: Board) -> np.ndarray:
    """The board's print, PX_PER_M, by OpenCV's GridBoard: its frame is not ours, its picture is the same."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids = board.first_id + np.arange(board.columns * board.rows)
    grid = cv2.aruco.GridBoard((board.columns, board.rows), board.marker_m, board.gap_m, dictionary, ids)
    size = [round((n * (board.marker_m + board.gap_m) - board.gap_m) * PX_PER_M) for n in (board.columns, board.rows)]
    picture = grid.generateImage(size, marginSize=0, borderBits=1)
    whole = (board.width_m * PX_PER_M, board.height_m * PX_PER_M)
    x, y = (round((outer - inner) / 2) for outer, inner in zip(whole, size, strict=True))
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
    board: Board, T_board_cam: Pose, k: Intrinsics, rng: np.random.Generator, *, blur_px=0.6, exposure=1.0, picture=None
) -> np.ndarray:
    """[H, W, 3] uint8: the board on grey ground, four samples a pixel each way, lens blur in linear light, sRGB, noise."""
    picture, times = printed(board) if picture is None else picture, 4
    to_board = np.array([[1 / PX_PER_M, 0, -board.width_m / 2], [0, -1 / PX_PER_M, board.height_m / 2], [0, 0, 1]])
    from_edge = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV warps between pixel centres at integers
    H = np.linalg.inv(from_edge) @ np.diag([times, times, 1.0]) @ homography(T_board_cam, k) @ to_board @ from_edge
    size = (k.width * times, k.height * times)
    large = cv2.warpPerspective(picture, H, size, borderMode=cv2.BORDER_CONSTANT, borderValue=110)
    light = 0.03 + 0.57 * cv2.resize(large, (k.width, k.height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    gray = 255 * encode_srgb(exposure * cv2.GaussianBlur(light, (0, 0), blur_px)) + rng.normal(0, 2.5, light.shape)
    return np.repeat(np.clip(np.rint(gray), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def true_corners(board_points: Array, T_board_cam: Pose, k: Intrinsics) -> Array:
    """[N, 2] pixels, centres at +0.5, of points [N, 3] on the board's plane."""
    p = np.column_stack([board_points[:, :2], np.ones(len(board_points))]) @ homography(T_board_cam, k).T
    return p[:, :2] / p[:, 2:]


# ---------------------------------------------------------------------------------------------- depth


@dataclass(frozen=True, eq=False)
class DepthErrors:
    """What is wrong with depth: sigma at 1 m (grows with z squared), bias, and a wrong place of the depth camera.

    `wave_m` is the height of a wave of the error along z, 0.25 m long, and of another across the image.
    """

    sigma_m: float = 0.0
    bias_m: float = 0.0
    shift_m: Array = field(default_factory=lambda: np.zeros(3))
    wave_m: float = 0.0


@functools.cache
def rays_of(k: Intrinsics) -> Array:
    """[H W, 3]: through the pixels' centres, z = 1."""
    v, u = np.mgrid[: k.height, : k.width]
    return np.stack([(u + 0.5 - k.cx) / k.fx, (v + 0.5 - k.cy) / k.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)


def surface_depth(T_board_cam: Pose, k: Intrinsics, *, box=True, shift_m=(0.0, 0.0, 0.0), scale=1.0) -> Array:
    """[H, W] metres: z of board, floor and box by intersection with planes; `shift_m` moves the surface in camera axes."""
    T = T_board_cam @ invert(translation(*shift_m))
    rays = rays_of(k)
    origin, direction = T[:3, 3], rays @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.full(len(rays), np.inf)
        for height in (0.0, -GROUND_M):
            t = (height - origin[2]) / direction[:, 2]
            x, y = (origin[i] + t * direction[:, i] for i in (0, 1))
            inside = (np.abs(x) < scale * 0.3) & (np.abs(y) < scale * 0.2) if height == 0 else True
            depth = np.where((t > 0) & inside & (t < depth), t, depth)
        if box:
            low, high = (BOX[0] - origin) / direction, (BOX[1] - origin) / direction
            enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
            depth = np.where((enter < leave) & (enter > 0) & (enter < depth), enter, depth)
    return np.where(np.isfinite(depth), depth, 0.0).reshape(k.height, k.width)


def measured_depth(
    T_board_cam: Pose, k: Intrinsics, wrong: DepthErrors, rng: np.random.Generator, *, box=True, scale=1.0, grain_px=2
) -> np.ndarray:
    """[H, W] uint16 millimetres. Noise is equal over pieces of `grain_px` pixels, as a coarser depth camera's is."""
    z = surface_depth(T_board_cam, k, box=box, shift_m=wrong.shift_m, scale=scale)
    grains = rng.standard_normal((k.height // grain_px + 1, k.width // grain_px + 1))
    noise = grains.repeat(grain_px, axis=0).repeat(grain_px, axis=1)[: k.height, : k.width]
    across = np.sin(np.arange(k.width) * 2 * np.pi / (0.3 * k.width))
    wave = wrong.wave_m * (np.sin(2 * np.pi * z / 0.25) + across)
    read = z - wrong.bias_m + wave + wrong.sigma_m * z**2 * noise
    return np.where(z > 0, np.rint(np.clip(read, 0, 60) * 1000), 0).astype(np.uint16)


# ---------------------------------------------------------------------------------------------- views and folders


def project(points, T_board_cam, camera):
    """[N, 2] pixels, centres at +0.5, of points [N, 3] of the board, by OpenCV."""
    k, T = camera.intrinsics, invert(T_board_cam)
    K = np.array([[k.fx, 0, k.cx - 0.5], [0, k.fy, k.cy - 0.5], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(points.reshape(-1, 1, 3), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, camera.lens)
    return pixels.reshape(-1, 2) + 0.5


def observe(T, rng, *, number=0, camera=PINHOLE, ids=None, corner_px=0.2, scale=1.0):
    """The corners of the markers `ids` (default: all within the image), with normal noise."""
    points = marker_corners(Board())
    pixels = project(points.reshape(-1, 3) * scale, T, camera).reshape(-1, 4, 2)
    k = camera.intrinsics
    seen = ((pixels > 3) & (pixels < np.array([k.width, k.height]) - 3)).all(axis=(1, 2))
    chosen = np.array([m for m in (range(len(points)) if ids is None else ids) if seen[m]], int)
    found = pixels[chosen].reshape(-1, 2) + rng.normal(0, corner_px, (4 * len(chosen), 2))
    rays = rays_of_pixels(found, k, camera.lens)
    return Observation(
        number, Corners(points[chosen].reshape(-1, 3), found, rays, np.repeat(chosen, 4), np.zeros(len(found)))
    )


def with_pixels(view: Observation, pixels: Array, camera: CaptureCamera = PINHOLE) -> Observation:
    """The view with its corners at other pixels, which are read with this camera."""
    rays = rays_of_pixels(pixels, camera.intrinsics, camera.lens)
    return dataclasses.replace(view, corners=dataclasses.replace(view.corners, pixels=pixels, rays=rays))


def with_corner_depth(
    view: Observation, T: Pose, rng: np.random.Generator, *, sigma_m=0.002, bias_m=0.0
) -> Observation:
    """The view with the depth that a camera sees at its corners: the board's plane, less a bias."""
    rays = np.column_stack([view.corners.rays, np.ones(len(view.corners.rays))])
    z = -T[2, 3] / (rays @ T[2, :3]) - bias_m + rng.normal(0, sigma_m, len(rays))
    return dataclasses.replace(view, corners=dataclasses.replace(view.corners, depth_m=z))


def evidence_of(views: list[Observation]) -> Evidence:
    """What the estimates are made from."""
    poses = [fit_markers(view, PINHOLE) for view in views]
    return Evidence.of(Setup(PINHOLE, Board(), Estimation()), views, poses)


def errors(estimated: Pose, true: Pose) -> tuple[float, float]:
    """(millimetres, degrees) between two poses."""
    mm = 1000 * float(np.linalg.norm(estimated[:3, 3] - true[:3, 3]))
    return mm, float(np.degrees(angle_between(estimated[:3, :3], true[:3, :3])))


@dataclass(frozen=True, eq=False)
class Virtual:
    """How a virtual capture is made; `few` are numbers of views that see only the markers `few_ids`."""

    views: int = 12
    seed: int = 0
    wrong: DepthErrors = field(default_factory=lambda: DepthErrors(sigma_m=0.003))
    print_scale: float = 1.0
    few: tuple[int, ...] = ()
    few_ids: tuple[int, ...] = ()
    k: Intrinsics = QUARTER
    """A quarter of the Kinect's size, with a quarter of its error of a corner: the same accuracy in little time."""

    @property
    def corner_px(self) -> float:
        """0.2 at the Kinect's full size."""
        return 0.2 * self.k.fx / KINECT.fx


def make(virtual: Virtual, **spec) -> tuple[list[Pose], Evidence]:
    """(true T_board_cam, what the estimates are made from)."""
    rng = np.random.default_rng(virtual.seed)
    truth = hand_held(rng, virtual.views)
    camera = CaptureCamera(virtual.k, np.zeros(8))
    setup = Setup(camera, Board(), Estimation(corner_px=virtual.corner_px, **spec))
    seen = [one_view(number, T, virtual, setup, rng) for number, T in enumerate(truth)]
    return truth, Evidence.of(setup, [o for o, _ in seen], [m for _, m in seen])


def one_view(number: int, T: Pose, virtual: Virtual, setup: Setup, rng: np.random.Generator):
    """(observation, pose from markers) of one view; markers behind the box are not seen."""
    scale = virtual.print_scale
    corners = observe(T, rng, camera=setup.camera, scale=scale, corner_px=virtual.corner_px).corners
    depth = measured_depth(T, virtual.k, virtual.wrong, rng, scale=scale, grain_px=1)
    ids = np.unique(corners.markers)
    hidden = [9, 10, 11, 16, 17, 18, 23, 24, 25]
    chosen = np.isin(ids, virtual.few_ids) if number in virtual.few else ~np.isin(ids, hidden)
    return observe_view(Detection(number, ids[chosen], corners.pixels.reshape(-1, 4, 2)[chosen]), depth, setup)


def median_errors(estimate, truth, numbers=None):
    """(millimetres, degrees), medians over the views that have a pose, or over those of these numbers."""
    views = [v for v in estimate.views if v.T_board_cam is not None and (numbers is None or v.number in numbers)]
    mm, degrees = np.median([errors(v.T_board_cam, truth[v.number]) for v in views], axis=0)
    return float(mm), float(degrees)


def draw_view(
    number: int, T: Pose, rng: np.random.Generator, *, board: Board | None = None, box=True, **photo
) -> CapturedView:
    """One view's images at half the Kinect's size, a grey box on the board; `photo` are settings of the photograph."""
    rgb = photograph(board or Board(), T, HALF, rng, **photo)
    if box:
        z = surface_depth(T, HALF)
        rgb[(z > 0) & (z < surface_depth(T, HALF, box=False) - 1e-6)] = 90
    return CapturedView(number, rgb, measured_depth(T, HALF, DepthErrors(sigma_m=0.002), rng, box=box), None)


def write_capture(path: Path, count=6, *, board: Board | None = None, box=True) -> list[Pose]:
    """The true poses of a capture that is written to `path`."""
    board, rng = board or Board(), np.random.default_rng(0)
    path.mkdir(parents=True, exist_ok=True)
    write_description(path, CaptureFile(name=path.name), CaptureCamera(HALF, np.zeros(8)), board)
    poses = hand_held(rng, count)
    for number, T in enumerate(poses):
        write_view(path, draw_view(number, T, rng, board=board, box=box))
    return poses
