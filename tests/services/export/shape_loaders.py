"""Readers of the layouts of Occupancy Networks and of PCN, written from what their loaders do; they import nothing of ours.

Occupancy Networks: im2mesh/data/core.py, fields.py and common.py; PCN: PoinTr's datasets/PCNDataset.py, which follows GRNet's.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image


@dataclass
class Shot:
    """An image [137, 137, 3] with world_mat [3, 4] and camera_mat [3, 3]."""

    image: NDArray
    world: NDArray
    camera: NDArray


@dataclass
class Model:
    """points [N, 3] with occ [N], a cloud [M, 3] with normals, loc [3] and scale, and images."""

    category: str
    name: str
    points: NDArray
    occ: NDArray
    cloud: NDArray
    normals: NDArray
    loc: NDArray
    scale: NDArray
    shots: list[Shot]

    def seen(self, shot: Shot, points: NDArray) -> NDArray:
        """[N, 2]: where points, as stored, are in an image: -1 and 1 are its edges (get_camera_args, project_to_camera)."""
        R, t = shot.world[:, :3] * self.scale, shot.world[:, 3] + shot.world[:, :3] @ self.loc
        K = np.array([[2 / 137, 0, -1], [0, 2 / 137, -1], [0, 0, 1]]) @ shot.camera
        on_plane = (points @ R.T + t) @ K.T
        return on_plane[:, :2] / on_plane[:, 2:]


def load_models(root: Path, split: str) -> Iterator[Model]:
    """Every object of a split: every folder is a category, every line of its list a model, also an empty one."""
    categories = [path.name for path in sorted(root.iterdir()) if path.is_dir()]
    metadata = yaml.safe_load((root / "metadata.yaml").read_text())
    for category in categories:
        assert {"id", "name"} <= metadata[category].keys()
        names = (root / category / f"{split}.lst").read_text().split("\n")
        assert names == [""] or "" not in names, "its loader takes an empty line for a model, and warns at every draw"
        for name in filter(None, names):
            yield load_model(root / category / name)


def load_model(folder: Path) -> Model:
    points, cloud = np.load(folder / "points.npz"), np.load(folder / "pointcloud.npz")
    assert points["occupancies"].dtype == np.uint8 and points["points"].dtype != np.float16
    occ = np.unpackbits(points["occupancies"])[: len(points["points"])].astype(np.float32)
    files = sorted(folder.glob("img_choy2016/*.jpg"))
    cameras = np.load(folder / "img_choy2016" / "cameras.npz")
    shots = [
        Shot(np.asarray(Image.open(file).convert("RGB")), cameras[f"world_mat_{n}"], cameras[f"camera_mat_{n}"])
        for n, file in enumerate(files)
    ]
    assert len(cameras) == 2 * len(files)
    place = (points["loc"].astype(np.float32), points["scale"].astype(np.float32))
    np.testing.assert_array_equal(cloud["loc"], points["loc"])
    assert cloud["scale"] == points["scale"]
    parts = (points["points"], occ, cloud["points"], cloud["normals"])
    return Model(folder.parent.name, folder.name, *parts, *place, shots)


@dataclass
class Completion:
    """A sample: partial clouds [N, 3], of which a loader draws one, and the complete one [16384, 3]."""

    category: str
    name: str
    partial: list[NDArray]
    complete: NDArray


def load_completions(root: Path, subset: str) -> Iterator[Completion]:
    """Every model of a subset; eight partial clouds in train, one elsewhere."""
    for one in json.loads((root / "PCN.json").read_text()):
        for name in one[subset]:
            category = one["taxonomy_id"]
            files = [
                root / subset / "partial" / category / name / f"{n:02d}.pcd"
                for n in range(8 if subset == "train" else 1)
            ]
            complete = read_pcd(root / subset / "complete" / category / f"{name}.pcd")
            assert complete.shape == (16384, 3)
            yield Completion(category, name, [read_pcd(file) for file in files], complete)


def read_pcd(path: Path) -> NDArray:
    lines = path.read_text().splitlines()
    assert lines[0].startswith("# .PCD v0.7") and lines[10] == "DATA ascii"
    head = dict(line.split(" ", 1) for line in lines[1:11])
    assert head["FIELDS"] == "x y z" and head["TYPE"] == "F F F" and head["SIZE"] == "4 4 4" and head["HEIGHT"] == "1"
    points = np.loadtxt(lines[11:], ndmin=2)
    assert len(points) == int(head["POINTS"]) == int(head["WIDTH"])
    return points
