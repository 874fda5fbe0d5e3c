"""Format `nocs`: the CAMERA layout of Normalized Object Coordinate Space (Wang 2019; docs/export.md).

A normalised coordinate is 0.5 in the middle of the object's box, whose diagonal is 1, with y up and x as in the dataset, so
that its (x, y, z) is our (x, z, -y). Those loaders mirror z of coordinates and models, because theirs were drawn in a
left-handed frame: so both are stored as (x, z, y).
"""

import math
from collections.abc import Iterator
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from schemas.job.assets import BUILT_IN
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import Role
from services.export.formats import Writer
from services.export.source import MM_PER_M, ExportPair, ExportScene
from services.merge.tables import escaped
from workers.store.images import encode_png

CLASSES: Final = {"bottle": 1, "bowl": 2, "camera": 3, "can": 4, "laptop": 5, "mug": 6}
"""Numbers that those loaders' class names have; other categories come after them as they appear."""
IN_FOLDER: Final = 10
"""Images of a folder."""
BACKGROUND: Final = 255
"""In a mask."""
_IMAGES = "images.csv"
_OF_VIEWS = ("width", "height", "fx", "fy", "cx_opencv", "cy_opencv")
_STORED_AXES = [0, 2, 1]


class Nocs(Writer):
    """Writes every drawn view that has colour and coordinates."""

    FRESH: ClassVar = {"images": {}, "classes": CLASSES}
    HEADS: ClassVar = {_IMAGES: f"path,scene_id,pose_id,role,{','.join(_OF_VIEWS)}\n"}

    NEEDS: ClassVar = {"views": ("coordinates",)}

    def take(self, scene: ExportScene, pair: ExportPair) -> str:
        """Writes the pair's images, where all have colour."""
        if reason := pair.lacks_colour():
            return reason
        for role in pair.drawn:
            self._write(scene, pair, role)
        return ""

    def end_scene(self, scene: ExportScene) -> None:
        """Writes models of what the scene shows."""
        for category, instance_id in scene.instances.values():
            self._write_model(scene, category, instance_id)

    def _write(self, scene: ExportScene, pair: ExportPair, role: Role) -> None:
        number, view = self.kept["images"].get(scene.split, 0), pair.views[role]
        path = f"{scene.split}/{number // IN_FOLDER:05d}/{number % IN_FOLDER:04d}"
        rgb, depth, region = pair.image(role, "rgb"), pair.depth(role, MM_PER_M), pair.pixels(role, "region")
        codes = pair.pixels(role, "coordinates")
        assert rgb is not None and depth is not None and region is not None and codes is not None
        meta = "".join(
            f"{region_id - REGION_FIRST_OBJECT + 1} {self._class(category)} {_synset(category)} {escaped(name)}\n"
            for region_id, (category, name) in scene.instances.items()
        )
        files = {"color.png": rgb, "coord.png": encode_png(coordinates_of(codes)), "depth.png": depth}
        for name, data in {**files, "mask.png": encode_png(mask_of(region)), "meta.txt": meta.encode()}.items():
            self.folder.put(f"{path}_{name}", data)
        columns = (view[name] for name in _OF_VIEWS)
        self.folder.append_row(_IMAGES, (path, scene.scene_id, view["pose_id"], role, *columns))
        self.count("images", scene.split)

    def _class(self, category: str) -> int:
        number: int = self.kept["classes"].setdefault(category, len(self.kept["classes"]) + 1)
        return number

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


def coordinates_of(codes: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """[H, W, 3] `coordinates` of the dataset as this layout stores them."""
    share = np.iinfo(np.uint16).max // np.iinfo(np.uint8).max
    return np.rint(codes[..., _STORED_AXES] / share).astype(np.uint8)


def mask_of(region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W]: the number of each object, from 1, and `BACKGROUND`."""
    first = REGION_FIRST_OBJECT
    return np.where(region >= first, region - np.uint8(first - 1), BACKGROUND).astype(np.uint8)


def obj_lines(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> Iterator[str]:
    """An OBJ file of vertices [V, 3], ours, mirrored as this layout has them; faces keep their outside."""
    yield from (f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices[:, _STORED_AXES].tolist())
    yield from (f"f {a} {b} {c}\n" for a, b, c in (faces[:, ::-1] + 1).tolist())


def _synset(category: str) -> str:
    """The folder of ShapeNet with the same kind of thing, the category where it has none."""
    known = BUILT_IN.get(category)
    return category if known is None or known.synset is None else known.synset
