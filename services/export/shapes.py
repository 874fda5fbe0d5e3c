"""Shapes of a dataset's instances with a colour for each vertex: from the stored GLB files, or else from the job's sources."""

import io
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.codec import Row
from schemas.dataset.layout import asset_path
from schemas.errors import CorruptError, SceneError
from schemas.scene.shape import Material, Part, Shape
from services.export.source import ExportScene
from services.export.sources import unchanged_sources
from services.job.record import JobRecord
from workers.assets.catalogue import Catalogue, load_asset
from workers.assets.external.formats import read_visual
from workers.plan.randomness import SceneChance
from workers.plan.step import choose_assets
from workers.store.store import Store

_KEPT = 32
"""Shapes that are kept: those of a few scenes."""


@dataclass(frozen=True, eq=False)
class ColoredShape:
    """A shape in the object frame, metres, z up, and `colors` [V, 3] uint8 sRGB of its vertices, part after part."""

    shape: Shape
    colors: NDArray[np.uint8]


class Shapes:
    """Loads shapes by instance; keeps the last few."""

    def __init__(self, store: Store, record: JobRecord) -> None:
        self._store = store
        self._record = record
        self._kept: OrderedDict[str, ColoredShape | None] = OrderedDict()

    def load(self, scene: ExportScene, instance_id: str) -> ColoredShape | None:
        """The shape of an instance of this scene; None where it is not stored and the job's sources are not here.

        Raises CorruptError where a stored shape is damaged.
        """
        if instance_id not in self._kept:
            row = scene.assets[instance_id]
            path = asset_path(row["category"], instance_id)
            try:
                data = scene.read(path)
            except CorruptError:  # it is not stored: only shapes that may be passed on are
                shape = self._from_sources(scene, row)
            else:
                shape = self._decode(path, data)
            self._kept[instance_id] = None if shape is None else color_vertices(shape)
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return self._kept[instance_id]

    def _decode(self, path: str, data: bytes) -> Shape:
        try:
            scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
            return Shape(tuple(_part(name, mesh) for name, mesh in scene.geometry.items()))
        except Exception as error:  # trimesh raises errors of many kinds for a damaged file
            told = f"{path} cannot be read: {error}; `verso replay {self._store.name} --repair` makes it again"
            raise CorruptError(told) from error

    def _from_sources(self, scene: ExportScene, row: Row) -> Shape | None:
        if self._catalogue is None:
            return None
        chance = SceneChance(self._record.job.seed, scene.scene_id)
        objects, _ = choose_assets(self._record.job, self._catalogue, chance)
        ref = next((ref for ref in objects if ref.instance_id == row["instance_id"]), None)
        try:
            asset = None if ref is None else load_asset(self._catalogue, ref)
        except SceneError:
            return None
        return asset.shape if asset is not None and asset.sha256 == row["sha256"] else None

    @cached_property
    def _catalogue(self) -> Catalogue | None:
        return unchanged_sources(self._record)


def _part(name: str, mesh: trimesh.Trimesh) -> Part:
    visual, _ = read_visual(mesh, linear=True)
    faces = np.asarray(mesh.faces, dtype=np.int32)
    normals = np.asarray(mesh.vertex_normals, dtype=np.float64)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    return Part(name, vertices, faces, visual.material, normals, visual.uv, visual.colors)


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
