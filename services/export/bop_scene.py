"""One scene of a BOP export: its images, masks, and the three files that describe them."""

import json
import shutil
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.codec import Row, read_matrix
from schemas.scene.camera import Role
from schemas.scene.region import REGION_FIRST_OBJECT
from services.export.folder import ExportFolder
from services.export.shapes import Shapes
from services.export.silhouette import Silhouette, box_of, whole_silhouette
from services.export.source import ExportPair, ExportScene
from workers.geometry.frames import invert
from workers.store.images import decode_png, encode_mask

ROLES: Final[tuple[Role, ...]] = ("input", "aligned", "mirror")
"""Pair k has the images 3 k, 3 k + 1 and 3 k + 2 of its scene."""

NO_SHAPE: Final = "an object is hidden in part, and its shape is neither stored nor here"
_MM = 1000.0


@dataclass(frozen=True, eq=False)
class _Thing:
    """An object in an image: its row of `objects`, what is seen of it [H, W], and its whole silhouette."""

    label: Row
    visible: NDArray[np.bool_]
    whole: Silhouette


@dataclass(frozen=True, eq=False)
class _Shot:
    """An image of a scene: its number, its row of `views`, two PNG files, and the objects in it."""

    number: int
    view: Row
    rgb: bytes
    depth: bytes
    things: tuple[_Thing, ...]


class SceneDraft:
    """The folder of one scene while it is written."""

    def __init__(self, folder: ExportFolder, scene: ExportScene, numbers: dict[int, int], shapes: Shapes) -> None:
        self._folder, self._scene, self._numbers, self._shapes = folder, scene, numbers, shapes
        self._place = folder.temporary("scene")
        shutil.rmtree(self._place, ignore_errors=True)
        self.cameras: dict[int, Row] = {}
        self.sensor: dict[str, Any] | None = None
        self._poses: dict[int, list[Row]] = {}
        self._infos: dict[int, list[Row]] = {}

    def add(self, pair: ExportPair) -> str:
        """Writes the images of a pair; a reason why not, empty where it was written."""
        shots = []
        for place, role in enumerate(ROLES):
            if role in pair.views:
                shot = self._shot(len(ROLES) * pair.number + place, pair, role)
                if isinstance(shot, str):
                    return shot
                shots.append(shot)
        for shot in shots:
            self._write(shot)
        return ""

    def _shot(self, number: int, pair: ExportPair, role: Role) -> "_Shot | str":
        """An image with its masks, or a reason why there is none."""
        rgb, region, depth = pair.image(role, "rgb"), pair.pixels(role, "region"), pair.image(role, "depth")
        if rgb is None or region is None or depth is None:
            return f"no {'rgb' if rgb is None else 'labels'} of the {role} view"
        things = []
        for label in pair.labels(role):
            if label["region_id"] >= REGION_FIRST_OBJECT:
                visible = region == label["region_id"]
                whole = self._silhouette(label, pair.views[role], visible)
                if whole is None:
                    return NO_SHAPE
                things.append(_Thing(label, visible, whole))
        return _Shot(number, pair.views[role], rgb, depth, tuple(things))

    def install(self, path: str) -> None:
        """Gives the folder its name, unless a killed export did."""
        for name, tree in (("camera", self.cameras), ("gt", self._poses), ("gt_info", self._infos)):
            (self._place / f"scene_{name}.json").write_bytes(encode_json(tree))
        if not (self._folder.root / path).exists():
            self._folder.install(self._place, path)

    def _silhouette(self, label: Row, view: Row, visible: NDArray[np.bool_]) -> Silhouette | None:
        hidden = label["visible_fraction"] < 1.0
        colored = self._shapes.load(self._scene, label["instance_id"]) if hidden else None
        return whole_silhouette(label, view, visible, None if colored is None else colored.shape)

    def _write(self, shot: "_Shot") -> None:
        self.cameras[shot.number] = _camera(shot.view)
        self.sensor = self.sensor or _sensor(shot.view)
        self._write_file(f"rgb/{shot.number:06d}.png", shot.rgb)
        self._write_file(f"depth/{shot.number:06d}.png", shot.depth)
        depth = decode_png(shot.depth)
        for number, thing in enumerate(shot.things):
            self._write_file(f"mask/{shot.number:06d}_{number:06d}.png", encode_mask(thing.whole.mask))
            self._write_file(f"mask_visib/{shot.number:06d}_{number:06d}.png", encode_mask(thing.visible))
        self._poses[shot.number] = [_pose(self._numbers[one.label["region_id"]], one.label) for one in shot.things]
        self._infos[shot.number] = [_info(one, depth) for one in shot.things]

    def _write_file(self, path: str, data: bytes) -> None:
        target = self._place / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)


def encode_json(tree: object) -> bytes:
    """A JSON file."""
    return (json.dumps(tree, indent=1) + "\n").encode()


def _camera(view: Row) -> Row:
    """An entry of scene_camera.json."""
    T_cam_world = invert(read_matrix(view["T_world_cam"]))
    return {
        "cam_K": [view["fx"], 0.0, view["cx_opencv"], 0.0, view["fy"], view["cy_opencv"], 0.0, 0.0, 1.0],
        "depth_scale": _MM / view["depth_units_per_m"],
        "cam_R_w2c": T_cam_world[:3, :3].ravel().tolist(),
        "cam_t_w2c": (_MM * T_cam_world[:3, 3]).tolist(),
    }


def _sensor(view: Row) -> dict[str, Any]:
    """camera.json: the sensor of the first image."""
    names = {"width": "width", "height": "height", "fx": "fx", "fy": "fy", "cx": "cx_opencv", "cy": "cy_opencv"}
    return {**{name: view[column] for name, column in names.items()}, "depth_scale": _MM / view["depth_units_per_m"]}


def _pose(number: int, label: Row) -> Row:
    """An entry of scene_gt.json."""
    T = read_matrix(label["T_cam_obj"])
    return {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (_MM * T[:3, 3]).tolist(), "obj_id": number}


def _info(thing: "_Thing", depth: NDArray) -> Row:
    """An entry of scene_gt_info.json; pixels and box of the whole silhouette count what lies outside the image too."""
    whole, seen = thing.whole, int(thing.visible.sum())
    return {
        "bbox_obj": list(whole.box),
        "bbox_visib": list(box_of(thing.visible)),
        "px_count_all": whole.pixels,
        "px_count_valid": int((depth[whole.mask] > 0).sum()),
        "px_count_visib": seen,
        "visib_fract": seen / whole.pixels if whole.pixels else 0.0,
    }
