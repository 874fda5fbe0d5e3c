"""Format `mirror-recon`: the layout that the authors' own loader reads (Staszak and Belter 2024, their published code).

A folder for each category, whose ids run 0, 1, 2, ... without gaps: even ids are input poses, the odd one after each its
mirror pose. Depth in 5000 units a metre, camera poses camera to world, object poses object to camera, both in the optical frame.
"""

from collections.abc import Iterator
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.dataset.codec import Row
from schemas.dataset.layout import PixelKind
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import Role
from services.export.formats import Added, ExportRequest, Writer
from services.export.source import ExportPair, ExportScene
from services.merge.tables import escaped
from workers.store.images import decode_png, encode_png

UNITS_PER_M = 5000.0
"""Of every depth image."""

_CAM_POSES, _PAIRS = "camPoses.txt", "pairs.csv"
_VIEWS: tuple[tuple[Role, int, str], ...] = (("input", 0, "yaw0"), ("mirror", 1, "yaw-179"))
"""Role, what is added to the even id, and the word in the names of patches, which all have the even id."""
_KINDS: tuple[tuple[PixelKind, str], ...] = (("rgb", "rgb"), ("depth", "depth"), ("region", "segment"))


class MirrorRecon(Writer):
    """Writes pairs of scenes with one object, whose every image and patch exists."""

    FRESH: ClassVar = {"next": {}}
    """The next even id by category."""

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Begins the list of pairs."""
        if fresh:
            self.folder.append(_PAIRS, b"category,id,scene_id,pose_id\n")

    def add(self, scene: ExportScene) -> Added:
        """Writes the scene's pairs that are whole."""
        left_out = []
        for pair in scene.pairs:
            images, reason = _images_of(scene, pair)
            if reason:
                left_out.append((pair.pose_id, reason))
            else:
                self._write(scene, pair, images)
        return Added(len(scene.pairs) - len(left_out), tuple(left_out))

    def _write(self, scene: ExportScene, pair: ExportPair, images: dict[str, bytes]) -> None:
        even = self.kept["next"].get(scene.category, 0)
        self.count("next", scene.category, 2)
        for name, data in images.items():
            self.folder.put(f"{scene.category}/{name.format(even=even, odd=even + 1)}.png", data)
        for role, more, _ in _VIEWS:
            lines = "".join(_object_line(row) for row in pair.labels(role))
            self.folder.put(f"{scene.category}/objects{even + more:05d}.dat", lines.encode())
            self.folder.append(f"{scene.category}/{_CAM_POSES}", _pose_line(even, more, pair.views[role]).encode())
        self.folder.append(_PAIRS, f"{scene.category},{even},{scene.scene_id},{pair.pose_id}\n".encode())

    def describe(self) -> dict[str, Any]:
        """Views by category, and the conventions."""
        return {
            "views": dict(sorted(self.kept["next"].items())),
            "depth_units_per_m": UNITS_PER_M,
            "camera_poses": "camera to world, optical frame (x right, y down, z forward), metres; pitch, yaw in radians",
            "object_poses": "object to camera, optical frame, metres",
            "pixels": "a pixel's centre is at (column + 0.5, row + 0.5)",
        }


def _images_of(scene: ExportScene, pair: ExportPair) -> tuple[dict[str, bytes], str]:
    """(PNG bytes by name without ending, a reason why the pair cannot be exported, empty where it can)."""
    if len(scene.instances) != 1:
        return {}, "several objects"
    images: dict[str, bytes] = {}
    for name, role, kind, data in _stored(pair):
        if data is None:
            return {}, _reason(pair, role, kind, "patch" in name)
        units = pair.views[role]["depth_units_per_m"]
        images[name.removeprefix("patch ")] = data if kind != "depth" else in_units(data, units)
    images["distIn{even:05d}yaw0obj0"] = encode_png(_distance_patch(pair, images["rgbIn{even:05d}yaw0obj0"]))
    return images, ""


def _stored(pair: ExportPair) -> Iterator[tuple[str, Role, PixelKind, bytes | None]]:
    """(name, role, kind, PNG bytes or None) of every image that the layout has and the dataset stores."""
    for role, _, word in _VIEWS:
        number = "{even:05d}" if role == "input" else "{odd:05d}"
        for kind, name in _KINDS:
            yield f"{name}{number}", role, kind, pair.image(role, kind)
        for kind, name in _KINDS:
            yield f"patch {name}In{{even:05d}}{word}obj0", role, kind, pair.patch(role, kind, REGION_FIRST_OBJECT, 1)
    for kind, name in _KINDS[:2]:
        yield f"{name}Proj{{even:05d}}", "projected", kind, pair.image("projected", kind)
        patch = pair.patch("projected", kind, REGION_FIRST_OBJECT, 1)
        yield f"patch {name}Proj{{even:05d}}yaw-179obj0", "projected", kind, patch


def _reason(pair: ExportPair, role: Role, kind: PixelKind, is_patch: bool) -> str:
    if role not in pair.views:
        return f"no {role} view"
    return f"no patch of the {role} view" if is_patch else f"no {kind} of the {role} view"


def in_units(data: bytes, units_per_m: float) -> bytes:
    """The PNG of a depth image in `UNITS_PER_M`; what does not fit 16 bits becomes 0, as all depth out of range."""
    if units_per_m == UNITS_PER_M:
        return data
    depth = np.rint(decode_png(data) * (UNITS_PER_M / units_per_m))
    return encode_png(np.where(depth <= np.iinfo(np.uint16).max, depth, 0).astype(np.uint16))


def _distance_patch(pair: ExportPair, patch: bytes) -> NDArray[np.uint16]:
    """[h, w] distance in pixels, rounded, of each pixel of the input patch to the nearest pixel of the object."""
    region = pair.pixels("input", "region")
    assert region is not None
    height, width = decode_png(patch).shape[:2]
    (label,) = (row for row in pair.labels("input") if row["region_id"] == REGION_FIRST_OBJECT)
    distance = cv2.distanceTransform(
        (region != REGION_FIRST_OBJECT).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
    )
    top, left = label["v"] - height // 2, label["u"] - width // 2
    return np.rint(distance[top : top + height, left : left + width]).astype(np.uint16)


def _pose_line(even: int, more: int, view: Row) -> str:
    """`id parent pitch yaw m00 ... m33`."""
    numbers = [view["inclination_rad"], view["yaw_rad"], *view["T_world_cam"]]
    return " ".join([str(even + more), str(even), *map(repr, numbers)]) + "\n"


def _object_line(row: Row) -> str:
    """`category instance region cx cy T00 ... T33`; white space in names is written as in a URL."""
    words = [escaped(row["category"]), escaped(row["instance_id"]), row["region_id"], row["u"], row["v"]]
    return " ".join([*map(str, words), *map(repr, row["T_cam_obj"])]) + "\n"
