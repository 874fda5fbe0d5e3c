"""Format `occnet`: the layout of Occupancy Networks and Convolutional Occupancy Networks (Mescheder 2019, Peng 2020).

A folder for each object with points.npz, pointcloud.npz and img_choy2016/, square crops with cameras.npz, and for each
category the lists train.lst, val.lst and test.lst. As those loaders read them: points are (p - loc) / scale, occupancies are
packed bits, world_mat [3, 4] takes object coordinates in metres to the camera (optical frame), camera_mat [3, 3] those to an
image of 137 x 137 pixels measured from its left and upper edge. The object's z is up.
"""

import io
import json
import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.codec import Row, read_matrix
from schemas.job.job import Job
from services.export.formats import ExportRequest, ObjectWriter, encode_json, encode_npz, require_targets
from services.export.source import SIDES, ExportPair, ExportScene

SIZE: Final = 137
"""Pixels of an image's side: those loaders scale camera_mat by it."""
MARGIN: Final = 1.05
"""Side of a crop by the size at which the sphere about the object's box is seen."""
IMAGES: Final = "img_choy2016"
_QUALITY = 95
_SPLITS = ("train", "val", "test")

NO_SAMPLES: Final = "no samples of the shape's surface and volume are stored"
STRICTER: Final = "the scene shows an object of a stricter split too"
NO_VIEW: Final = "no view has the object in it, whole and in colour"


class OccNet(ObjectWriter):
    """Writes objects of whose shape the dataset has samples."""

    FRESH: ClassVar = {"register": 0, "views": {}, "listed": {}, "objects": {}}

    @classmethod
    def check(cls, job: Job) -> None:
        """Raises InputError where the job has no shape targets."""
        require_targets(job, "occnet", shape=("surface", "volume"))

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Opens the list of views."""
        super().begin(request, fresh)
        self._colored = self.record.job.render.rgb

    def take(self, scene: ExportScene, pair: ExportPair, region_id: int) -> str:
        """Writes an object's crops, and its points with the first; without colour its points alone."""
        category, instance_id = scene.instances[region_id]
        split, path = scene.assets[instance_id]["split"], f"{category}/{instance_id}"
        if split != scene.split:
            return STRICTER
        crops = list(crops_of(pair, region_id, scene.assets[instance_id])) if self._colored else []
        if self._colored and not crops:
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
        self.count("listed", listed, 1)
        self.count("objects", split, 1)
        return True

    def finish(self) -> None:
        """Writes the cameras of every object, lists that are empty, and metadata.yaml."""
        for path, _ in self.register.counts():
            cameras = [json.loads(text) for _, text in self.register.of(path) if text]
            if cameras:
                named = {
                    f"{name}_{n}": np.array(matrix) for n, one in enumerate(cameras) for name, matrix in one.items()
                }
                self.folder.put(f"{path}/{IMAGES}/cameras.npz", encode_npz(named))
        categories = sorted({path.partition("/")[0] for path in self.kept["listed"]})
        for category in categories:
            for split in _SPLITS:
                self.folder.append(f"{category}/{split}.lst", b"")
        # JSON is YAML
        self.folder.put("metadata.yaml", encode_json({name: {"id": name, "name": name} for name in categories}))

    def describe(self) -> dict[str, Any]:
        """Objects and images by split, and the conventions."""
        return {
            "objects": dict(sorted(self.kept["objects"].items())),
            "images": dict(sorted(self.kept["views"].items())),
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


def crops_of(pair: ExportPair, region_id: int, asset: Row) -> Iterator[tuple[bytes, dict[str, list]]]:
    """(JPEG, camera_mat and world_mat) of each view that has colour and the whole sphere about the object's box."""
    for role in SIDES:
        label = pair.label(role, region_id)
        if label is None or not label["pixels"] or (pixels := pair.pixels(role, "rgb")) is None:
            continue
        T, view = read_matrix(label["T_cam_obj"]), pair.views[role]
        window = _window(T[:3, 3], math.hypot(*asset["extents_m"]) / 2.0, view)
        if window is None:
            continue
        left, top, side = window
        share = SIZE / side
        camera = [
            [share * view["fx"], 0.0, share * (view["cx"] - left)],
            [0.0, share * view["fy"], share * (view["cy"] - top)],
            [0.0, 0.0, 1.0],
        ]
        image = _encode_jpeg(pixels[top : top + side, left : left + side])
        yield image, {"camera_mat": camera, "world_mat": T[:3].tolist()}


def _window(centre: Array, radius_m: float, view: Row) -> tuple[int, int, int] | None:
    """(left, top, side) of a square with a sphere in it, pixels; None where it leaves the image."""
    x, y, z = centre.tolist()
    if z <= radius_m:
        return None
    side = math.ceil(2.0 * MARGIN * max(view["fx"], view["fy"]) * radius_m / math.sqrt(z * z - radius_m * radius_m))
    left = round(view["fx"] * x / z + view["cx"] - side / 2.0)
    top = round(view["fy"] * y / z + view["cy"] - side / 2.0)
    inside = left >= 0 and top >= 0 and left + side <= view["width"] and top + side <= view["height"]
    return (left, top, side) if inside else None


def _encode_jpeg(pixels: NDArray[np.uint8]) -> bytes:
    """A square of RGB as a JPEG of `SIZE` x `SIZE` pixels."""
    from PIL import Image

    stream = io.BytesIO()
    square = Image.fromarray(pixels).resize((SIZE, SIZE), Image.Resampling.BICUBIC)
    square.save(stream, "JPEG", quality=_QUALITY)
    return stream.getvalue()
