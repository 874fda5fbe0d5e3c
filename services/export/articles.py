"""Layouts that the loaders of two articles read: `mirror-recon` and `nocs` (docs/export.md).

`mirror-recon` is that of the authors of the data (Staszak and Belter 2024, their published code). A folder for each category,
whose ids run 0, 1, 2, ... without gaps: even ids are input poses, the odd one after each its mirror pose. A scene of several
objects is in the folder of its first one; object k, of line k + 1 of `objects%05d.dat`, has the patches `obj<k>`, as their
class for several objects looks for them. Depth in 5000 units a metre, camera poses camera to world, object poses object to
camera, both in the optical frame.

`nocs` is the CAMERA layout of Normalized Object Coordinate Space (Wang 2019). A normalised coordinate is 0.5 in the middle of
the object's box, whose diagonal is 1, with y up and x as in the dataset, so that its (x, y, z) is our (x, z, -y). Those loaders
mirror z of coordinates and models, because theirs were drawn in a left-handed frame: so both are stored as (x, z, y).
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from schemas.dataset.layout import PixelKind
from schemas.errors import plural
from schemas.job.assets import BUILT_IN
from schemas.scene.shape import REGION_FIRST_OBJECT, is_object
from schemas.scene.view import Role
from services.dataset.pair import Pair
from services.dataset.view import View
from services.export.formats import Writer
from services.export.source import (
    MM_PER_M,
    ExportScene,
    depth_of,
    drawn,
    in_units,
    labels_of,
    png_of,
)
from services.merge.tables import escaped
from workers.store.images import encode_png

UNITS_PER_M = 5000.0
"""Of every depth image."""

_CAM_POSES, _PAIRS = "camPoses.txt", "pairs.csv"
_VIEWS: tuple[tuple[Role, int, str], ...] = (("input", 0, "yaw0"), ("mirror", 1, "yaw-179"))
"""Role, what is added to the even id, and the word in the names of patches, which all have the even id."""
_KINDS: tuple[tuple[PixelKind, str], ...] = (("rgb", "rgb"), ("depth", "depth"), ("region", "segment"))


class MirrorRecon(Writer):
    """Writes pairs whose every image exists, and every patch of one of their objects at least."""

    KEYS: ClassVar = ("render.rgb", "cameras.mirror.enabled", "images.projection.enabled")
    FRESH: ClassVar = {"next": {}, "objects": {}}
    """The next even id by category; objects `with` all their patches and those `without`."""
    HEADS: ClassVar = {_PAIRS: "category,id,scene_id,pose_id\n"}

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes a pair that is whole."""
        images, reason = _images_of(pair)
        if reason:
            return reason
        patches, reasons = _patches_of(pair, sorted(scene.instances))
        if not patches:
            return reasons[0]
        self._write(scene, pair, {**images, **patches})
        self.count("objects", "without", len(reasons))
        self.count("objects", "with", len(scene.instances) - len(reasons))
        return ""

    def _write(self, scene: ExportScene, pair: Pair, images: dict[str, bytes]) -> None:
        even = self.kept["next"].get(scene.category, 0)
        self.count("next", scene.category, 2)
        for name, data in images.items():
            self.folder.put(f"{scene.category}/{name.format(even=even, odd=even + 1)}.png", data)
        for role, more, _ in _VIEWS:
            view = pair.views[role]
            self.folder.put(
                f"{scene.category}/objects{even + more:05d}.dat", "".join(map(_object_line, labels_of(view))).encode()
            )
            self.folder.append(f"{scene.category}/{_CAM_POSES}", _pose_line(even, more, view.row).encode())
        self.folder.append_row(_PAIRS, (scene.category, even, scene.scene_id, pair.pose_id))

    def describe(self) -> dict[str, Any]:
        """Views by category, and the conventions."""
        lost = self.kept["objects"].get("without", 0)
        return {
            "views": self.counts("next"),
            "objects": self.kept["objects"].get("with", 0),
            "not_exported": [f"patches of {plural(lost, 'object')}: in part outside an image"] if lost else [],
            "depth_units_per_m": UNITS_PER_M,
            "camera_poses": "camera to world, optical frame (x right, y down, z forward), metres; pitch, yaw in radians",
            "object_poses": "object to camera, optical frame, metres",
            "pixels": "a pixel's centre is at (column + 0.5, row + 0.5)",
        }


