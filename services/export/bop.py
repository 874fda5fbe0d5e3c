"""Format `bop`: the scenewise layout of the BOP benchmark (6-D object pose), one BOP scene for each scene of the dataset.

Images of a scene are the input, aligned and mirror views of its pairs. Poses are model to camera in millimetres, K has
pixel centres on integers, as OpenCV has them. A scene's folder appears whole.
"""

import csv
import io
import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.codec import Row, read_matrix
from schemas.errors import plural
from schemas.scene.shape import REGION_FIRST_OBJECT, Part
from schemas.scene.view import DRAWN_ROLES, Role
from services.export.folder import ExportFolder, Register
from services.export.formats import Added, ExportRequest, Writer, encode_json
from services.export.shapes import (
    ColoredShape,
    Shapes,
    Silhouette,
    box_of,
    reaches_edge,
    silhouette_of,
    whole_silhouette,
)
from services.export.source import ExportPair, ExportScene
from workers.geometry.frames import invert
from workers.store.images import decode_png, encode_mask

NO_SHAPE: Final = "an object is hidden in part, and its shape is neither stored nor here"
_MM = 1000.0


@dataclass(frozen=True, eq=False)
class _Shot:
    """An image of a scene: its number, its row of `views`, its files by path, and what is said of each object in it."""

    number: int
    view: Row
    files: dict[str, bytes]
    poses: list[Row] = field(default_factory=list)
    infos: list[Row] = field(default_factory=list)


class Bop(Writer):
    """Writes train/, val/ and test/ with a folder for each scene, and models/."""

    FRESH: ClassVar = {"models": None, "camera": None, "splits": {}, "images": 0}

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Opens the list of objects."""
        self._shapes = Shapes(self.record)
        self._models = BopModels(self.folder, self.kept["models"])

    def add(self, scene: ExportScene) -> Added:
        """Writes the scene's folder with its pairs that are whole."""
        place = self.folder.temporary("scene")
        shutil.rmtree(place, ignore_errors=True)
        numbers = {region: self._number(scene, name) for region, (_, name) in scene.instances.items()}
        written: list[_Shot] = []
        left_out = []
        for pair in scene.pairs:
            shots = [self._shot(scene, pair, role, numbers) for role in DRAWN_ROLES if role in pair.views]
            if reason := next((shot for shot in shots if isinstance(shot, str)), None):
                left_out.append((pair.pose_id, reason))
                continue
            for shot in (shot for shot in shots if isinstance(shot, _Shot)):
                for path, data in shot.files.items():
                    (place / path).parent.mkdir(parents=True, exist_ok=True)
                    (place / path).write_bytes(data)
                shot.files.clear()
                written.append(shot)
        if written:
            self._install(place, f"{scene.split}/{scene.scene_id:06d}", written)
            self.count("splits", scene.split, 1)
            self.kept["images"] += len(written)
            self.kept["camera"] = self.kept["camera"] or _sensor(written[0].view)
        return Added(len(scene.pairs) - len(left_out), tuple(left_out))

    def _number(self, scene: ExportScene, instance_id: str) -> int:
        known = self._models.number(instance_id)
        if known is not None:
            return known
        return self._models.add(scene.assets[instance_id], self._shapes.load(scene, instance_id))

    def _shot(self, scene: ExportScene, pair: ExportPair, role: Role, numbers: dict[int, int]) -> _Shot | str:
        """An image with its masks, or a reason why there is none."""
        rgb, region, depth = pair.image(role, "rgb"), pair.pixels(role, "region"), pair.image(role, "depth")
        if rgb is None or region is None or depth is None:
            return f"no {'rgb' if rgb is None else 'labels'} of the {role} view"
        # Pair k has the images 3 k, 3 k + 1 and 3 k + 2
        number = len(DRAWN_ROLES) * pair.number + DRAWN_ROLES.index(role)
        view, pixels = pair.views[role], decode_png(depth)
        shot = _Shot(number, view, {f"rgb/{number:06d}.png": rgb, f"depth/{number:06d}.png": depth})
        silhouettes = pair.stack(role, "amodal")
        for label in pair.labels(role):
            if label["region_id"] < REGION_FIRST_OBJECT:
                continue
            visible = region == label["region_id"]
            stored = None if silhouettes is None else silhouettes[label["region_id"] - REGION_FIRST_OBJECT] > 0
            whole = self._silhouette(scene, label, view, visible, stored)
            if whole is None:
                return NO_SHAPE
            name = f"{number:06d}_{len(shot.poses):06d}.png"
            shot.files[f"mask/{name}"], shot.files[f"mask_visib/{name}"] = encode_mask(whole.mask), encode_mask(visible)
            shot.poses.append(_pose(numbers[label["region_id"]], label))
            shot.infos.append(_info(whole, visible, pixels))
        return shot

    def _silhouette(
        self, scene: ExportScene, label: Row, view: Row, visible: NDArray[np.bool_], stored: NDArray[np.bool_] | None
    ) -> Silhouette | None:
        """The whole silhouette of an object of which `visible` is seen, None where it cannot be known.

        `stored` is the image `amodal`, where the job asks for it. Where it reaches the image's edge, more lies outside.
        """
        if stored is not None and not reaches_edge(stored):
            return silhouette_of(stored)
        hidden = label["visible_fraction"] < 1.0
        colored = self._shapes.load(scene, label["instance_id"]) if hidden else None
        whole = whole_silhouette(label, view, visible, None if colored is None else colored.shape)
        if stored is None:
            return whole
        return silhouette_of(stored) if whole is None else Silhouette(stored, whole.pixels, whole.box)

    def _install(self, place: Path, path: str, shots: list[_Shot]) -> None:
        """Gives a scene's folder its name, unless a killed export did."""
        trees = {
            "camera": {shot.number: _camera(shot.view) for shot in shots},
            "gt": {shot.number: shot.poses for shot in shots},
            "gt_info": {shot.number: shot.infos for shot in shots},
        }
        for name, tree in trees.items():
            (place / f"scene_{name}.json").write_bytes(encode_json(tree))
        if not (self.folder.root / path).exists():
            self.folder.install(place, path)

    def state(self) -> dict[str, Any]:
        """Numbers of objects, and counts."""
        return {**self.kept, "models": self._models.state()}

    def finish(self) -> None:
        """Writes camera.json and ends the list of models."""
        self._models.finish()
        self.folder.put("camera.json", encode_json(self.kept["camera"] or {}))

    def close(self) -> None:
        """Closes the list of objects."""
        self._models.close()

    def describe(self) -> dict[str, Any]:
        """Counts, units and frames."""
        missing = self._models.without
        return {
            "bop_scenes": dict(sorted(self.kept["splits"].items())),
            "images": self.kept["images"],
            "models": self._models.count - missing,
            "not_exported": [
                *(
                    [f"{plural(missing, 'model')}: neither their shapes nor the job's sources are here"]
                    if missing
                    else []
                ),
                "the table and the floor as objects, projected views, patches, textures (models have vertex colours)",
            ],
            "poses": "model to camera, and world to camera; millimetres, optical frame (x right, y down, z forward)",
            "models_frame": "millimetres, z up, origin at the centre of the bounding box",
            "pixels": "cam_K has pixel centres on integers, as OpenCV has them",
            "depth": "millimetres are the stored value times depth_scale, z along the optical axis",
        }


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


