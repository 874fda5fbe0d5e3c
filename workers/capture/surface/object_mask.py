"""Where the object is: its footprint and height on the board, and its mask in each view, down to the board.

Heights above the board are collected in the cells of a grid, and a cell's height is their median: a hundred noisy
pixels of many views fix it to some tenths of a millimetre, so that an object of 4 mm is found where no single view
shows it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from schemas.base import Array, Pose
from schemas.errors import CaptureError
from schemas.job.captures import Board, Fusion
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.board import TOUCHING_M, board_geometry
from workers.capture.surface.posed_view import PosedView, pinhole_rays
from workers.geometry.jit import compiled
from workers.geometry.mesh import edge_keys
from workers.geometry.zbuffer import draw_depth

CELL_M = 0.004
BIN_M = 0.0005
REACH_M = 0.03
"""Medians are resolved up to this far above and below the print's plane; what is higher counts as higher."""

TALLEST_M = 0.6
"""Nothing on the board is taller."""

SAMPLES = 300_000
"""Pixels of a view that are looked at, about."""

LEAST_SAMPLES = 12
"""A cell with as many is known; where views are few or small, one with a third of what most cells have."""

FLOOR_M = 0.001
"""A cell whose median is as high may be the object's: five times what the median of a hundred pixels of 2 mm is off."""

FLOOR_REACH_CELLS = 4
"""A floor goes on below the walls around it for so far, where no cell beside it shows the board."""

MEDIAN_PX = 5
"""Side of the square of pixels whose median depth says whether a pixel is the board's: that of the fit."""

LIFTED = 2.0
"""Noise lifts no pixel of the board above so many clearances: what is higher is the object's, thin as it may be."""

LEAST_CELLS = 6
"""A smaller thing, 1 cm^2, is noise."""

STAND_M = 0.03
"""What carries markers out of the board's plane, such as a cube of tags, reaches beyond them by less."""

BRIDGE_CELLS = 2
"""Parts of one object are as near to one another as this."""


@dataclass(frozen=True, eq=False)
class Ground:
    """The board's surface z = a x + b y + c as depth measures it, `plane` (a, b, c); what is nearer than clearance_m is it."""

    plane: tuple[float, float, float]
    clearance_m: float

    def height_m(self, points: Array) -> Array:
        """[N] height of points [N, 3] above the surface."""
        a, b, c = self.plane
        return points[:, 2] - (a * points[:, 0] + b * points[:, 1] + c)


