"""Format `bop`: the scenewise layout of the BOP benchmark (6-D object pose), one BOP scene for each scene of the dataset.

Images of a scene are the input, aligned and mirror views of its pairs. Poses are model to camera in millimetres, K has
pixel centres on integers, as OpenCV has them. A scene's folder appears whole.
"""

import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.codec import Row, read_matrix
from schemas.errors import plural
from schemas.scene.shape import REGION_FIRST_OBJECT, Part, Shape
from schemas.scene.view import DRAWN_ROLES
from services.dataset.pair import Pair
from services.dataset.view import View
from services.export.formats import LeftOut, Writer, encode_json
from services.export.shapes import (
    Columns,
    Silhouette,
    box_of,
    reaches_edge,
    silhouette_of,
    vertex_colors,
    whole_silhouette,
)
from services.export.source import ExportScene, drawn, labels_of
from services.read.dataset_reader import kinds_of
from workers.geometry.frames import invert
from workers.store.images import encode_mask

NO_SHAPE: Final = "an object is hidden in part, and its shape is neither stored nor here"
_MM = 1000.0
_INFO, _NAMES = "models/models_info.json", "objects.csv"


@dataclass(frozen=True, eq=False)
class _Shot:
    """An image of a scene: its number, its row of `views`, its files by path, and what is said of each object in it."""

    number: int
    view: Columns
    files: dict[str, bytes]
    poses: list[Row] = field(default_factory=list)
    infos: list[Row] = field(default_factory=list)