Images = dict[str, bytes]
"""PNG bytes by name without ending, with places for the ids `even` and `odd`."""


def _patches_of(pair: Pair, regions: list[int]) -> tuple[Images, list[str]]:
    """(the patches of every object that has all of them, the reason of each other one)."""
    patches: Images = {}
    reasons = []
    for number, region in enumerate(regions):
        images, reason = _images_of(pair, region, f"obj{number}")
        if reason:
            reasons.append(reason)
            continue
        patches |= images | {f"distIn{{even:05d}}yaw0obj{number}": encode_png(_distance_patch(pair.input, region))}
    return patches, reasons


def _images_of(pair: Pair, region: int | None = None, place: str = "") -> tuple[Images, str]:
    """(images by name, the reason why one is not there): of whole views, or patches of a region, called `place`."""
    images: Images = {}
    for role, number, word in (*_VIEWS, ("projected", 0, "yaw-179")):
        if (view := pair.views.get(role)) is None:
            return {}, f"no {role} view"
        shown = view if region is None else view.patch(region)
        middle = "Proj" if role == "projected" else "In" if region else ""
        ending = f"{{{'even' if region or not number else 'odd'}:05d}}{word + place if region else ''}"
        for kind, name in _KINDS if role != "projected" else _KINDS[:2]:
            if (data := png_of(shown, kind)) is None:
                return {}, f"no {'patch' if region else kind} of the {role} view"
            in_depth = in_units(data, view.depth_units_per_m, UNITS_PER_M) if kind == "depth" else data
            images[f"{name}{middle}{ending}"] = in_depth
    return images, ""


def _distance_patch(view: View, region_id: int) -> NDArray[np.uint16]:
    """[h, w] distance in pixels, rounded, of each pixel of an input patch to the nearest pixel of its object."""
    label, patch = view.regions[region_id], view.patch(region_id)
    assert patch is not None
    k, distance = patch.camera.intrinsics, distance_transform_edt(view.segment() != region_id)
    top, left = label["v"] - k.height // 2, label["u"] - k.width // 2
    distance = distance[top : top + k.height, left : left + k.width]
    return np.rint(distance).astype(np.uint16)


def _pose_line(even: int, more: int, view: Mapping[str, Any]) -> str:
    """`id parent pitch yaw m00 ... m33`."""
    numbers = [view["inclination_rad"], view["yaw_rad"], *view["T_world_cam"]]
    return " ".join([str(even + more), str(even), *map(repr, numbers)]) + "\n"


def _object_line(row: Mapping[str, Any]) -> str:
    """`category instance region cx cy T00 ... T33`; white space in names is written as in a URL."""
    words = [escaped(row["category"]), escaped(row["instance_id"]), row["region_id"], row["u"], row["v"]]
    return " ".join([*map(str, words), *map(repr, row["T_cam_obj"])]) + "\n"


CLASSES: Final = {"bottle": 1, "bowl": 2, "camera": 3, "can": 4, "laptop": 5, "mug": 6}
"""Numbers that those loaders' class names have; other categories come after them as they appear."""
IN_FOLDER: Final = 10
"""Images of a folder."""
BACKGROUND: Final = 255
"""In a mask."""
_IMAGES = "images.csv"
_OF_VIEWS = ("width", "height", "fx", "fy", "cx_opencv", "cy_opencv")
_STORED_AXES = [0, 2, 1]
_STEPS = np.iinfo(np.uint16).max // np.iinfo(np.uint8).max
"""Of stored coordinates in one of 8 bits."""


