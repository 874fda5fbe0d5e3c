"""Formats of graphics programs, whose cameras look along -z with y up (OpenGL): `gltf` and `nerf` (docs/export.md).

glTF's y is up, the world's z is: a root node turns one into the other. Poses of `nerf` are camera to world, metres, z up; cx, cy
have pixel centres at +0.5. Its views are for training; those of the depth camera beside the input camera, where the dataset has
them, are for evaluation. instant-ngp reads `depth_path` and alpha, nerfstudio `depth_file_path` and `mask_path`.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np

from schemas.dataset.codec import Row, read_world_poses
from schemas.errors import CorruptError, SceneError, VersoError
from schemas.scene.shape import is_object
from schemas.scene.view import DRAWN_ROLES, Role
from services.dataset.pair import Pair
from services.dataset.view import View
from services.export.formats import LeftOut, Writer, encode_json
from services.export.source import MM_PER_M, SIDES, ExportScene, all_drawn, depth_of
from services.read.scene_geometry import pose_shapes
from workers.assets.glb import join_glb
from workers.door.opening import split_glb
from workers.store.images import encode_mask

OPENGL_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])
NO_SOURCES = "the sources of the shapes are not here, or have changed"

_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""x, y, z, w of the rotation that takes z to y."""
_NEAR_M = 0.05


class Gltf(Writer):
    """Writes <category>/<scene id>.glb."""

    FRESH: ClassVar = {"files": {}}

    def add(self, scene: ExportScene) -> LeftOut:
        """Writes the scene's file."""
        try:
            posed = pose_shapes(self.request.store.read, scene.row, scene.assets.values(), self.sources)
        except CorruptError:
            raise
        except (VersoError, OSError) as error:
            reason = f"its shapes cannot be made again: {error.reason}" if isinstance(error, SceneError) else NO_SOURCES
            return [(pair.pose_id, reason) for pair in scene.pairs]
        views = [view for pair in scene.pairs for view in all_drawn(pair)]
        seen = with_cameras(posed.export(file_type="glb"), views)
        self.folder.put(f"{scene.category}/{scene.scene_id:06d}.glb", seen)
        self.count("files", scene.category)
        return []

    def describe(self) -> dict[str, Any]:
        """Files by category, and the frame."""
        return {
            "files": self.counts("files"),
            "not_exported": ["images and labels: the cameras stand where the views were taken from"],
            "frame": "metres; below the root node the world frame of the dataset, z up, turned to glTF's y up by that node",
            "cameras": "named by role, number and pose id; a field of view and an aspect ratio, without the principal point",
        }


def with_cameras(glb: bytes, views: list[View]) -> bytes:
    """A GLB file with a camera for each view, and a root node that turns the world's z up to glTF's y."""
    tree, binary = split_glb(glb)
    nodes, cameras = tree["nodes"], tree.setdefault("cameras", [])
    roots = list(tree["scenes"][0]["nodes"])
    for view in views:
        matrix, k = view.T_world_cam @ OPENGL_FROM_OPTICAL, view.camera.intrinsics
        name = f"{view.name} {view.pose_id}"
        roots.append(len(nodes))
        nodes.append({"name": name, "camera": len(cameras), "matrix": matrix.T.ravel().tolist()})
        width, height = k.width / k.fx, k.height / k.fy
        lens = {"yfov": 2.0 * math.atan(0.5 * height), "aspectRatio": width / height, "znear": _NEAR_M}
        cameras.append({"name": name, "type": "perspective", "perspective": lens})
    tree["scenes"][0]["nodes"] = [len(nodes)]
    nodes.append({"name": "z up", "rotation": _Y_UP, "children": roots})
    return join_glb(tree, binary)


_SIZES: Final = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
"""Names of nerfstudio, and the columns of `views`."""