_INFO, _NAMES = "models/models_info.json", "objects.csv"
_AT_ONCE = 512
"""Rows of a block of distances: some tens of megabytes at most."""


class BopModels:
    """Gives each instance its number, obj_id, from 1, and writes its model in millimetres when it first appears."""

    def __init__(self, folder: ExportFolder, state: dict[str, Any] | None) -> None:
        self._folder, begun = folder, state or {"objects": 0, "without_model": 0, "first": True}
        self._register = Register(folder, begun["objects"])
        self.count: int = begun["objects"]
        """How many instances have a number."""
        self.without: int = begun["without_model"]
        """Objects whose shape is not here."""
        self._first: bool = begun["first"]
        if state is None:
            folder.append(_NAMES, b"obj_id,category,instance_id,split,source,licence\n")
            folder.append(_INFO, b"{")

    def number(self, instance_id: str) -> int | None:
        """The obj_id of an instance, None where it is new."""
        return next((number for number, _ in self._register.of(instance_id)), None)

    def add(self, asset: Row, shape: ColoredShape | None) -> int:
        """The obj_id of a new instance, whose row of `assets` and shape these are."""
        number = self.count = self._register.add(asset["instance_id"])
        text = io.StringIO()
        names = ("category", "instance_id", "split", "source", "licence")
        csv.writer(text, lineterminator="\n").writerow((number, *(asset[name] for name in names)))
        self._folder.append(_NAMES, text.getvalue().encode())
        if shape is None:
            self.without += 1
            return number
        self._folder.put(f"models/obj_{number:06d}.ply", b"".join(ply_lines(shape)))
        entry = f'{"" if self._first else ","}\n "{number}": {json.dumps(model_info(_MM * shape.shape.vertices))}'
        self._folder.append(_INFO, entry.encode())
        self._first = False
        return number

    def state(self) -> dict[str, Any]:
        """What a new one must know; the numbers themselves are safe on the disk."""
        return {"objects": self._register.state(), "without_model": self.without, "first": self._first}

    def finish(self) -> None:
        """Ends models_info.json."""
        self._folder.append(_INFO, b"\n}\n")

    def close(self) -> None:
        """Closes the file of numbers."""
        self._register.close()


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


def ply_lines(colored: ColoredShape) -> Iterator[bytes]:
    """An ASCII PLY file: vertices in millimetres, unit normals, colours, and triangles."""
    shape, mesh = colored.shape, colored.shape.mesh
    normals = np.concatenate([_normals(part) for part in shape.parts])
    floats, letters = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    header = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in floats] + [f"property uchar {name}" for name in letters]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    yield "".join(f"{line}\n" for line in header).encode()
    rows = zip((_MM * mesh.vertices).tolist(), normals.tolist(), colored.colors.tolist(), strict=True)
    line = "%.9g %.9g %.9g %.6g %.6g %.6g %d %d %d\n"
    yield "".join(line % (*xyz, *normal, *rgb) for xyz, normal, rgb in rows).encode()
    yield "".join(f"3 {a} {b} {c}\n" for a, b, c in mesh.faces.tolist()).encode()


def _normals(part: Part) -> Array:
    """[V, 3]: those of the part, else the mean of the faces about each vertex, weighed by their angles."""
    if part.normals is not None:
        return part.normals
    mesh, total = trimesh.Trimesh(part.vertices, part.faces, process=False), np.zeros(part.vertices.shape)
    np.add.at(total, mesh.faces, mesh.face_angles[..., None] * mesh.face_normals[:, None])
    return np.asarray(trimesh.unitize(total))
