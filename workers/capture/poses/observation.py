"""What one view observes: rays through pixels, corners, and samples of depth on the board and on what stands on it.

A piece of plane has an inverse depth that is affine in the ray (x, y): 1 / z = a x + b y + c, with the plane's normal
along (a, b, c). So one robust linear fit gives the piece's middle, its normal and its noise.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, Detection
from schemas.job.captures import Board, Estimation
from workers.capture.board import TOUCHING_M, Geometry, board_geometry
from workers.capture.detect import unbend_corners
from workers.geometry.camera import spread_evenly
from workers.geometry.frames import invert, transform
from workers.geometry.pixels import project_points, rays_of_pixels


def pixels_of_points(points_board: Array, T_board_cam: Pose, camera: CaptureCamera) -> Array:
    """[N, 2] float64: stored pixels, centres at +0.5, of board points [N, 3]; nan behind the camera."""
    T = invert(T_board_cam)
    return project_points(points_board @ T[:3, :3].T + T[:3, 3], camera.intrinsics, camera.lens)


@dataclass(frozen=True, eq=False)
class Corners:
    """The corners found in one view.

    board [K, 3] metres, where they lie on the board; pixels [K, 2] as stored, centres at +0.5; rays [K, 2] (x / z, y / z);
    markers [K] ids, -1 for a chessboard's; depth_m [K]: depth measured around the corner, 0 where there is none.
    """

    board: Array
    pixels: Array
    rays: Array
    markers: NDArray[np.int64]
    depth_m: Array


@dataclass(frozen=True, eq=False)
class Patches:
    """Small pieces of surface measured by depth, P of them.

    ray_z [P, 3]: mean of ray z, metres; ray [P, 3]: mean of the rays (x, y, 1): with these a correction of depth by scale and
    offset is exact; normal [P, 3]: unit, towards the camera, camera axes; sigma_m [P]: standard deviation of a pixel about the
    patch's own plane.
    """

    ray_z: Array
    ray: Array
    normal: Array
    sigma_m: Array

    def __len__(self) -> int:
        return len(self.ray_z)

    def __getitem__(self, kept: NDArray[np.generic]) -> "Patches":
        return Patches(self.ray_z[kept], self.ray[kept], self.normal[kept], self.sigma_m[kept])


def no_patches() -> Patches:
    """None at all."""
    none = np.zeros((0, 3))
    return Patches(none, none, none, np.zeros(0))


@dataclass(frozen=True, eq=False)
class Observation:
    """One view: its corners, its depth on the board's markers and on the object; `manual_T_board_cam` where somebody gave one."""

    number: int
    corners: Corners
    board_patches: Patches = field(default_factory=no_patches)
    object_patches: Patches = field(default_factory=no_patches)
    manual_T_board_cam: Pose | None = None
    given_by: str = ""
    """Where the pose that was given is from, in words."""
    is_cluttered: bool = False
    """Whether patches of things that are no part of the object were left out."""

    @property
    def markers(self) -> int:
        """How many markers were found."""
        return int((self.corners.markers >= 0).sum()) // 4

    def without(self, clutter: NDArray[np.bool_]) -> "Observation":
        """The view without these of the object's patches [P]."""
        return replace(self, object_patches=self.object_patches[~clutter], is_cluttered=True)


@dataclass(frozen=True, eq=False)
class Setup:
    """What is known of a capture before its images are read."""

    camera: CaptureCamera
    board: Board
    spec: Estimation


def corners_of(detection: Detection, board: Board, camera: CaptureCamera) -> Corners:
    """The corners of the detected markers; a marker where the lens cannot be inverted is left out. No depth yet."""
    geometry = board_geometry(board)
    quads_px = unbend_corners(detection.corners_px, camera) if camera.has_lens else detection.corners_px
    pixels = np.concatenate([quads_px.reshape(-1, 2), detection.chess_px])
    points = np.concatenate(
        [geometry.corners[geometry.index(detection.ids)].reshape(-1, 3), geometry.chess[detection.chess]]
    )
    ids = np.concatenate([np.repeat(detection.ids, 4), np.full(len(detection.chess), -1)])
    rays = rays_of_pixels(pixels, camera.intrinsics, camera.lens)
    single: NDArray[np.bool_] = np.isfinite(rays[:, 0])
    quads = single[: 4 * len(detection.ids)].reshape(-1, 4).all(axis=1)
    whole = np.concatenate([np.repeat(quads, 4), single[4 * len(detection.ids) :]])
    return Corners(points[whole], pixels[whole], rays[whole], ids[whole], np.zeros(int(whole.sum())))


GRID = 12
"""Samples along each side of a marker or gap."""
MARGIN = 0.1
"""Share of a marker's side at each end that is left out: depth is mixed at the edges of what hides a marker."""
MIN_SAMPLES = 12
MIN_SHARE = 0.25
"""A piece needs so many samples with depth, and such a share of them."""
ALONE = 1e-9
"""What keeps the equations of samples in one line solvable: far below what a pixel adds to them, (1 / focal length)^2."""
OUTLIER = 3.5
"""A sample farther from its piece's plane than this many standard deviations is left out."""
CORNER_WINDOW_PX = 2
"""Half the width of the window whose median is the depth of a corner."""