class Nerf(Writer):
    """Writes every drawn view that has colour."""

    KEYS: ClassVar = ("render.rgb",)
    FRESH: ClassVar = {"scenes": {}, "frames": 0}

    def add(self, scene: ExportScene) -> LeftOut:
        """Writes the scene's folder; transforms.json comes last."""
        self._folder = f"{scene.split}/{scene.scene_id:06d}"
        self._frames: dict[Role, list[Row]] = {role: [] for role in DRAWN_ROLES}
        return super().add(scene)

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes the pair's views."""
        for view in all_drawn(pair):
            self._frames.setdefault(view.role, []).append(self._write(view))
        return ""

    def end_scene(self, scene: ExportScene) -> None:
        """Writes what lists the frames, with masks and without."""
        tree = transforms(self._frames, self._lens, scene)
        self.folder.put(f"{self._folder}/transforms_objects.json", encode_json(tree))
        for frame in tree["frames"]:
            frame.pop("mask_path", None)
        self.folder.put(f"{self._folder}/transforms.json", encode_json(tree))
        self.count("scenes", scene.split)
        self.kept["frames"] += len(tree["frames"])

    @property
    def _lens(self) -> dict[str, float]:
        """The lens distortion of colour."""
        lens = self.record.job.sensor.distortion
        return {} if lens is None else lens.model_dump()

    def _write(self, view: View) -> Row:
        """The frame of a view whose files are written; depth and masks, which are a pinhole camera's, without distortion."""
        name, mask = f"{view.row['parent_id']:05d}_{view.name}.png", encode_mask(is_object(view.segment()))
        files = {"images": view.png("rgb"), "depths": depth_of(view, MM_PER_M), "masks": mask}
        keys = {"images": ("file_path",), "depths": ("depth_file_path", "depth_path"), "masks": ("mask_path",)}
        kinds = ["images"] if self._lens else list(files)
        for kind in kinds:
            self.folder.put(f"{self._folder}/{kind}/{name}", files[kind])
        matrix = view.T_world_cam @ OPENGL_FROM_OPTICAL
        sizes = {key: view.row[column] for key, column in _SIZES.items()}
        paths = {key: f"{kind}/{name}" for kind in kinds for key in keys[kind]}
        return {**paths, **sizes, "transform_matrix": matrix.tolist()}

    def describe(self) -> dict[str, Any]:
        """Scenes by split, and the conventions."""
        pinhole = ["depth and masks: they are a pinhole camera's, and colour has a lens"] if self._lens else []
        return {
            "nerf_scenes": self.counts("scenes"),
            "frames": self.kept["frames"],
            "not_exported": ["projected views, patches", *pinhole],
            "poses": "camera to world, metres, z up; the camera looks along -z, y up (OpenGL)",
            "depth": "millimetres (depth_unit_scale_factor 0.001), z along the optical axis, 0 is no depth",
            "pixels": "cx, cy have pixel centres at +0.5",
        }


def transforms(frames: Mapping[Role, list[Row]], lens: Mapping[str, float], scene: ExportScene) -> Row:
    """The tree of transforms.json; `objects` is for people: those loaders do not look at it."""
    paths = {role: [frame["file_path"] for frame in of] for role, of in frames.items()}
    beside = [role for role in DRAWN_ROLES if role not in SIDES]
    training = [path for role in paths if role not in beside for path in paths[role]]
    held_out = [path for role in beside for path in paths.get(role, [])] or training
    poses = read_world_poses(scene.row)
    every = [frame for of in frames.values() for frame in of]
    pinholes = [{key: frame[key] for key in _SIZES} for frame in every]
    return {
        "camera_model": "OPENCV",
        **(pinholes[0] if all(pinhole == pinholes[0] for pinhole in pinholes) else {}),
        "integer_depth_scale": 1.0 / MM_PER_M,
        **lens,
        "train_filenames": training,
        "val_filenames": held_out,
        "test_filenames": held_out,
        "objects": [
            {"category": category, "instance_id": name, "transform_matrix": np.asarray(poses[region_id]).tolist()}
            for region_id, (category, name) in scene.instances.items()
        ],
        "frames": every,
    }
