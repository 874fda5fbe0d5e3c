"""Readers of the layouts of NOCS and of nerfstudio, written from what their loaders do: they import nothing of this project.

NOCS: dataset.py (load_camera_scenes, load_mask, process_data) and utils.py (load_mesh, backproject, align); nerfstudio:
nerfstudio_dataparser.py, cameras.py (rays through pixels' centres at +0.5) and its page on data conventions.
"""

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def read_picture(path: Path) -> NDArray:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, f"{path} is missing"
    return pixels


@dataclass
class Instance:
    """An object in an image: mask [H, W] bool, coords [H, W, 3] from 0 to 1, class id, sizes of its box, its model."""

    class_id: int
    name: str
    mask: NDArray
    coords: NDArray
    scales: NDArray
    vertices: NDArray
    faces: NDArray


@dataclass
class Picture:
    """An image of NOCS, and what images.csv says of it."""

    row: dict[str, str]
    color: NDArray
    depth_mm: NDArray
    instances: list[Instance]

    def points_mm(self, mask: NDArray) -> NDArray:
        """[N, 3]: `backproject`, whose camera has x to the left and y up."""
        k = {name: float(self.row[name]) for name in ("fx", "fy", "cx_opencv", "cy_opencv")}
        rows, columns = np.nonzero(mask & (self.depth_mm > 0))
        z = self.depth_mm[rows, columns].astype(float)
        x, y = (columns - k["cx_opencv"]) / k["fx"] * z, (rows - k["cy_opencv"]) / k["fy"] * z
        return np.stack([-x, -y, z], axis=1)


def load_pictures(root: Path, subset: str) -> Iterator[Picture]:
    """Ten images a folder, folders without gaps."""
    with (root / "images.csv").open() as file:
        rows = {row["path"]: row for row in csv.DictReader(file)}
    folders = [path for path in (root / subset).iterdir() if path.is_dir()]
    for number in range(10 * len(folders)):
        path = f"{subset}/{number // 10:05d}/{number % 10:04d}"
        if (root / f"{path}_color.png").exists():
            yield load_picture(root, path, rows[path], subset)


def load_picture(root: Path, path: str, row: dict[str, str], subset: str) -> Picture:
    color, coord, depth, mask = (
        read_picture(root / f"{path}_{name}.png") for name in ("color", "coord", "depth", "mask")
    )
    assert depth.dtype == np.uint16 and depth.ndim == 2 and coord.dtype == mask.dtype == np.uint8
    lines = (root / f"{path}_meta.txt").read_text().splitlines(keepends=True)
    words = [line[:-1].split(" ") for line in lines]
    ids = sorted(np.unique(mask).tolist())
    assert ids.pop() == 255 and [int(one[0]) for one in words] == list(range(1, len(words) + 1))
    coords = coord[..., ::-1] / 255.0
    coords[..., 2] = 1 - coords[..., 2]
    instances = []
    for number, class_id, synset, name in words:
        if int(number) not in ids:
            continue
        folder = root / "obj_models" / subset / synset / name
        box = np.loadtxt(folder / "bbox.txt")
        mine = mask == int(number)
        instances.append(Instance(int(class_id), name, mine, coords, box[0] - box[1], *load_mesh(folder / "model.obj")))
    return Picture(row, color[..., ::-1], depth, instances)


def load_mesh(path: Path) -> tuple[NDArray, NDArray]:
    """Vertices, z turned as that loader does with synthetic models, and faces."""
    words = [line.split() for line in path.read_text().splitlines()]
    vertices = np.array([one[1:4] for one in words if one[0] == "v"], float)
    faces = np.array([one[1:4] for one in words if one[0] == "f"], int) - 1
    return vertices * [1, 1, -1], faces


def umeyama(source: NDArray, target: NDArray) -> tuple[float, NDArray, NDArray]:
    """(scale, R, t) of the similarity that takes source [N, 3] nearest to target (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    U, D, Vt = np.linalg.svd(b.T @ a / len(a))
    S = np.diag([1, 1, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ S @ Vt
    scale = np.trace(np.diag(D) @ S) / (a**2).sum(1).mean()
    return scale, R, target.mean(0) - scale * R @ source.mean(0)


@dataclass
class Frame:
    """A view: image [H, W, 3], depth [H, W] in metres, mask [H, W] or None, camera to world (OpenGL), intrinsics."""

    path: str
    image: NDArray
    depth_m: NDArray
    mask: NDArray | None
    T_world_cam: NDArray
    k: dict[str, float]

    def points(self) -> tuple[NDArray, NDArray]:
        """([N, 3] in the world, their pixels [N, 2] as row and column) of pixels that have depth."""
        rows, columns = np.nonzero(self.depth_m > 0)
        z = self.depth_m[rows, columns]
        x, y = (columns + 0.5 - self.k["cx"]) / self.k["fl_x"], (rows + 0.5 - self.k["cy"]) / self.k["fl_y"]
        inside = np.stack([x * z, -y * z, -z], axis=1)
        return inside @ self.T_world_cam[:3, :3].T + self.T_world_cam[:3, 3], np.stack([rows, columns], axis=1)


def load_frames(path: Path) -> dict[str, list[Frame]]:
    """The frames of a transforms.json for `train`, `val` and `test`."""
    meta = json.loads(path.read_text())
    assert meta["camera_model"] == "OPENCV"
    frames = {one["file_path"]: one for one in meta["frames"]}
    for key in ("mask_path", "depth_file_path"):
        assert sum(key in one for one in meta["frames"]) in (0, len(frames))
    return {split: [load_frame(path.parent, frames[name]) for name in meta[f"{split}_filenames"]] for split in SPLITS}


SPLITS = ("train", "val", "test")


def load_frame(folder: Path, one: dict) -> Frame:
    image, depth = read_picture(folder / one["file_path"]), read_picture(folder / one["depth_file_path"])
    assert image.shape[:2] == depth.shape == (one["h"], one["w"]) and depth.dtype == np.uint16
    mask = read_picture(folder / one["mask_path"]) if "mask_path" in one else None
    k = {name: float(one[name]) for name in ("fl_x", "fl_y", "cx", "cy")}
    return Frame(one["file_path"], image[..., ::-1], depth * 1e-3, mask, np.array(one["transform_matrix"]), k)