class Bop(Writer):
    """Writes train/, val/ and test/ with a folder for each scene, and models/; `register` numbers the instances."""

    KEYS: ClassVar = ("render.rgb",)
    FRESH: ClassVar = {"camera": None, "splits": {}, "images": 0, "instances": 0, "models": 0}
    HEADS: ClassVar = {_NAMES: "obj_id,category,instance_id,split,source,licence\n", _INFO: "{"}

    def add(self, scene: ExportScene) -> LeftOut:
        """Writes the scene's folder with its pairs that are whole."""
        self._shots: list[_Shot] = []
        self._place = self.folder.temporary("scene")
        shutil.rmtree(self._place, ignore_errors=True)
        self._numbers = {region: self._number(scene, name) for region, (_, name) in scene.instances.items()}
        return super().add(scene)

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes the pair's images."""
        # Pair k has the images 3 k, 3 k + 1 and 3 k + 2
        first = len(DRAWN_ROLES) * scene.pairs.index(pair)
        shots = [self._shot(scene, view, first + DRAWN_ROLES.index(view.role)) for view in drawn(pair)]
        whole = [shot for shot in shots if shot is not None]
        if len(whole) < len(shots):
            return NO_SHAPE
        for shot in whole:
            for path, data in shot.files.items():
                (self._place / path).parent.mkdir(parents=True, exist_ok=True)
                (self._place / path).write_bytes(data)
            shot.files.clear()
            self._shots.append(shot)
        return ""

    def end_scene(self, scene: ExportScene) -> None:
        """Gives the scene's folder its name, unless a killed export did."""
        trees = {
            "camera": {shot.number: _camera(shot.view) for shot in self._shots},
            "gt": {shot.number: shot.poses for shot in self._shots},
            "gt_info": {shot.number: shot.infos for shot in self._shots},
        }
        for name, tree in trees.items():
            (self._place / f"scene_{name}.json").write_bytes(encode_json(tree))
        path = f"{scene.split}/{scene.scene_id:06d}"
        if not (self.folder.root / path).exists():
            self.folder.install(self._place, path)
        self.count("splits", scene.split)
        self.kept["images"] += len(self._shots)
        self.kept["camera"] = self.kept["camera"] or _sensor(self._shots[0].view)

    def _number(self, scene: ExportScene, instance_id: str) -> int:
        """obj_id of an instance, from 1 in the order of appearance; a new one's model is written, where its shape is here."""
        if known := self.register.of(instance_id):
            return known[0][0]
        number = self.register.add(instance_id)
        asset, shape = scene.assets[instance_id], self.shapes.load(scene, instance_id)
        names = ("category", "instance_id", "split", "source", "licence")
        self.folder.append_row(_NAMES, (number, *(asset[name] for name in names)))
        self.kept["instances"] += 1
        if shape is not None:
            self.folder.put(f"models/obj_{number:06d}.ply", b"".join(ply_lines(shape)))
            comma = "," if self.kept["models"] else ""
            entry = f'{comma}\n "{number}": {json.dumps(model_info(_MM * shape.vertices))}'
            self.folder.append(_INFO, entry.encode())
            self.kept["models"] += 1
        return number

    def _shot(self, scene: ExportScene, view: View, number: int) -> _Shot | None:
        """An image with its masks; None where one of an object cannot be known."""
        region, pixels, has_silhouettes = view.segment(), view.depth(), bool(kinds_of("amodal", view.images))
        files = {f"{kind}/{number:06d}.png": view.png(kind) for kind in ("rgb", "depth")}
        shot = _Shot(number, view.row, files)
        for label in labels_of(view):
            if label["region_id"] < REGION_FIRST_OBJECT:
                continue
            visible = region == label["region_id"]
            stored = view.amodal(label["region_id"]) if has_silhouettes else None
            whole = self._silhouette(scene, label, view.row, visible, stored)
            if whole is None:
                return None
            name = f"{number:06d}_{len(shot.poses):06d}.png"
            shot.files[f"mask/{name}"], shot.files[f"mask_visib/{name}"] = encode_mask(whole.mask), encode_mask(visible)
            R, t = (T := read_matrix(label["T_cam_obj"]))[:3, :3], T[:3, 3]
            pose = {"cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": (_MM * t).tolist()}
            shot.poses.append({**pose, "obj_id": self._numbers[label["region_id"]]})
            shot.infos.append(_info(whole, visible, pixels))
        return shot

    def _silhouette(
        self,
        scene: ExportScene,
        label: Columns,
        view: Columns,
        visible: NDArray[np.bool_],
        stored: NDArray[np.bool_] | None,
    ) -> Silhouette | None:
        """The whole silhouette of an object of which `visible` is seen, None where it cannot be known.

        `stored` is the image `amodal`, where the job asks for it. Where it reaches the image's edge, more lies outside.
        """
        if stored is not None and not reaches_edge(stored):
            return silhouette_of(stored)
        hidden = label["visible_fraction"] < 1.0
        shape = self.shapes.load(scene, label["instance_id"]) if hidden else None
        whole = whole_silhouette(label, view, visible, shape)
        if stored is None:
            return whole
        return silhouette_of(stored) if whole is None else Silhouette(stored, whole.pixels, whole.box)

    def finish(self) -> None:
        """Writes camera.json and ends the list of models."""
        self.folder.append(_INFO, b"\n}\n")
        self.folder.put("camera.json", encode_json(self.kept["camera"] or {}))

    def describe(self) -> dict[str, Any]:
        """Counts, units and frames."""
        missing = self.kept["instances"] - self.kept["models"]
        lost = [f"{plural(missing, 'model')}: neither their shapes nor the job's sources are here"] if missing else []
        rest = "the table and the floor as objects, projected views, patches, textures (models have vertex colours)"
        return {
            "bop_scenes": self.counts("splits"),
            "images": self.kept["images"],
            "models": self.kept["models"],
            "not_exported": [*lost, rest],
            "poses": "model to camera, and world to camera; millimetres, optical frame (x right, y down, z forward)",
            "models_frame": "millimetres, z up, origin at the centre of the bounding box",
            "pixels": "cam_K has pixel centres on integers, as OpenCV has them",
            "depth": "millimetres are the stored value times depth_scale, z along the optical axis",
        }


