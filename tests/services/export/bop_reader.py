"""A reader of the scenewise BOP layout, written from its published description: it imports nothing of this project."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.services.export.image_loaders import read_picture


@dataclass
class Model:
    """A PLY file: vertices [V, 3] mm, normals [V, 3], colours [V, 3], faces [F, 3]."""

    vertices: NDArray
    normals: NDArray
    colors: NDArray
    faces: NDArray


@dataclass
class Thing:
    """An annotated object: T_cam_model in millimetres, what is said of it, and both masks [H, W] bool."""

    obj_id: int
    T_cam_model: NDArray
    info: dict[str, Any]
    mask: NDArray
    mask_visib: NDArray


@dataclass
class Shot:
    """An image of a scene: K, T_cam_world in millimetres, depth in millimetres, RGB, and its objects."""

    scene: int
    number: int
    K: NDArray
    T_cam_world: NDArray
    depth_mm: NDArray
    rgb: NDArray
    things: list[Thing]


def transform_of(entry: dict[str, Any], name: str) -> NDArray:
    T = np.eye(4)
    T[:3, :3] = np.reshape(entry[f"cam_R_{name}"], (3, 3))
    T[:3, 3] = entry[f"cam_t_{name}"]
    return T


def load_shots(split: Path) -> Iterator[Shot]:
    """Every image of every scene below train/, val/ or test/."""
    for folder in sorted(split.iterdir()):
        assert len(folder.name) >= 6 and folder.name.isdigit()
        cameras, poses, infos = (
            json.loads((folder / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")
        )
        assert list(cameras) == list(poses) == list(infos) == sorted(cameras, key=int)
        for number in cameras:
            yield load_shot(folder, int(number), cameras[number], list(zip(poses[number], infos[number], strict=True)))


def load_shot(folder: Path, number: int, camera: dict[str, Any], entries: list[tuple[dict, dict]]) -> Shot:
    depth = read_picture(folder / "depth" / f"{number:06d}.png")
    assert depth.dtype == np.uint16
    things = []
    for place, (pose, info) in enumerate(entries):
        masks = [read_picture(folder / kind / f"{number:06d}_{place:06d}.png") for kind in ("mask", "mask_visib")]
        assert all(mask.dtype == np.uint8 and mask.shape == depth.shape for mask in masks)
        assert all(set(np.unique(mask)) <= {0, 255} for mask in masks)
        things.append(Thing(pose["obj_id"], transform_of(pose, "m2c"), info, masks[0] > 0, masks[1] > 0))
    rgb = read_picture(folder / "rgb" / f"{number:06d}.png")[..., ::-1]
    K, depth_mm = np.reshape(camera["cam_K"], (3, 3)), depth * camera["depth_scale"]
    return Shot(int(folder.name), number, K, transform_of(camera, "w2c"), depth_mm, rgb, things)


def load_model(path: Path) -> Model:
    lines = path.read_text().splitlines()
    end = lines.index("end_header")
    header = [line.split() for line in lines[:end]]
    assert header[0] == ["ply"] and header[1] == ["format", "ascii", "1.0"]
    counts = {words[1]: int(words[2]) for words in header if words[0] == "element"}
    names = [words[2] for words in header if words[0] == "property" and words[1] != "list"]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    body = lines[end + 1 :]
    assert len(body) == counts["vertex"] + counts["face"]
    table = np.array([line.split() for line in body[: counts["vertex"]]], float)
    faces = np.array([line.split() for line in body[counts["vertex"] :]], int)
    assert (faces[:, 0] == 3).all()
    return Model(table[:, :3], table[:, 3:6], table[:, 6:], faces[:, 1:])


def points_in_model(shot: Shot, thing: Thing, mask: NDArray) -> NDArray:
    """[N, 3] what the depth image shows of an object, in its model's frame: pixel (column, row) is the ray K^-1 (c, r, 1)."""
    rows, columns = np.nonzero(mask & (shot.depth_mm > 0))
    rays = np.linalg.inv(shot.K) @ np.stack([columns, rows, np.ones_like(rows)])
    points = rays * shot.depth_mm[rows, columns]
    inverse = np.linalg.inv(thing.T_cam_model)
    return (inverse[:3, :3] @ points + inverse[:3, 3:]).T