class Nocs(Writer):
    """Writes every drawn view that has colour and coordinates."""

    KEYS: ClassVar = ("render.rgb",)
    FRESH: ClassVar = {"images": {}, "classes": CLASSES}
    HEADS: ClassVar = {_IMAGES: f"path,scene_id,pose_id,role,{','.join(_OF_VIEWS)}\n"}

    NEEDS: ClassVar = {"views": ("coordinates",)}

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes the pair's images."""
        for view in drawn(pair):
            self._write(scene, view)
        return ""

    def end_scene(self, scene: ExportScene) -> None:
        """Writes models of what the scene shows."""
        for category, instance_id in scene.instances.values():
            self._write_model(scene, category, instance_id)

    def _write(self, scene: ExportScene, view: View) -> None:
        number, region = self.kept["images"].get(scene.split, 0), view.segment()
        path = f"{scene.split}/{number // IN_FOLDER:05d}/{number % IN_FOLDER:04d}"
        meta, classes = "", self.kept["classes"]
        for region_id, (category, name) in scene.instances.items():
            number, own_class = region_id - REGION_FIRST_OBJECT + 1, classes.setdefault(category, len(classes) + 1)
            meta += f"{number} {own_class} {_synset(category)} {escaped(name)}\n"
        coordinates = np.rint(view.image("coordinates")[..., _STORED_AXES] / _STEPS).astype(np.uint8)
        # Objects count from 1.
        numbers = np.where(is_object(region), region - (REGION_FIRST_OBJECT - 1), BACKGROUND)
        files = {
            "color.png": view.png("rgb"),
            "coord.png": encode_png(coordinates),
            "depth.png": depth_of(view, MM_PER_M),
        }
        files |= {"mask.png": encode_png(numbers.astype(np.uint8)), "meta.txt": meta.encode()}
        for name, data in files.items():
            self.folder.put(f"{path}_{name}", data)
        columns = (view.row[name] for name in _OF_VIEWS)
        self.folder.append_row(_IMAGES, (path, scene.scene_id, view.pose_id, view.role, *columns))
        self.count("images", scene.split)

    def _write_model(self, scene: ExportScene, category: str, instance_id: str) -> None:
        """bbox.txt, the size of the object's box, and model.obj where the shape is stored or here."""
        path = f"obj_models/{scene.split}/{_synset(category)}/{escaped(instance_id)}"
        if (self.folder.root / path / "bbox.txt").exists():
            return
        extents = np.array(scene.assets[instance_id]["extents_m"])
        size = extents[_STORED_AXES] / math.hypot(*extents)
        if (shape := self.shapes.load(scene, instance_id)) is not None:
            lines = obj_lines(shape.vertices / math.hypot(*extents), shape.faces)
            self.folder.put(f"{path}/model.obj", "".join(lines).encode())
        ends = (" ".join(map(repr, (sign * size).tolist())) for sign in (0.5, -0.5))
        self.folder.put(f"{path}/bbox.txt", "".join(f"{end}\n" for end in ends).encode())

    def describe(self) -> dict[str, Any]:
        """Images by split, classes, and the conventions."""
        return {
            "images": self.counts("images"),
            "classes": self.kept["classes"],
            "not_exported": ["the table and the floor as objects; projected views; textures of models"],
            "coordinates": "(x, y, z) of a loader that mirrors z is our (x, z, -y), 0.5 in the box's middle, its diagonal 1",
            "depth": "millimetres, z along the optical axis, 0 is no depth",
            "intrinsics": f"{_IMAGES}, pixel centres on integers; those loaders have fx = 577.5 written into them",
        }


def obj_lines(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> Iterator[str]:
    """An OBJ file of vertices [V, 3], ours, mirrored as this layout has them; faces keep their outside."""
    yield from (f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices[:, _STORED_AXES].tolist())
    yield from (f"f {a} {b} {c}\n" for a, b, c in (faces[:, ::-1] + 1).tolist())


def _synset(category: str) -> str:
    """The folder of ShapeNet with the same kind of thing, the category where it has none."""
    known = BUILT_IN.get(category)
    return category if known is None or known.synset is None else known.synset