def board_patches(depth: NDArray[np.uint16], detection: Detection, board: Board, camera: CaptureCamera) -> Patches:
    """A patch for each marker found in the board's plane, and for each gap between two: what covers one hid it.

    The gaps are white where black ink may swallow the infrared light that depth is measured with.
    """
    geometry = board_geometry(board)
    places = geometry.index(detection.ids)
    level = np.abs(geometry.corners[places, :, 2]).max(axis=1) < TOUCHING_M
    corners = detection.corners_px[level]
    quads = np.concatenate([corners, _gaps(places[level], corners, geometry)])
    place = np.linspace(MARGIN, 1 - MARGIN, GRID)
    s, t = (axis.ravel() for axis in np.meshgrid(place, place))
    weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=1)  # of the corners, clockwise
    pixels = np.floor(np.einsum("gk,mkc->mgc", weights, quads)).astype(np.int64)
    return sample_patches(depth, pixels, camera)


def _gaps(places: NDArray[np.intp], corners: Array, geometry: Geometry) -> Array:
    """[G, 4, 2] pixels: the areas between markers found side by side or one above the other; corners [M, 4, 2]."""
    index, gaps = {int(place): n for n, place in enumerate(places)}, []
    for place, n in index.items():
        right, below = index.get(int(geometry.right[place])), index.get(int(geometry.below[place]))
        if right is not None:
            gaps.append([corners[n, 1], corners[right, 0], corners[right, 3], corners[n, 2]])
        if below is not None:
            gaps.append([corners[n, 3], corners[n, 2], corners[below, 1], corners[below, 0]])
    return np.array(gaps, dtype=np.float64).reshape(-1, 4, 2)


def sample_patches(depth: NDArray[np.uint16], pixels: NDArray[np.int64], camera: CaptureCamera) -> Patches:
    """Patches fitted to the depth at pixels [P, S, 2] (column, row); those with too little depth are left out."""
    height, width = depth.shape
    inside = ((pixels >= 0) & (pixels < np.array([width, height]))).all(axis=2)
    column, row = np.where(inside, pixels[..., 0], 0), np.where(inside, pixels[..., 1], 0)
    z = np.where(inside, depth[row, column], 0) / camera.depth_units_per_m
    centres: Array = pixels.reshape(-1, 2).astype(np.float64) + 0.5
    rays = rays_of_pixels(centres, camera.intrinsics, camera.lens).reshape(pixels.shape)
    return fit_patches(rays, np.where(np.isfinite(rays).all(axis=2), z, 0.0))


def fit_patches(rays: Array, z: Array) -> Patches:
    """Planes through samples at rays [P, S, 2] with depths z [P, S], 0 where there is none."""
    count = (z > 0).sum(axis=1)
    enough = (count >= MIN_SAMPLES) & (count >= MIN_SHARE * z.shape[1])
    rays, z = np.where((z > 0)[..., None], rays, 0.0)[enough], z[enough]
    if not len(z):
        return no_patches()
    basis, used = np.concatenate([rays, np.ones((*z.shape, 1))], axis=2), z > 0
    inverse = np.where(used, 1.0 / np.where(used, z, 1.0), 0.0)
    for _ in range(3):
        chosen = basis * used[..., None]
        plane = np.linalg.solve(
            chosen.transpose(0, 2, 1) @ chosen + ALONE * np.eye(3), chosen.transpose(0, 2, 1) @ inverse[..., None]
        )[..., 0]
        off = (inverse - np.einsum("psk,pk->ps", basis, plane)) * z**2  # metres along z, to first order
        sigma = 1.4826 * _medians(np.abs(off), used)
        used = (z > 0) & (np.abs(off) <= OUTLIER * np.maximum(sigma, 1e-4)[:, None])
    total = np.maximum(used.sum(axis=1), 1)
    ray = (basis * used[..., None]).sum(axis=1) / total[:, None]
    ray_z = (basis * (z * used)[..., None]).sum(axis=1) / total[:, None]
    normal = -plane / np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12)
    good = (used.sum(axis=1) >= MIN_SAMPLES) & (ray_z[:, 2] > 0)
    return Patches(ray_z, ray, normal, sigma)[good]


def depth_at(depth: NDArray[np.uint16], pixels: Array, units_per_m: float) -> Array:
    """[N] metres: median of the depth around pixels [N, 2] (centres at +0.5); 0 where fewer than a third have depth."""
    reach = np.arange(-CORNER_WINDOW_PX, CORNER_WINDOW_PX + 1)
    height, width = depth.shape
    column = np.clip(np.floor(pixels[:, 0]).astype(np.int64)[:, None] + reach, 0, width - 1)
    row = np.clip(np.floor(pixels[:, 1]).astype(np.int64)[:, None] + reach, 0, height - 1)
    window = depth[row[:, :, None], column[:, None, :]].reshape(len(pixels), len(reach) ** 2)
    many = (window > 0).mean(axis=1) >= 1 / 3
    return np.where(many, _medians(window, window > 0), 0.0) / units_per_m