@dataclass(frozen=True, eq=False)
class ObjectRegion(Ground):
    """The object's surroundings, board frame, metres.

    low, high [3]: a box around it; spread_m: standard deviation of the board's cells about its plane. `footprint` [cells in x,
    cells in y] bool, cell (0, 0) beginning at `corner` [2]; `floor`, likewise: cells of the object that show nothing of the
    board, where its surface is above floor_m and counts although it may lie below the clearance. `notes` for the user.
    """

    low: Array
    high: Array
    spread_m: float
    footprint: NDArray[np.bool_]
    corner: Array
    floor: NDArray[np.bool_]
    floor_m: float
    notes: tuple[str, ...] = ()

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """[N] bool: points [N, 3] above the footprint and above the clearance."""
        high = self.height_m(points) + self.lift_m(points) > self.clearance_m
        return np.asarray(self._cells((points[:, 0], points[:, 1]), self.footprint) & high)

    def lift_m(self, points: Array) -> Array:
        """[N] height to add to points [N, 3] above a floor, so that the clearance leaves of it what is above `floor_m`."""
        return np.where(self._cells((points[:, 0], points[:, 1]), self.floor), self.clearance_m - self.floor_m, 0.0)

    def split_depth(
        self, depth_m: NDArray[np.float32], camera: Camera
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """(object_m, board_inverse, board_facing), each [H, W] float32, of a depth image of a camera in the board frame.

        object_m: depth without the board's pixels, which are below the clearance; in those, else 0, the board's plane: 1/z, and
        the cosine of incidence times the length of the ray at z = 1. Which pixels are the board's the median of the pixels
        around says, because noise lifts single ones above the clearance.
        """
        (a, b, c), T, z = self.plane, camera.T_world_cam, depth_m.astype(np.float64)
        quiet = np.zeros_like(z)
        if depth_m.size:
            quiet = cv2.medianBlur(np.ascontiguousarray(depth_m), MEDIAN_PX).astype(np.float64)
        rays = pinhole_rays(camera.intrinsics, z.shape)
        # The height of a pixel is z (up . ray) + above, with `up` the plane's upward normal in camera axes; it is 0 on the plane.
        up, above = T[2, :3] - a * T[0, :3] - b * T[1, :3], T[2, 3] - a * T[0, 3] - b * T[1, 3] - c
        along = up[0] * rays[0] + up[1] * rays[1] + up[2]
        quiet = np.where(quiet > 0.0, quiet, z)
        on_floor = self._cells(_to_board(T, rays, quiet)[:2], self.floor)
        high = (quiet * along + above > self.clearance_m) | (z * along + above > LIFTED * self.clearance_m)
        thing = (z > 0.0) & (on_floor | high)
        board = (z > 0.0) & ~thing & (along < 0.0) & (above > 0.0)
        size = np.sqrt(up[0] * up[0] + up[1] * up[1] + up[2] * up[2])
        inverse, facing = (np.where(board, -along / divisor, 0.0).astype(np.float32) for divisor in (above, size))
        return np.where(thing, depth_m, np.float32(0.0)), inverse, facing

    def _cells(self, places: tuple[Array, Array], cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[...] bool: places (x, y), each [...], above the cells that are named."""
        i, j = _cells_at(places, self.corner)
        inside = (i >= 0) & (j >= 0) & (i < cells.shape[0]) & (j < cells.shape[1])
        return np.asarray(inside & cells[np.where(inside, i, 0), np.where(inside, j, 0)])


def _cells_at(places: tuple[Array, Array], corner: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    i, j = (np.floor((at - first) / CELL_M).astype(np.int64) for at, first in zip(places, corner, strict=True))
    return i, j


def _to_board(T: Pose, rays: tuple[Array, Array], z: Array) -> tuple[Array, Array, Array]:
    """(x, y, z), each [h, w], in the board frame, of depth z [h, w] along rays."""
    x, y = rays[0] * z, rays[1] * z
    bx, by, bz = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in T[:3])
    return bx, by, bz


def find_object(views: Sequence[PosedView], board: Board, spec: Fusion) -> ObjectRegion:
    """The object of a capture. Raises CaptureError where the board has no depth, or nothing stands on it."""
    half = 0.5 * np.array([board.width_m, board.height_m]) * board.scale
    low_bins, tall_bins = _heights(views, half)
    height, count = _medians(low_bins)
    usual = float(np.median(count[count > 0])) if count.any() else 0.0
    known = count >= np.clip(usual / 3.0, 1.0, LEAST_SAMPLES)
    if known.sum() < LEAST_CELLS:
        raise CaptureError(
            "no_depth",
            f"{len(views)} views have depth on {int(known.sum())} cells of 4 mm of the board: depth images are empty, "
            "or depth_units_per_m in camera.json is wrong",
        )
    x, y = (-half[axis] + (np.arange(side) + 0.5) * CELL_M for axis, side in enumerate(known.shape))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    plane, spread = _board_plane(grid[known], height[known])
    above = height - (grid @ np.array(plane[:2]) + plane[2])
    clearance = max(spec.board_clearance_m, 4.0 * spread)
    stands = _stands(board, -half, known.shape)
    footprint, others = _largest(known & (above > clearance) & ~stands, above)
    if footprint is None:
        highest = float(above[known].max())
        raise CaptureError(
            "no_object",
            f"nothing on the board stands more than {clearance * 1e3:.1f} mm above it (highest: {highest * 1e3:.1f} mm): lower "
            f"fusion.board_clearance_m ({spec.board_clearance_m * 1e3:g} mm) if the object is flat",
        )
    notes = [f"{others} other thing{'s' * (others > 1)} on the board left out"] if others else []
    if clearance > spec.board_clearance_m:
        notes.append(
            f"the board's surface is uneven by {spread * 1e3:.2f} mm, so the clearance is {clearance * 1e3:.1f} mm"
        )
    if stands.any():
        notes.append(
            f"what stands within {STAND_M * 1e3:g} mm of markers out of the board's plane is no part of the object"
        )
    floor_m = min(max(FLOOR_M, 4.0 * spread), clearance)
    floor = _floor(footprint, known & (above > floor_m) & ~stands, known & (above <= floor_m))
    # Three cells around, for what hangs over and for the error of the rim.
    cells = ndimage.binary_dilation(footprint, np.ones((3, 3), bool), iterations=3) | floor
    low, high = _box(cells, -half, plane[2], _top_m(tall_bins, footprint))
    return ObjectRegion(plane, clearance, low, high, spread, cells, -half, floor, floor_m, tuple(notes))


def _heights(views: Sequence[PosedView], half: Array) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(low_bins, tall_bins), each [cells in x, cells in y, bins]: how often the views measured each height over a board.

    half [2]: half its width and height. low_bins are `BIN_M` high around its plane, tall_bins `REACH_M` from it on. With a mask,
    what is outside of it cannot be higher than the board.
    """
    cells = np.ceil(2.0 * half / CELL_M).astype(np.int64)
    low_bins = np.zeros((cells[0], cells[1], round(2 * REACH_M / BIN_M) + 2), np.int32)
    tall_bins = np.zeros((cells[0], cells[1], round(TALLEST_M / REACH_M)), np.int32)
    for view in views:
        k = view.depth_camera.intrinsics
        stride = max(1, int(np.sqrt(k.width * k.height / SAMPLES)))
        at = np.s_[stride // 2 :: stride, stride // 2 :: stride]
        mask = np.ones((1, 1), np.bool_) if view.mask is None else view.mask[at]
        pictures = view.depth_m[at], pinhole_rays(k, view.depth_m.shape, stride), mask
        _count_heights(pictures, view.depth_camera.T_world_cam, -half, low_bins, tall_bins)
    return low_bins, tall_bins


@compiled
def _count_heights(
    pictures: tuple[NDArray[np.float32], tuple[Array, Array], NDArray[np.bool_]],
    T: Pose,
    corner: Array,
    low_bins: NDArray[np.int32],
    tall_bins: NDArray[np.int32],
) -> None:
    """Counts the heights of a view, whose pictures are depth [h, w], the rays of its pixels, and a mask, or [1, 1] for all."""
    depth_m, (ray_x, ray_y), mask = pictures
    masked = mask.size > 1
    for row in range(depth_m.shape[0]):
        for column in range(depth_m.shape[1]):
            z = float(depth_m[row, column])
            x, y = ray_x[0, column] * z, ray_y[row, 0] * z
            height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            i = int(np.floor((T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3] - corner[0]) / CELL_M))
            j = int(np.floor((T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3] - corner[1]) / CELL_M))
            inside = 0 <= i < low_bins.shape[0] and 0 <= j < low_bins.shape[1]
            if not (inside and z > 0.0 and height <= TALLEST_M):
                continue
            if masked and height > REACH_M and not mask[row, column]:
                continue
            level = int(np.floor((height + REACH_M) / BIN_M)) + 1
            low_bins[i, j, min(max(level, 0), low_bins.shape[2] - 1)] += 1
            if height > 0.0:
                tall_bins[i, j, min(int(height / REACH_M), tall_bins.shape[2] - 1)] += 1


def _stands(board: Board, corner: Array, cells: tuple[int, ...]) -> NDArray[np.bool_]:
    """[cells in x, cells in y]: those within `STAND_M` of the ground below markers that are out of the board's plane."""
    stands = np.zeros(cells, np.uint8)
    places = board_geometry(board).corners
    for quad in places[np.abs(places[:, :, 2]).max(axis=1) > TOUCHING_M]:
        hull = cv2.convexHull(np.floor((quad[:, :2] - corner) / CELL_M).astype(np.int32))
        cv2.fillConvexPoly(stands, np.ascontiguousarray(hull[:, :, ::-1]), 1)  # OpenCV's x is the second axis
    size = 2 * round(STAND_M / CELL_M) + 1
    return np.asarray(cv2.dilate(stands, np.ones((size, size), np.uint8)) > 0)


def _medians(bins: NDArray[np.int32]) -> tuple[Array, NDArray[np.int64]]:
    """(median height [X, Y], interpolated within its bin; samples [X, Y])."""
    below = np.cumsum(bins, axis=2, dtype=np.int32)
    total = below[..., -1].astype(np.int64)
    at = (2 * below < total[..., None]).sum(axis=2).clip(0, bins.shape[2] - 1)
    here = np.take_along_axis(bins, at[..., None], axis=2)[..., 0]
    before = np.take_along_axis(below, at[..., None], axis=2)[..., 0] - here
    share = (0.5 * total - before) / np.maximum(here, 1)
    return (at - 1 + np.clip(share, 0.0, 1.0)) * BIN_M - REACH_M, total


def _board_plane(xy: Array, height: Array) -> tuple[tuple[float, float, float], float]:
    """((a, b, c) of z = a x + b y + c, spread) of the cells near z = 0, by Tukey's weights from their median."""
    near = np.abs(height) < REACH_M - BIN_M
    xy, height = xy[near], height[near]
    if len(xy) < LEAST_CELLS:
        raise CaptureError(
            "no_depth", "no depth image shows the board's surface within 30 mm of the plane of its markers"
        )
    design = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    ordered = np.sort(height)
    # From the middle of the fullest window of 4 mm, the lowest where several are: the board is the largest level thing.
    counts = np.searchsorted(ordered, ordered + 0.004, side="right") - np.arange(len(ordered))
    solution = np.array([0.0, 0.0, ordered[int(np.argmax(counts))] + 0.002])
    limit = 0.006
    for _ in range(8):
        residual = height - design @ solution
        weight = np.clip(1.0 - (residual / limit) ** 2, 0.0, None)
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(design * root, height * root[:, 0], rcond=None)[0]
        inliers = np.abs(height - design @ solution) < limit
        spread = 1.4826 * float(np.median(np.abs(height - design @ solution)[inliers])) if inliers.any() else limit
        limit = min(max(5.0 * spread, 0.0015), 0.006)
    return (float(solution[0]), float(solution[1]), float(solution[2])), spread


def _largest(high: NDArray[np.bool_], above: Array) -> tuple[NDArray[np.bool_] | None, int]:
    """(cells of the thing with the largest volume, or None; number of others that are a tenth as large)."""
    bridged = ndimage.binary_dilation(high, np.ones((3, 3), bool), iterations=BRIDGE_CELLS)
    labels, count = ndimage.label(bridged)
    labels = np.where(high, labels, 0)
    cells = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    volume = np.bincount(labels.ravel(), weights=np.where(high, above, 0.0).ravel(), minlength=count + 1)[1:]
    volume = np.where(cells >= LEAST_CELLS, volume, 0.0)
    if not volume.any():
        return None, 0
    best = int(np.argmax(volume))
    return labels == best + 1, int((volume > 0.1 * volume[best]).sum()) - 1


def _floor(footprint: NDArray[np.bool_], raised: NDArray[np.bool_], board: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Raised cells that hang together with the footprint, and what is around them, away from cells of the board."""
    around = np.ones((3, 3), np.bool_)
    apart = ~ndimage.binary_dilation(board, around)
    part = ndimage.binary_propagation(footprint, around, mask=footprint | raised) & ~footprint
    return np.asarray(ndimage.binary_dilation(part & apart, around, iterations=FLOOR_REACH_CELLS) & apart)


def _top_m(tall_bins: NDArray[np.int32], footprint: NDArray[np.bool_]) -> float:
    """The height of what stands on a footprint, rounded up to `REACH_M`."""
    levels = tall_bins[footprint].sum(axis=0)
    filled = np.flatnonzero(levels > max(LEAST_SAMPLES, 2e-4 * levels.sum()))
    return (int(filled[-1]) + 1 if len(filled) else 1) * REACH_M


def _box(cells: NDArray[np.bool_], corner: Array, ground_m: float, top_m: float) -> tuple[Array, Array]:
    """(low [3], high [3]) corners of a box over cells, with some room below the ground and above the top."""
    at = np.argwhere(cells)
    low, high = corner + at.min(axis=0) * CELL_M, corner + (at.max(axis=0) + 1) * CELL_M
    return np.append(low, ground_m - 0.008), np.append(high, ground_m + top_m + 0.01)


RIM_M = 0.0005
"""Points of an open edge that lie nearer to the cut above the board than this are on it."""


IN_FRONT_M = 0.02
"""What is so much nearer than the object hides it: more than a surface is off."""
IN_FRONT_PX = 5
"""And is as wide, at least: narrower are pixels that fly between two surfaces."""


def silhouette(mesh: Mesh, camera: Camera, depth_m: NDArray[np.float32] | None = None) -> NDArray[np.bool_]:
    """[H, W] bool: the pixels whose centres see the mesh; nothing hides it but what a depth image shows before it."""
    drawn = draw_depth(mesh, camera)
    if depth_m is None:
        return drawn > 0.0
    near = ((depth_m > 0.0) & (depth_m < drawn - IN_FRONT_M)).astype(np.uint8)
    hidden = cv2.morphologyEx(near, cv2.MORPH_OPEN, np.ones((IN_FRONT_PX, IN_FRONT_PX), np.uint8))
    return (drawn > 0.0) & (hidden == 0)


def down_to_board(mesh: Mesh, ground: Ground) -> Mesh:
    """The mesh with walls from its cut edge down to the board: the object goes on below the clearance."""
    edges = _open_edges(mesh)
    height = ground.height_m(mesh.vertices)
    edges = edges[(height[edges] < ground.clearance_m + RIM_M).all(axis=1)]
    if not len(edges):
        return mesh
    a, b, c = ground.plane
    rim, local = np.unique(edges, return_inverse=True)
    foot = mesh.vertices[rim].copy()
    foot[:, 2] = a * foot[:, 0] + b * foot[:, 1] + c
    low = local.reshape(-1, 2) + len(mesh.vertices)
    upper = np.stack([edges[:, 1], edges[:, 0], low[:, 0]], axis=1)
    lower = np.stack([edges[:, 1], low[:, 0], low[:, 1]], axis=1)
    faces = np.concatenate([mesh.faces, upper, lower]).astype(np.int32)
    return Mesh(np.concatenate([mesh.vertices, foot]), faces)


def _open_edges(mesh: Mesh) -> NDArray[np.int64]:
    """[E, 2] the directed edges that one face alone has."""
    directed = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    _, first, count = np.unique(edge_keys(mesh.faces, len(mesh.vertices)), return_index=True, return_counts=True)
    return directed[first[count == 1]]
