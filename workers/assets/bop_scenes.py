"""Scenes in the BOP layout as tables of scenes: `scene_gt.json`, `scene_camera.json`, and beside the models `objects.csv`.

BOP has millimetres, poses from the model and from the world to the camera, and pixel centres on integers.
"""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import Array, Pose
from schemas.scene.view import DRAWN_ROLES
from workers.geometry.frames import invert

GT, CAMERA, NAMES, SIZE = "scene_gt.json", "scene_camera.json", "objects.csv", "camera.json"
_MM = 1000.0


def find_bop_scenes(path: Path) -> dict[int, Path]:
    """The folders of scenes by their numbers: the folder itself, or those in it."""
    folders = [path] if (path / GT).exists() else [file.parent for file in path.glob(f"*/{GT}")]
    return {int(folder.name): folder for folder in folders if folder.name.isdecimal()}


def bop_files(path: Path) -> list[Path]:
    """All that is read. Raises ValueError where nothing says which shapes the objects are, or how large images are."""
    root = next((folder for folder in (path, *list(path.parents)[:2]) if (folder / NAMES).is_file()), None)
    if root is None:
        raise ValueError(
            f"says of objects their obj_id alone, and no {NAMES} beside it says which shapes these are: write one with the "
            "columns obj_id and instance_id, of shapes that assets.objects offers"
        )
    if not (root / SIZE).is_file():
        raise ValueError(f"has no {SIZE} beside {root / NAMES}: write one with the width and height of the images")
    files = (folder / name for folder in find_bop_scenes(path).values() for name in (GT, CAMERA))
    return [root / NAMES, root / SIZE, *sorted(files)]


def bop_ids(path: Path) -> Array:
    """[N] int64: the numbers of the scenes. Raises as `bop_files`."""
    bop_files(path)
    return np.array(sorted(find_bop_scenes(path)), np.int64)


def bop_rows(path: Path, scene_id: int) -> list[dict[str, Any]]:
    """Objects where the first image has them, and the cameras of all images; of an export of ours those of input views.

    Other models have frames of their own: poses are those of their sources. Raises ValueError, KeyError and OSError.
    """
    names, size, *_ = bop_files(path)
    folder, root, image = find_bop_scenes(path)[scene_id], names.parent, json.loads(size.read_bytes())
    objects, cameras = (
        {int(number): entry for number, entry in json.loads((folder / name).read_bytes()).items()}
        for name in (GT, CAMERA)
    )
    with open(names, newline="") as lines:
        instances = {int(row["obj_id"]): row["instance_id"] for row in csv.DictReader(lines)}
    if lost := [number for number, camera in cameras.items() if "cam_R_w2c" not in camera]:
        raise ValueError(f"image {lost[0]} of scene {scene_id} has no cam_R_w2c, which says where the world is: add it")
    T_world_cam = {
        number: invert(_from_mm(camera["cam_R_w2c"], camera["cam_t_w2c"])) for number, camera in sorted(cameras.items())
    }
    first = min(objects)
    if unknown := {body["obj_id"] for body in objects[first]} - instances.keys():
        raise ValueError(f"{names} has no obj_id {min(unknown)}: add its line")
    T_world_obj = [T_world_cam[first] @ _from_mm(body["cam_R_m2c"], body["cam_t_m2c"]) for body in objects[first]]
    is_ours = (root / "export.json").exists()
    bodies = [
        {"instance_id": instances[body["obj_id"]], "T_world_obj": T.tolist(), "of_source": not is_ours}
        for body, T in zip(objects[first], T_world_obj, strict=True)
    ]
    step = len(DRAWN_ROLES) if is_ours else 1
    return bodies + [
        {
            "T_world_cam": T.tolist(),
            **_pinhole(cameras[number]["cam_K"]),
            **{name: image[name] for name in ("width", "height")},
        }
        for number, T in T_world_cam.items()
        if number % step == 0
    ]


def _from_mm(R: Sequence[float], t_mm: Sequence[float]) -> Pose:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.reshape(R, (3, 3)), np.array(t_mm) / _MM
    return T


def _pinhole(K: Sequence[float]) -> dict[str, Any]:
    return {"fx": K[0], "fy": K[4], "cx": K[2] + 0.5, "cy": K[5] + 0.5}
