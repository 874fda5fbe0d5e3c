"""Shapes of a dataset's instances, and silhouettes of objects: what is seen, what others hide, what is outside the image."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.codec import Row, read_camera, read_matrix
from schemas.dataset.layout import asset_path
from schemas.errors import CorruptError, VersoError
from schemas.scene.shape import Material, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from services.export.source import ExportScene
from services.job.record import JobRecord
from services.read.scene_geometry import Sources
from workers.assets.glb import read_shape
from workers.geometry.camera import NEAR_M, project_bounds
from workers.geometry.frames import transform

_KEPT = 32
"""Shapes that are kept: those of a few scenes."""


@dataclass(frozen=True, eq=False)
class ColoredShape:
    """A shape in the object frame, metres, z up, and `colors` [V, 3] uint8 sRGB of its vertices, part after part."""

    shape: Shape
    colors: NDArray[np.uint8]


class Shapes:
    """Loads shapes by instance; keeps those that were asked for last."""

    def __init__(self, record: JobRecord) -> None:
        self._sources = Sources(record)
        self._kept: LRUCache[str, ColoredShape | None] = LRUCache(_KEPT)

    def load(self, scene: ExportScene, instance_id: str) -> ColoredShape | None:
        """The shape of an instance of this scene; None where it is not stored and the job's sources are not here.

        Raises CorruptError where a stored shape is damaged.
        """
        if instance_id not in self._kept:
            shape = self._find(scene, scene.assets[instance_id])
            self._kept[instance_id] = None if shape is None else color_vertices(shape)
        return self._kept[instance_id]

    def _find(self, scene: ExportScene, row: Row) -> Shape | None:
        path = asset_path(row["category"], row["instance_id"])
        try:
            data = scene.read(path)
        except CorruptError:  # it is not stored: only shapes that may be passed on are
            try:
                asset = self._sources.asset(scene.scene_id, row["category"], row["instance_id"])
            except (VersoError, OSError):
                return None
            return asset.shape if asset.sha256 == row["sha256"] else None
        try:
            return read_shape(data)[0]
        except (ValueError, LookupError, TypeError, OSError, struct.error) as error:
            raise CorruptError(f"{path} cannot be read: {error}; `verso verify OUT` says what to do") from error


def color_vertices(shape: Shape) -> ColoredShape:
    """The shape with its materials reduced to a colour for each vertex."""
    return ColoredShape(shape, np.concatenate([_vertex_colors(part) for part in shape.parts]))


def _vertex_colors(part: Part) -> NDArray[np.uint8]:
    """[V, 3] uint8 sRGB: base colour times texture times vertex colour, at each vertex."""
    material: Material = part.material
    share: Array = np.tile(np.array(material.base_color[:3]), (len(part.vertices), 1))
    if part.colors is not None:
        share = share * (part.colors[:, :3] / 255.0)
    if material.texture is not None and part.uv is not None:
        share = share * (_sample(material.texture, part.uv) / 255.0)
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


def whole_silhouette(label: Row, view: Row, visible: NDArray[np.bool_], shape: Shape | None) -> Silhouette | None:
    """The silhouette of the object of `label`, of which `visible` [H, W] is seen.

    Nothing is cast where all of it is seen. Otherwise rays through pixel centres meet its mesh alone; None without a shape.
    """
    if label["visible_fraction"] >= 1.0:
        return silhouette_of(visible)
    if shape is None:
        return None
    camera, T_cam_obj = read_camera(view), read_matrix(label["T_cam_obj"])
    left, top, right, bottom = _window(shape, T_cam_obj, camera)
    k = camera.intrinsics
    seen_by = k.model_copy(update={"width": right - left, "height": bottom - top, "cx": k.cx - left, "cy": k.cy - top})
    whole = covered(transform(T_cam_obj, shape.vertices), shape.faces, seen_by)
    inside = np.s_[-top : k.height - top, -left : k.width - left]
    whole[inside] |= visible  # at an edge, rays and the renderer may differ by a pixel
    x, y, width, height = box_of(whole)
    box = (x + left, y + top, width, height) if width >= 0 else (x, y, width, height)
    return Silhouette(whole[inside], int(whole.sum()), box)


_AT_ONCE = 4_000_000
"""Pairs of a triangle and a pixel that are looked at together."""


def covered(points_cam: Array, faces: NDArray[np.int32], k: Intrinsics) -> NDArray[np.bool_]:
    """[H, W]: through which pixels' centres a ray meets a triangle beyond `NEAR_M`; points [V, 3], camera frame, faces [F, 3].

    A ray t d meets the triangle a, b, c where the products d . (b x c), d . (c x a) and d . (a x b) have one sign; their sum
    is a . (b x c) / t.
    """
    mask = np.zeros((k.height, k.width), np.bool_)
    corners = points_cam[faces]
    corners = corners[(corners[:, :, 2] > NEAR_M).any(axis=1)]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    sides = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = np.einsum("fi,fi->f", a, sides[:, 0])
    z = np.where(corners[:, :, 2] > NEAR_M, corners[:, :, 2], np.nan)  # what passes the near plane may be anywhere
    low, high = [], []
    for axis, focal, centre, size in ((0, k.fx, k.cx, k.width), (1, k.fy, k.cy, k.height)):
        at = focal * corners[:, :, axis] / z + centre - 0.5
        low.append(np.nan_to_num(np.ceil(at.min(axis=1)), nan=0.0).clip(0, size).astype(np.int64))
        high.append(np.nan_to_num(np.floor(at.max(axis=1)), nan=size - 1.0).clip(-1, size - 1).astype(np.int64))
    wide, tall = (np.maximum(high[axis] - low[axis] + 1, 0) for axis in (0, 1))
    ends = np.cumsum(wide * tall)
    for first, stop in _blocks(ends):
        count = (wide * tall)[first:stop]
        of = np.repeat(np.arange(first, stop), count)
        place = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
        column, row = low[0][of] + place % wide[of], low[1][of] + place // wide[of]
        ray = np.stack([(column + 0.5 - k.cx) / k.fx, (row + 0.5 - k.cy) / k.fy, np.ones(len(of))], axis=1)
        products = np.einsum("nsi,ni->ns", sides[of], ray)
        total = products.sum(axis=1)
        met = ((products >= 0.0).all(axis=1) | (products <= 0.0).all(axis=1)) & (total != 0.0)
        met[met] = volume[of][met] / total[met] > NEAR_M
        mask[row[met], column[met]] = True
    return mask


def _blocks(ends: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """(first, stop) of runs of triangles with about `_AT_ONCE` pixels; ends: the running sum of their pixels."""
    first = 0
    while first < len(ends):
        before = int(ends[first - 1]) if first else 0
        stop = max(first + 1, int(np.searchsorted(ends, before + _AT_ONCE, side="right")))
        yield first, stop
        first = stop


def box_of(mask: NDArray[np.bool_]) -> Box:
    """The bounding box of a mask, as bop_toolkit's `calc_2d_bbox` has it: from the first pixel to the last, their difference."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return -1, -1, -1, -1
    x, y = int(columns[0]), int(rows[0])
    return x, y, int(columns[-1]) - x, int(rows[-1]) - y


def _window(shape: Shape, T_cam_obj: NDArray, camera: Camera) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) of a window that holds the image and the object, in the image's pixels."""
    k = camera.intrinsics
    u_low, v_low, u_high, v_high = project_bounds(transform(T_cam_obj, shape.vertices), k, NEAR_M)
    far_x, far_y = _FARTHEST * k.width, _FARTHEST * k.height
    left, right = np.clip([np.floor(u_low) - 1, np.ceil(u_high) + 1], -far_x, k.width + far_x).astype(int)
    top, bottom = np.clip([np.floor(v_low) - 1, np.ceil(v_high) + 1], -far_y, k.height + far_y).astype(int)
    return min(int(left), 0), min(int(top), 0), max(int(right), k.width), max(int(bottom), k.height)