def _camera(view: Columns) -> Row:
    """An entry of scene_camera.json."""
    T_cam_world = invert(read_matrix(view["T_world_cam"]))
    return {
        "cam_K": [view["fx"], 0.0, view["cx_opencv"], 0.0, view["fy"], view["cy_opencv"], 0.0, 0.0, 1.0],
        "depth_scale": _MM / view["depth_units_per_m"],
        "cam_R_w2c": T_cam_world[:3, :3].ravel().tolist(),
        "cam_t_w2c": (_MM * T_cam_world[:3, 3]).tolist(),
    }


def _sensor(view: Columns) -> Row:
    """camera.json: the sensor of the first image."""
    names = {"width": "width", "height": "height", "fx": "fx", "fy": "fy", "cx": "cx_opencv", "cy": "cy_opencv"}
    return {**{name: view[column] for name, column in names.items()}, "depth_scale": _MM / view["depth_units_per_m"]}


def _info(whole: Silhouette, visible: NDArray[np.bool_], depth: NDArray) -> Row:
    """An entry of scene_gt_info.json; pixels and box of the whole silhouette count what lies outside the image too."""
    seen = int(visible.sum())
    return {
        "bbox_obj": list(whole.box),
        "bbox_visib": list(box_of(visible)),
        "px_count_all": whole.pixels,
        "px_count_valid": int((depth[whole.mask] > 0).sum()),
        "px_count_visib": seen,
        "visib_fract": seen / whole.pixels if whole.pixels else 0.0,
    }


_AT_ONCE = 512
"""Rows of a block of distances: some tens of megabytes at most."""


def model_info(vertices_mm: Array) -> dict[str, float]:
    """Bounding box and diameter, the largest distance between two vertices, in millimetres."""
    low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
    sizes = dict(zip(("min_x", "min_y", "min_z"), low.tolist(), strict=True))
    sizes |= dict(zip(("size_x", "size_y", "size_z"), (high - low).tolist(), strict=True))
    return {"diameter": _diameter(np.unique(vertices_mm, axis=0) - (low + high) / 2.0), **sizes}


def _diameter(points: Array) -> float:
    """The largest distance between two of `points` [N, 3], by all pairs that can be as far apart as the largest found so far.

    Two points are at most the sum of their distances from the origin apart, so the points go from far to near.
    """
    squared = np.einsum("ij,ij->i", points, points)
    order = np.argsort(-squared)
    points, squared = points[order], squared[order]
    reach, largest = np.sqrt(squared), 0.0
    for first in range(0, len(points), _AT_ONCE):
        end = int(np.searchsorted(-reach, reach[first] - largest, side="right"))
        if end <= first:
            break
        block = slice(first, first + _AT_ONCE)
        apart = squared[block, None] - 2.0 * points[block] @ points[first:end].T + squared[first:end]
        largest = max(largest, math.sqrt(max(float(apart.max()), 0.0)))
    return largest


def ply_lines(shape: Shape) -> Iterator[bytes]:
    """An ASCII PLY file: vertices in millimetres, unit normals, colours, and triangles."""
    mesh, colors = shape.mesh, np.concatenate([vertex_colors(part) for part in shape.parts])
    normals = np.concatenate([_normals(part) for part in shape.parts])
    floats, letters = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    header = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in floats] + [f"property uchar {name}" for name in letters]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    yield "".join(f"{line}\n" for line in header).encode()
    rows = zip((_MM * mesh.vertices).tolist(), normals.tolist(), colors.tolist(), strict=True)
    line = "%.9g %.9g %.9g %.6g %.6g %.6g %d %d %d\n"
    yield "".join(line % (*xyz, *normal, *rgb) for xyz, normal, rgb in rows).encode()
    yield "".join(f"3 {a} {b} {c}\n" for a, b, c in mesh.faces.tolist()).encode()


def _normals(part: Part) -> Array:
    """[V, 3]: those of the part, else the mean of the faces about each vertex, weighed by their angles."""
    if part.normals is not None:
        return part.normals
    return np.asarray(trimesh.Trimesh(part.vertices, part.faces, process=False).vertex_normals)
