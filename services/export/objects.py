"""Formats with a folder for each object: `occnet` and `pcn` (docs/export.md). The object's z is up.

`occnet`, for Occupancy Networks and Convolutional Occupancy Networks (Mescheder 2019, Peng 2020): points are (p - loc) / scale,
occupancies are packed bits, world_mat [3, 4] takes object coordinates in metres to the camera (optical frame), camera_mat [3, 3]
those to an image of 137 x 137 pixels measured from its left and upper edge.

`pcn`, for PCN (Yuan 2018) and its successors (GRNet, PoinTr): clouds are in the object frame, divided by the diagonal of the
object's bounding box, as ShapeNet's models are.
"""

import io
import json
import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.codec import Row, read_matrix
from schemas.scene.view import Intrinsics
from services.dataset.pair import Pair
from services.export.formats import ObjectWriter, encode_json, encode_npz, sample_mesh
from services.export.source import ExportScene, sides

SIZE: Final = 137
"""Pixels of an image's side: those loaders scale camera_mat by it."""
MARGIN: Final = 1.05
"""Side of a crop by the size at which the sphere about the object's box is seen."""
IMAGES: Final = "img_choy2016"
_QUALITY = 95
_SPLITS = ("train", "val", "test")
"""Which loaders look for, with or without objects."""

NO_SAMPLES: Final = "no samples of the shape's surface and volume are stored"
STRICTER: Final = "the scene shows an object of a stricter split too"
NO_VIEW: Final = "no view has the object in it, whole and in colour"


class OccNet(ObjectWriter):
    """Writes objects of whose shape the dataset has samples."""

    FRESH: ClassVar = {"views": {}, "listed": {}, "objects": {}}

    NEEDS: ClassVar = {"shape": ("surface", "volume")}

    def take_object(self, scene: ExportScene, pair: Pair, region_id: int) -> str:
        """Writes an object's crops, and its points with the first; without colour its points alone."""
        category, instance_id = scene.instances[region_id]
        split, path = scene.assets[instance_id]["split"], f"{category}/{instance_id}"
        if split != scene.split:
            return STRICTER
        colored = self.record.job.render.rgb
        crops = list(crops_of(pair, region_id, scene.assets[instance_id])) if colored else []
        if colored and not crops:
            return NO_VIEW
        number = len(self.register.of(path))
        if not number and not self._begin_object(scene, split, category, instance_id):
            return NO_SAMPLES
        if not crops and not number:
            self.register.add(path)
        for place, (image, camera) in enumerate(crops, start=number):
            self.folder.put(f"{path}/{IMAGES}/{place:05d}.jpg", image)
            self.register.add(path, json.dumps(camera))
        self.count("views", split, len(crops))
        return ""

    def _begin_object(self, scene: ExportScene, split: str, category: str, instance_id: str) -> bool:
        """Writes an object's points and names it in its list; False where the dataset has no samples of its shape."""
        stored = scene.samples(instance_id)
        if not {"surface_points", "volume_points"} <= stored.keys():
            return False
        for name, arrays in points_of(stored).items():
            self.folder.put(f"{category}/{instance_id}/{name}.npz", encode_npz(arrays))
        listed = f"{category}/{split}.lst"
        # Those loaders cut the list at line ends, and take an empty last line for a name.
        line_end = "\n" if self.kept["listed"].get(listed) else ""
        self.folder.append(listed, f"{line_end}{instance_id}".encode())
        self.count("listed", listed)
        self.count("objects", split)
        return True

    def finish(self) -> None:
        """Writes the cameras of every object, lists that are empty, and metadata.yaml."""
        for path, _ in self.register.counts():
            cameras = [json.loads(text) for _, text in self.register.of(path) if text]
            if cameras:
                named = [(f"{name}_{n}", matrix) for n, camera in enumerate(cameras) for name, matrix in camera.items()]
                arrays = {name: np.array(matrix) for name, matrix in named}
                self.folder.put(f"{path}/{IMAGES}/cameras.npz", encode_npz(arrays))
        categories = sorted({path.partition("/")[0] for path in self.kept["listed"]})
        for category in categories:
            for split in _SPLITS:
                self.folder.append(f"{category}/{split}.lst", b"")
        # JSON is YAML
        self.folder.put("metadata.yaml", encode_json({name: {"id": name, "name": name} for name in categories}))

    def describe(self) -> dict[str, Any]:
        """Objects and images by split, and the conventions."""
        return {
            "objects": self.counts("objects"),
            "images": self.counts("views"),
            "not_exported": ["meshes, voxels, depth, masks; aligned and projected views"],
            "points": "(p - loc) / scale, p in the object frame in metres, z up: the box's longest side is 1",
            "occupancies": "packed bits: points_unpackbits: true",
            "cameras": f"world_mat object to camera, metres, optical frame; camera_mat to {SIZE} x {SIZE} pixels from the edge",
        }


