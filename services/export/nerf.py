"""Format `nerf`: a folder for each scene with a transforms.json, as nerfstudio reads it.

    train/000017/transforms.json            the whole scene
    train/000017/transforms_objects.json    the same with masks: only its objects count
    train/000017/images/00034_input.png     depths/ in millimetres and masks/ likewise

Cameras look along -z with y up (OpenGL), and poses are camera to world in the dataset's world: metres, z up. cx, cy have pixel
centres at +0.5. Input and mirror views are for training; those of the depth camera beside the input camera, where the dataset
has them, are for evaluation.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np

from schemas.dataset.codec import Row, read_matrix, read_world_poses
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import DRAWN_ROLES, Role
from services.export.formats import Added, Writer, encode_json
from services.export.source import MM_PER_M, OPENGL_FROM_OPTICAL, SIDES, ExportPair, ExportScene
from workers.store.images import encode_mask

_SIZES: Final = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
"""Names of nerfstudio, and the columns of `views`."""


class Nerf(Writer):
    """Writes every drawn view that has colour."""

    FRESH: ClassVar = {"scenes": {}, "frames": 0}

    def add(self, scene: ExportScene) -> Added:
        """Writes the scene's folder with its pairs that are whole; transforms.json comes last."""
        folder, left_out = f"{scene.split}/{scene.scene_id:06d}", []
        frames: dict[Role, list[Row]] = {role: [] for role in DRAWN_ROLES}
        for pair in scene.pairs:
            roles = [role for role in DRAWN_ROLES if role in pair.views]
            if missing := next((role for role in roles if pair.image(role, "rgb") is None), None):
                left_out.append((pair.pose_id, f"no rgb of the {missing} view"))
                continue
            for role in roles:
                frames[role].append(self._write(folder, pair, role))
        if any(frames.values()):
            tree = transforms(frames, self._lens, scene)
            for name, masked in (("transforms_objects", True), ("transforms", False)):
                self.folder.put(f"{folder}/{name}.json", encode_json(tree if masked else _without_masks(tree)))
            self.count("scenes", scene.split, 1)
            self.kept["frames"] += sum(map(len, frames.values()))
        return Added(len(scene.pairs) - len(left_out), tuple(left_out))

    @property
    def _lens(self) -> dict[str, float]:
        """The lens distortion of colour."""
        lens = self.record.job.sensor.distortion
        return {} if lens is None else lens.model_dump()

    def _write(self, folder: str, pair: ExportPair, role: Role) -> Row:
        """The frame of a view whose files are written; depth and masks, which are a pinhole camera's, without distortion."""
        view, name = pair.views[role], f"{pair.views[role]['parent_id']:05d}_{role}.png"
        rgb, depth, region = pair.image(role, "rgb"), pair.depth(role, MM_PER_M), pair.pixels(role, "region")
        assert rgb is not None and depth is not None and region is not None
        files = {"images": rgb, "depths": depth, "masks": encode_mask(region >= REGION_FIRST_OBJECT)}
        keys = {"images": "file_path", "depths": "depth_file_path", "masks": "mask_path"}
        kinds = ["images"] if self._lens else list(files)
        for kind in kinds:
            self.folder.put(f"{folder}/{kind}/{name}", files[kind])
        matrix = read_matrix(view["T_world_cam"]) @ OPENGL_FROM_OPTICAL
        sizes = {key: view[column] for key, column in _SIZES.items()}
        return {**{keys[kind]: f"{kind}/{name}" for kind in kinds}, **sizes, "transform_matrix": matrix.tolist()}

    def describe(self) -> dict[str, Any]:
        """Scenes by split, and the conventions."""
        pinhole = ["depth and masks: they are a pinhole camera's, and colour has a lens"] if self._lens else []
        return {
            "nerf_scenes": dict(sorted(self.kept["scenes"].items())),
            "frames": self.kept["frames"],
            "not_exported": ["projected views, patches", *pinhole],
            "poses": "camera to world, metres, z up; the camera looks along -z, y up (OpenGL)",
            "depth": "millimetres (depth_unit_scale_factor 0.001), z along the optical axis, 0 is no depth",
            "pixels": "cx, cy have pixel centres at +0.5",
        }


def transforms(frames: Mapping[Role, list[Row]], lens: Mapping[str, float], scene: ExportScene) -> Row:
    """The tree of transforms.json; `objects` is for people: those loaders do not look at it."""
    paths = {role: [frame["file_path"] for frame in of] for role, of in frames.items()}
    training = [path for role in SIDES for path in paths.get(role, [])]
    held_out = [path for role in paths if role not in SIDES for path in paths[role]] or training
    poses = read_world_poses(scene.row)
    return {
        "camera_model": "OPENCV",
        **lens,
        "train_filenames": training,
        "val_filenames": held_out,
        "test_filenames": held_out,
        "objects": [
            {"category": category, "instance_id": name, "transform_matrix": np.asarray(poses[region_id]).tolist()}
            for region_id, (category, name) in scene.instances.items()
        ],
        "frames": [frame for of in frames.values() for frame in of],
    }


def _without_masks(tree: Row) -> Row:
    return {
        **tree,
        "frames": [{key: value for key, value in one.items() if key != "mask_path"} for one in tree["frames"]],
    }
