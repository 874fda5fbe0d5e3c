"""Format `pcn`: pairs of partial and complete point clouds, as PCN (Yuan 2018) and its successors read them (GRNet, PoinTr).

    train/partial/mug/<instance id>/00.pcd, 01.pcd, ...     what a view's depth shows of the object
    train/complete/mug/<instance id>.pcd                    16,384 points on its whole surface
    PCN.json                                                the instances of each category by split

Both are in the object frame, z up, divided by the diagonal of the object's bounding box, as ShapeNet's models are.
"""

import csv
import io
import math
from typing import Any, Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.dataset.codec import read_camera, read_matrix
from services.export.formats import ExportRequest, ObjectWriter, encode_json, sample_mesh
from services.export.shapes import Shapes
from services.export.source import SIDES, ExportPair, ExportScene
from workers.geometry.camera import unproject
from workers.geometry.frames import invert, transform

POINTS: Final = 16_384
"""Of a complete cloud: those loaders accept no other number."""
RENDERINGS: Final = 8
"""Partial clouds that those loaders draw from of every object of `train`; fewer are repeated up to so many."""
FEWEST: Final = 64
"""Points that a partial cloud has at least."""
_VIEWS = "views.csv"
_SPLITS = ("train", "val", "test")

NO_SHAPE: Final = "the shape is neither stored nor here"
NO_POINTS: Final = f"every view shows fewer than {FEWEST} points of the object"


class Pcn(ObjectWriter):
    """Writes objects whose shape is stored or here."""

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Opens the list of views."""
        super().begin(request, fresh)
        self._shapes = Shapes(self.record)
        if fresh:
            self.folder.append(_VIEWS, b"split,category,instance_id,number,scene_id,pose_id,role,points\n")

    def take(self, scene: ExportScene, pair: ExportPair, region_id: int) -> str:
        """Writes what each view shows of an object, and its complete cloud with the first."""
        (category, instance_id), asset = scene.instances[region_id], scene.assets[scene.instances[region_id][1]]
        diagonal, split = math.hypot(*asset["extents_m"]), asset["split"]
        clouds = {role: seen_points(pair, role, region_id) / diagonal for role in SIDES}
        clouds = {role: points for role, points in clouds.items() if len(points) >= FEWEST}
        if not clouds:
            return NO_POINTS
        number = len(self.register.of(key := f"{category}/{split}/{instance_id}"))
        if not number:
            complete = self._complete(scene, instance_id)
            if complete is None:
                return NO_SHAPE
            self.folder.put(f"{split}/complete/{category}/{instance_id}.pcd", encode_pcd(complete / diagonal))
        text = io.StringIO()
        for place, (role, points) in enumerate(clouds.items(), start=number):
            self.folder.put(f"{split}/partial/{category}/{instance_id}/{place:02d}.pcd", encode_pcd(points))
            self.register.add(key)
            row = (split, category, instance_id, place, scene.scene_id, pair.views[role]["pose_id"], role, len(points))
            csv.writer(text, lineterminator="\n").writerow(row)
        self.folder.append(_VIEWS, text.getvalue().encode())
        self.count("views", split, len(clouds))
        return ""

    def _complete(self, scene: ExportScene, instance_id: str) -> NDArray[np.float32] | None:
        """[POINTS, 3] on the surface, object frame, metres: stored samples where there are enough, else drawn on the mesh."""
        stored: NDArray[np.float32] = scene.samples(instance_id).get("surface_points", np.zeros((0, 3), np.float32))
        if len(stored) >= POINTS:
            return stored[:POINTS]
        if (colored := self._shapes.load(scene, instance_id)) is None:
            return None
        mesh = trimesh.Trimesh(colored.shape.vertices, colored.shape.faces, process=False)
        return sample_mesh(mesh, POINTS, instance_id)["points"]

    def finish(self) -> None:
        """Repeats clouds of objects of `train` that have few, and writes the list of instances."""
        listed: dict[str, dict[str, list[str]]] = {}
        for key, count in self.register.counts():
            category, split, instance_id = key.split("/")
            listed.setdefault(category, {name: [] for name in _SPLITS})[split].append(instance_id)
            folder = f"{split}/partial/{category}/{instance_id}"
            for number in range(count, RENDERINGS if split == "train" else count):
                self.folder.put(
                    f"{folder}/{number:02d}.pcd", (self.folder.root / folder / f"{number % count:02d}.pcd").read_bytes()
                )
        tree = [{"taxonomy_id": name, "taxonomy_name": name, **splits} for name, splits in listed.items()]
        self.folder.put("PCN.json", encode_json(tree))

    def describe(self) -> dict[str, Any]:
        """Clouds by split, and the conventions."""
        return {
            "partial": dict(sorted(self.kept["views"].items())),
            "not_exported": ["images and poses; aligned and projected views"],
            "points": "object frame, z up, origin in the middle of the bounding box, whose diagonal is 1",
            "repeated": f"{_VIEWS} lists the clouds; objects of train with fewer have copies of them up to {RENDERINGS}",
        }


def seen_points(pair: ExportPair, role: str, region_id: int) -> NDArray[np.float64]:
    """[N, 3] what a view's depth shows of an object, object frame, metres; none where the view is not stored."""
    view, label = pair.views.get(role), pair.label(role, region_id)
    if view is None or label is None:
        return np.zeros((0, 3))
    depth, region = pair.pixels(role, "depth"), pair.pixels(role, "region")
    assert depth is not None and region is not None
    rows, columns = np.nonzero((region == region_id) & (depth > 0))
    points = unproject(rows, columns, depth[rows, columns] / view["depth_units_per_m"], read_camera(view).intrinsics)
    return transform(invert(read_matrix(label["T_cam_obj"])), points)


def encode_pcd(points: NDArray) -> bytes:
    """An ASCII file of the Point Cloud Library, version 0.7: x, y, z of points [N, 3] as float32 in 9 digits."""
    count = len(points)
    header = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F"]
    header += ["COUNT 1 1 1", f"WIDTH {count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}", "DATA ascii"]
    lines = (f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.astype(np.float32).tolist())
    return "\n".join([*header, *lines, ""]).encode()