def points_of(stored: Mapping[str, NDArray]) -> dict[str, dict[str, NDArray]]:
    """The arrays of points.npz and pointcloud.npz from samples of a shape's surface and volume."""
    loc, scale = stored["loc"], stored["scale"]

    def unit(name: str) -> NDArray[np.float32]:
        return ((stored[name] - loc) / scale).astype(np.float32)

    place = {"loc": loc, "scale": scale}
    bits = np.packbits(stored["volume_occupancy"].astype(np.bool_))
    return {
        "pointcloud": {"points": unit("surface_points"), "normals": stored["surface_normals"], **place},
        "points": {"points": unit("volume_points"), "occupancies": bits, **place},
    }


def crops_of(pair: Pair, region_id: int, asset: Row) -> Iterator[tuple[bytes, dict[str, list]]]:
    """(JPEG, camera_mat and world_mat) of each view that has colour and the whole sphere about the object's box."""
    for view in sides(pair):
        label, k = view.regions[region_id], view.camera.intrinsics
        if not label["pixels"] or "rgb" not in view.images:
            continue
        T = read_matrix(label["T_cam_obj"])
        window = _window(T[:3, 3], math.hypot(*asset["extents_m"]) / 2.0, k)
        if window is None:
            continue
        left, top, side = window
        share = SIZE / side
        camera = [
            [share * k.fx, 0.0, share * (k.cx - left)],
            [0.0, share * k.fy, share * (k.cy - top)],
            [0.0, 0.0, 1.0],
        ]
        image = _encode_jpeg(view.rgb()[top : top + side, left : left + side])
        yield image, {"camera_mat": camera, "world_mat": T[:3].tolist()}


def _window(centre: Array, radius_m: float, k: Intrinsics) -> tuple[int, int, int] | None:
    """(left, top, side) of a square with a sphere in it, pixels; None where it leaves the image."""
    x, y, z = centre.tolist()
    if z <= radius_m:
        return None
    side = math.ceil(2.0 * MARGIN * max(k.fx, k.fy) * radius_m / math.sqrt(z * z - radius_m * radius_m))
    left = round(k.fx * x / z + k.cx - side / 2.0)
    top = round(k.fy * y / z + k.cy - side / 2.0)
    inside = left >= 0 and top >= 0 and left + side <= k.width and top + side <= k.height
    return (left, top, side) if inside else None


def _encode_jpeg(pixels: NDArray[np.uint8]) -> bytes:
    """A square of RGB as a JPEG of `SIZE` x `SIZE` pixels."""
    from PIL import Image

    stream = io.BytesIO()
    square = Image.fromarray(pixels).resize((SIZE, SIZE), Image.Resampling.BICUBIC)
    square.save(stream, "JPEG", quality=_QUALITY)
    return stream.getvalue()


POINTS: Final = 16_384
"""Of a complete cloud: those loaders accept no other number."""
RENDERINGS: Final = 8
"""Partial clouds that those loaders draw from of every object of `train`; fewer are repeated up to so many."""
FEWEST: Final = 64
"""Points that a partial cloud has at least."""
_VIEWS = "views.csv"