def _medians(values: Array, used: NDArray[np.bool_]) -> Array:
    """[N]: medians of the used of values [N, S], inf where none is; numpy's for nan takes ten times as long."""
    ordered, count = np.sort(np.where(used, values, np.inf), axis=1), used.sum(axis=1)
    row = np.arange(len(values))
    return 0.5 * (
        ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, np.minimum(count // 2, values.shape[1] - 1)]
    )


SIDE_RAD = 0.012
"""Width of a patch, seen from the camera: 10 mm at 0.8 m."""
ACROSS = 5
"""Samples across a patch: registered depth is coarser than colour, and need not be read at every pixel."""
CLEARANCE_M = 0.01
TALLEST_M = 0.5
"""A patch lies so far above the board, as depth has the board."""
MIN_COSINE = 0.35
"""Patches that are seen at more than 70 degrees from their normal are left out: their depth is mixed."""
DEPTH_SIGMA_M = 0.003
"""Standard deviation of depth at 1 m, which grows with the square of the distance; measured anew from the capture."""
NOISY = 3.0
"""A patch with so many times the expected noise is no piece of plane."""
MOST = 200
"""Patches of one view that are kept, evenly over all that there are."""


def side_of_patch(camera: CaptureCamera) -> int:
    """Pixels across a patch of the object."""
    return max(ACROSS, round(SIDE_RAD * camera.intrinsics.fx))


def object_patches(depth: NDArray[np.uint16], T_board_cam: Pose, on_board: Patches, setup: Setup) -> Patches:
    """The object's patches in one view, at most MOST; heights are over the board's plane as this view's depth has it."""
    board, camera = setup.board, setup.camera
    side = side_of_patch(camera)
    blocks = _blocks_over_board(T_board_cam, board, camera, side)
    if not len(blocks):
        return no_patches()
    # The board's plane n p = d in camera axes: the pose tells the normal, depth the distance.
    normal = T_board_cam[2, :3]
    distance = float(np.median(on_board.ray_z @ normal)) if len(on_board) else float(-T_board_cam[2, 3])
    middle = blocks + side // 2
    z = depth[middle[:, 1], middle[:, 0]] / camera.depth_units_per_m
    centres: Array = middle.astype(np.float64) + 0.5
    rays = rays_of_pixels(centres, camera.intrinsics, camera.lens)
    points = np.column_stack([rays, np.ones(len(rays))]) * z[:, None]
    with np.errstate(invalid="ignore"):
        blocks = blocks[(z > 0) & (points @ normal - distance > CLEARANCE_M)]
    reach = np.arange(0, side, side // ACROSS)
    offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    patches = sample_patches(depth, blocks[:, None] + offsets, camera)
    keep = np.flatnonzero(_on_object(patches, patches.ray_z @ normal - distance, T_board_cam, setup))
    return patches[keep[spread_evenly(len(keep), MOST)]]


def _blocks_over_board(T_board_cam: Pose, board: Board, camera: CaptureCamera, side: int) -> NDArray[np.int64]:
    """[B, 2]: upper left pixels of the blocks in the rectangle around the board and the space above it."""
    x, y = board.scale * board.width_m / 2, board.scale * board.height_m / 2
    space = np.array([[sx * x, sy * y, z] for sx in (-1, 1) for sy in (-1, 1) for z in (0.0, 0.5 * T_board_cam[2, 3])])
    pixels = pixels_of_points(space, T_board_cam, camera)
    k = camera.intrinsics
    size = np.array([k.width, k.height])
    if not np.isfinite(pixels).all():
        pixels = np.array([[0, 0], size])
    first = np.ceil(np.clip(pixels.min(axis=0), 0, size) / side).astype(np.int64)
    last = np.floor(np.clip(pixels.max(axis=0), 0, size) / side).astype(np.int64)
    columns, rows = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]))
    return np.stack([columns.ravel(), rows.ravel()], axis=1) * side


def _on_object(patches: Patches, height: Array, T_board_cam: Pose, setup: Setup) -> NDArray[np.bool_]:
    """[P]: patches of a smooth surface, not seen at a grazing angle, within the space over the board; height [P] over it."""
    cosine = -(patches.normal * patches.ray).sum(axis=1) / np.linalg.norm(patches.ray, axis=1)
    smooth = patches.sigma_m <= NOISY * DEPTH_SIGMA_M * np.maximum(patches.ray_z[:, 2], 0.5) ** 2
    half = 0.5 * setup.board.scale * np.array([setup.board.width_m, setup.board.height_m])
    inside = (np.abs(transform(T_board_cam, patches.ray_z)[:, :2]) < half).all(axis=1)
    above: NDArray[np.bool_] = (height > CLEARANCE_M) & (height < TALLEST_M)
    return above & (cosine > MIN_COSINE) & smooth & inside
