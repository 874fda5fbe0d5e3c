"""The script that every lab writes for photographs of a marker board: OpenCV's markers, one solvePnP a view, Open3D's TSDF.

It is written against OpenCV's and Open3D's documentation and the layout of a capture's folder alone, and shares no code with
what it is compared with. Poses are T_board_cam: camera to board, board frame as in board.json (origin at the middle of the
print, x along the rows, y up the print, z out of it), metres.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

REFINEMENTS = {"default": cv2.aruco.CORNER_REFINE_NONE, "SUBPIX": cv2.aruco.CORNER_REFINE_SUBPIX}
"""Variants of the script by the detector's `cornerRefinementMethod`; every other parameter is OpenCV's default."""

VOXEL_M = 0.002
"""Of the TSDF: the distance of the points of the cloud that it is compared with."""
TRUNCATION_VOXELS = 5.0
"""Open3D's examples take 4 to 10."""
FARTHEST_M = 2.0
"""Depth beyond this is the room's."""
ABOVE_M = 0.003
"""What is lower over the print is the board: the noise of depth reaches as far."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """What the script reads of a capture's folder: K [3, 3] with pixel centres at 0, lens [N], and the board's corners by id.

    `corners_m` maps a marker's id to its corners [4, 3], clockwise from the upper left of the print; `half_m` is half the
    board's width and height.
    """

    path: Path
    K: NDArray[np.float64]
    lens: NDArray[np.float64]
    size: tuple[int, int]
    units_per_m: float
    dictionary: str
    corners_m: Mapping[int, NDArray[np.float64]]
    half_m: tuple[float, float]

    def numbers(self) -> list[int]:
        """Numbers of the views."""
        return sorted(int(file.stem.removeprefix("rgb_")) for file in self.path.glob("rgb_*.png"))

    def image(self, kind: str, number: int) -> NDArray[Any]:
        """[H, W, 3] BGR uint8 of "rgb", [H, W] uint16 of "depth". Raises OSError where the file is no image."""
        file = self.path / f"{kind}_{number:05d}.png"
        found = cv2.imread(str(file), cv2.IMREAD_COLOR if kind == "rgb" else cv2.IMREAD_UNCHANGED)
        if found is None:
            raise OSError(f"{file} is no image that can be read")
        return found


def read_photographs(path: Path) -> Photographs:
    """The folder of a capture with a grid of markers and registered depth."""
    camera, board = (json.loads((path / name).read_bytes()) for name in ("camera.json", "board.json"))
    shift = float(camera["pixel_centre"])
    K = np.array([[camera["fx"], 0, camera["cx"] - shift], [0, camera["fy"], camera["cy"] - shift], [0, 0, 1]])
    scale = (board["measured_ruler_m"] or board["ruler_m"]) / board["ruler_m"]
    side, pitch = scale * board["marker_m"], scale * (board["marker_m"] + board["gap_m"])
    columns, rows, first = board["columns"], board["rows"], board["first_id"]
    square = side / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    corners = {
        first + row * columns + column: square
        + pitch * np.array([column - (columns - 1) / 2, (rows - 1) / 2 - row, 0.0])
        for row in range(rows)
        for column in range(columns)
    }
    return Photographs(
        path,
        K,
        np.array(camera["distortion"], np.float64),
        (camera["width"], camera["height"]),
        camera["depth_units_per_m"],
        board["dictionary"],
        corners,
        (scale * board["width_m"] / 2, scale * board["height_m"] / 2),
    )


def estimate_poses(photographs: Photographs, refinement: str) -> dict[int, NDArray[np.float64]]:
    """T_board_cam [4, 4] by view: all corners of a view in one `cv2.solvePnP`; a view without a marker of the board has none."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = REFINEMENTS[refinement]
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, photographs.dictionary))
    detector, poses = cv2.aruco.ArucoDetector(dictionary, settings), {}
    for number in photographs.numbers():
        quads, ids, _ = detector.detectMarkers(cv2.cvtColor(photographs.image("rgb", number), cv2.COLOR_BGR2GRAY))
        found = [] if ids is None else [(int(i), q[0]) for i, q in zip(ids.ravel(), quads, strict=True)]
        known = [(photographs.corners_m[i], quad) for i, quad in found if i in photographs.corners_m]
        if not known:
            continue
        places, pixels = (np.concatenate(part).astype(np.float64) for part in zip(*known, strict=True))
        done, turn, shift = cv2.solvePnP(places, pixels, photographs.K, photographs.lens)
        if done:
            T_cam_board = np.eye(4)
            T_cam_board[:3, :3], T_cam_board[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            poses[number] = np.asarray(np.linalg.inv(T_cam_board), np.float64)
    return poses


def has_open3d() -> bool:
    """Whether depth can be fused."""
    return find_spec("open3d") is not None


def fuse(photographs: Photographs, poses: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
    """[N, 3] points over the board, board frame, of Open3D's TSDF of all views with a pose. Needs `open3d`."""
    import open3d as o3d

    Tensor, Image, number_of = o3d.core.Tensor, o3d.t.geometry.Image, o3d.core.float32
    kinds = (("tsdf", "weight", "color"), (number_of,) * 3, ((1,), (1,), (3,)))
    grid = o3d.t.geometry.VoxelBlockGrid(*kinds, VOXEL_M, 16, 20_000, o3d.core.Device("CPU:0"))
    K, limits = Tensor(photographs.K), (photographs.units_per_m, FARTHEST_M, TRUNCATION_VOXELS)
    maps = cv2.initUndistortRectifyMap(
        photographs.K, photographs.lens, None, photographs.K, photographs.size, cv2.CV_32FC1
    )
    for number, T_board_cam in poses.items():
        rgb = cv2.cvtColor(photographs.image("rgb", number), cv2.COLOR_BGR2RGB)
        color = Image(cv2.remap(rgb, *maps, cv2.INTER_LINEAR))
        depth = Image(cv2.remap(photographs.image("depth", number), *maps, cv2.INTER_NEAREST))
        T_cam_board = Tensor(np.linalg.inv(T_board_cam))
        blocks = grid.compute_unique_block_coordinates(depth, K, T_cam_board, *limits)
        grid.integrate(blocks, depth, color, K, K, T_cam_board, *limits)
    points = grid.extract_point_cloud().point.positions.numpy().astype(np.float64)
    over = (np.abs(points[:, :2]) < photographs.half_m).all(axis=1) & (points[:, 2] > ABOVE_M)
    return points[over]


def run(path: Path, refinement: str) -> tuple[dict[int, NDArray[np.float64]], NDArray[np.float64] | None, float]:
    """(poses by view, fused points [N, 3] or None without Open3D, seconds of processor) of a capture's folder."""
    began = time.process_time()
    photographs = read_photographs(path)
    poses = estimate_poses(photographs, refinement)
    points = fuse(photographs, poses) if has_open3d() else None
    return poses, points, time.process_time() - began