NO_SHAPE: Final = "the shape is neither stored nor here"
NO_POINTS: Final = f"every view shows fewer than {FEWEST} points of the object"


class Pcn(ObjectWriter):
    """Writes objects whose shape is stored or here."""

    HEADS: ClassVar = {_VIEWS: "split,category,instance_id,number,scene_id,pose_id,role,points\n"}

    def take_object(self, scene: ExportScene, pair: Pair, region_id: int) -> str:
        """Writes what each view shows of an object, and its complete cloud with the first."""
        (category, instance_id), asset = scene.instances[region_id], scene.assets[scene.instances[region_id][1]]
        diagonal, split = math.hypot(*asset["extents_m"]), asset["split"]
        shown = ((view, view.cloud("object", region_id).points / diagonal) for view in sides(pair))
        clouds = [(view, points) for view, points in shown if len(points) >= FEWEST]
        if not clouds:
            return NO_POINTS
        number = len(self.register.of(key := f"{category}/{split}/{instance_id}"))
        if not number:
            complete = self._complete(scene, instance_id)
            if complete is None:
                return NO_SHAPE
            self.folder.put(f"{split}/complete/{category}/{instance_id}.pcd", encode_pcd(complete / diagonal))
        for place, (view, points) in enumerate(clouds, start=number):
            self.folder.put(f"{split}/partial/{category}/{instance_id}/{place:02d}.pcd", encode_pcd(points))
            self.register.add(key)
            ids = scene.scene_id, view.pose_id, view.name
            self.folder.append_row(_VIEWS, (split, category, instance_id, place, *ids, len(points)))
        self.count("views", split, len(clouds))
        return ""

    def _complete(self, scene: ExportScene, instance_id: str) -> NDArray[np.float32] | None:
        """[POINTS, 3] on the surface, object frame, metres: stored samples where there are enough, else drawn on the mesh."""
        stored: NDArray[np.float32] = scene.samples(instance_id).get("surface_points", np.zeros((0, 3), np.float32))
        if len(stored) >= POINTS:
            return stored[:POINTS]
        if (shape := self.shapes.load(scene, instance_id)) is None:
            return None
        return sample_mesh(trimesh.Trimesh(shape.vertices, shape.faces, process=False), POINTS, instance_id)["points"]

    def finish(self) -> None:
        """Repeats clouds of objects of `train` that have few, and writes the list of instances."""
        listed: dict[str, dict[str, list[str]]] = {}
        for key, count in self.register.counts():
            category, split, instance_id = key.split("/")
            listed.setdefault(category, {name: [] for name in _SPLITS}).setdefault(split, []).append(instance_id)
            folder = f"{split}/partial/{category}/{instance_id}"
            for number in range(count, RENDERINGS if split == "train" else count):
                data = (self.folder.root / folder / f"{number % count:02d}.pcd").read_bytes()
                self.folder.put(f"{folder}/{number:02d}.pcd", data)
        tree = [{"taxonomy_id": name, "taxonomy_name": name, **splits} for name, splits in listed.items()]
        self.folder.put("PCN.json", encode_json(tree))

    def describe(self) -> dict[str, Any]:
        """Clouds by split, and the conventions."""
        return {
            "partial": self.counts("views"),
            "not_exported": ["images and poses; aligned and projected views"],
            "points": "object frame, z up, origin in the middle of the bounding box, whose diagonal is 1",
            "repeated": f"{_VIEWS} lists the clouds; objects of train with fewer have copies of them up to {RENDERINGS}",
        }


def encode_pcd(points: NDArray) -> bytes:
    """An ASCII file of the Point Cloud Library, version 0.7: x, y, z of points [N, 3] as float32 in 9 digits."""
    count = len(points)
    header = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F"]
    header += ["COUNT 1 1 1", f"WIDTH {count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}", "DATA ascii"]
    lines = (f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.astype(np.float32).tolist())
    return "\n".join([*header, *lines, ""]).encode()
