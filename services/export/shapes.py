"""Shapes of a dataset's instances, and silhouettes of objects: what is seen, what others hide, what is outside the image."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.codec import Row, read_camera, read_matrix
from schemas.dataset.layout import asset_path
from schemas.errors import CorruptError, VersoError
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Intrinsics
from services.export.source import ExportScene
from services.read.dataset_reader import as_damage
from services.read.independent.rays import bare_faces, cast
from services.read.scene_geometry import Sources
from workers.assets.glb import read_shape
from workers.geometry.camera import NEAR_M, project_bounds, shown_part
from workers.geometry.frames import transform

Columns = Mapping[str, Any]
"""A row of `views` or `objects`."""

_KEPT = 32
"""Shapes that are kept: those of a few scenes."""


class Shapes:
    """Loads shapes by instance; keeps those that were asked for last."""

    def __init__(self, sources: Sources) -> None:
        self._sources = sources
        self._kept: LRUCache[str, Shape | None] = LRUCache(_KEPT)

    def load(self, scene: ExportScene, instance_id: str) -> Shape | None:
        """The shape of an instance of this scene; None where it is not stored and the job's sources are not here.

        Raises CorruptError where a stored shape is damaged.
        """
        if instance_id not in self._kept:
            self._kept[instance_id] = self._find(scene, scene.assets[instance_id])
        return self._kept[instance_id]

    def _find(self, scene: ExportScene, row: Row) -> Shape | None:
        path = asset_path(row["category"], row["instance_id"])
        try:
            data = scene.read(path)
        except CorruptError:  # it is not stored: only shapes that may be passed on are
            try:
                asset = self._sources.asset(row["category"], row["instance_id"])
            except (VersoError, OSError):
                return None
            return asset.shape if asset.sha256 == row["sha256"] else None
        with as_damage(path):
            return read_shape(data)[0]


def vertex_colors(part: Part) -> NDArray[np.uint8]:
    """[V, 3] uint8 sRGB: base colour times texture times vertex colour, at each vertex."""
    share: Array = np.tile(np.array(part.material.base_color[:3]), (len(part.vertices), 1))
    if part.colors is not None:
        share = share * (part.colors[:, :3] / 255.0)
    if part.material.texture is not None and part.uv is not None:
        share = share * (_sample(part.material.texture, part.uv) / 255.0)
    return np.rint(255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)


def _sample(texture: NDArray[np.uint8], uv: Array) -> NDArray[np.uint8]:
    """[V, 3] the texel that each coordinate falls in; (0, 0) is the lower left corner, and the texture repeats."""
    height, width = texture.shape[:2]
    column = np.floor(np.mod(uv[:, 0], 1.0) * width).astype(np.int64).clip(0, width - 1)
    row = np.floor((1.0 - np.mod(uv[:, 1], 1.0)) * height).astype(np.int64).clip(0, height - 1)
    return texture[row, column, :3]


_FARTHEST = 3
"""Silhouettes are followed so many image sizes beyond the image."""

Box = tuple[int, int, int, int]
"""x, y, width, height, pixels, where a single pixel has no width; all -1 where there is nothing."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """mask [H, W] bool: the part inside the image; pixels and box are of all of it, in the image's coordinates."""

    mask: NDArray[np.bool_]
    pixels: int
    box: Box


def silhouette_of(mask: NDArray[np.bool_]) -> Silhouette:
    """That of an object of which nothing lies outside the image."""
    return Silhouette(mask, int(mask.sum()), box_of(mask))


def reaches_edge(mask: NDArray[np.bool_]) -> bool:
    """Whether a pixel at the edge of the image is in the mask [H, W]."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def whole_silhouette(
    label: Columns, view: Columns, visible: NDArray[np.bool_], shape: Shape | None
) -> Silhouette | None:
    """The silhouette of the object of `label`, of which `visible` [H, W] is seen.

    Nothing is cast where all of it is seen. Otherwise rays through pixel centres meet its mesh alone; None without a shape.
    """
    if label["visible_fraction"] >= 1.0:
        return silhouette_of(visible)
    if shape is None:
        return None
    points, k = transform(read_matrix(label["T_cam_obj"]), shape.vertices), read_camera(view).intrinsics
    left, top, right, bottom = _window(points, k)
    whole = np.zeros((bottom - top, right - left), np.bool_)
    lens = {"fx": k.fx, "fy": k.fy, "cx": k.cx - left, "cy": k.cy - top}
    hits = cast(bare_faces(points[shape.faces]), {**lens, "width": right - left, "height": bottom - top})
    whole.flat[hits.pixel[hits.covers]] = True
    inside = np.s_[-top : k.height - top, -left : k.width - left]
    whole[inside] |= visible  # at an edge, rays and the renderer may differ by a pixel
    x, y, width, height = box_of(whole)
    box = (x + left, y + top, width, height) if width >= 0 else (x, y, width, height)
    return Silhouette(whole[inside], int(whole.sum()), box)


def box_of(mask: NDArray[np.bool_]) -> Box:
    """The bounding box of a mask, as bop_toolkit's `calc_2d_bbox` has it: from the first pixel to the last, their difference."""
    rows, columns = shown_part(mask)
    if not rows.stop:
        return -1, -1, -1, -1
    return columns.start, rows.start, columns.stop - 1 - columns.start, rows.stop - 1 - rows.start


def _window(points_cam: Array, k: Intrinsics) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) of a window that holds the image and points [V, 3] of the camera's frame, in pixels."""
    u_low, v_low, u_high, v_high = project_bounds(points_cam, k, NEAR_M)
    far_x, far_y = _FARTHEST * k.width, _FARTHEST * k.height
    left, right = np.clip([np.floor(u_low) - 1, np.ceil(u_high) + 1], -far_x, k.width + far_x).astype(int)
    top, bottom = np.clip([np.floor(v_low) - 1, np.ceil(v_high) + 1], -far_y, k.height + far_y).astype(int)
    return min(int(left), 0), min(int(top), 0), max(int(right), k.width), max(int(bottom), k.height)
