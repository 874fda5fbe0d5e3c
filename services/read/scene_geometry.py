"""The shapes of a dataset's objects, stored or from the job's sources, and the posed geometry of a stored scene or capture."""

import io
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals

from schemas.dataset.codec import Row, read_world_poses
from schemas.dataset.layout import asset_path
from schemas.errors import CorruptError, InputError, MachineError, VersoError, needs_making
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE, Asset
from services.job.record import JobRecord, require_job
from services.read.dataset_reader import StoredRange, find_scene, region_names
from workers.assets.glb import linear_bytes, mesh_of_part, show_colors
from workers.store.store import Store

if TYPE_CHECKING:
    from workers.assets.catalogue import Catalogue

ReadShape = Callable[[str], bytes]
"""Returns the bytes of a stored shape by its path. Raises FileNotFoundError."""


Named = tuple[str, trimesh.Trimesh]
"""A part's name and its mesh."""


class Sources:
    """Makes or reads again the shapes that are not in the dataset. Needs what makes data."""

    def __init__(self, record: JobRecord) -> None:
        self._record = record

    def asset(self, scene_id: int, category: str, instance_id: str) -> Asset:
        """An object, or the table, of a scene of the job.

        Raises CorruptError for a capture, which has no other source; InputError where the sources cannot be read here,
        MachineError where they have changed or what makes data is not installed, SceneError where the mesh is refused.
        """
        path = asset_path(category, instance_id)
        if self._record.job.captures is not None:
            raise CorruptError(f"{path} is missing: `verso verify OUT` says what to do")
        missing = f"{path} is not in the dataset (its licence is not free, or assets.copy_assets is off), and"
        with needs_making(missing):
            from workers.assets.catalogue import load_asset
            from workers.scene.chance import SceneChance
            from workers.scene.draw.plan import choose_assets
            from workers.scene.draw.studio import scaled_to
        try:
            catalogue = self.catalogue
        except InputError as error:
            raise InputError(f"{missing} its source cannot be read here: {error}") from error
        objects, table = choose_assets(self._record.job, catalogue, SceneChance(self._record.job.seed, scene_id))
        ref = next(
            (one for one in (*objects, table) if (one.category, one.instance_id) == (category, instance_id)), None
        )
        if ref is None:
            raise CorruptError(
                f"scene {scene_id} of the job has no {category} {instance_id}: restore job.yaml from a copy"
            )
        asset, job = load_asset(catalogue, ref), self._record.job
        return scaled_to(asset, job.studio) if job.scene == "studio" else asset

    @property
    def catalogue(self) -> "Catalogue":
        """The job's catalogue. Raises as it was opened."""
        if isinstance(self._opened, Exception):
            raise self._opened
        return self._opened

    @cached_property
    def _opened(self) -> "Catalogue | VersoError | OSError":
        """The job's catalogue, or why it cannot be used: found once, because every file of the sources is read for it."""
        try:
            return open_recorded(self._record)
        except (VersoError, OSError) as error:
            return error


def open_recorded(record: JobRecord) -> "Catalogue":
    """The catalogue of a stored job. Raises MachineError where its files are others now, and as `open_sources`."""
    from workers.capture.results import open_sources

    catalogue = open_sources(record.job, Path(record.folder))
    if catalogue.digest != record.catalogue:
        changed = record.describe_change(tuple(listing.sha256 for listing in catalogue.captures))
        raise MachineError(f"{changed} (from {record.folder}) do not hold what they held when this job was run")
    return catalogue


def load_glb(data: bytes, path: str) -> Mapping[str, trimesh.Trimesh]:
    """The parts of a stored shape by name, object frame, metres. Raises CorruptError where it is damaged."""
    try:
        meshes: Mapping[str, trimesh.Trimesh] = trimesh.load_scene(
            io.BytesIO(data), file_type="glb", process=False
        ).geometry
        if not meshes:
            raise ValueError("it has no mesh")
        return meshes
    except Exception as error:  # trimesh raises errors of many kinds for a damaged file
        raise CorruptError(f"{path} cannot be read: {error}; `verso verify OUT` says what to do") from error


def read_meshes(read: ReadShape, sources: Sources, scene_id: int, name: tuple[str, str]) -> list[Named]:
    """The parts of the shape called (category, instance id), object frame, metres; colours are linear, as glTF has them.

    Raises CorruptError where the stored shape is damaged, and as `Sources.asset` where none is stored.
    """
    path = asset_path(*name)
    try:
        data = read(path)
    except FileNotFoundError:
        return [(part.name, mesh_of_part(part)) for part in sources.asset(scene_id, *name).shape.parts]
    # A part gives its name to its material; trimesh names a mesh by the object.
    named = [
        (getattr(getattr(mesh.visual, "material", None), "name", None) or key, mesh)
        for key, mesh in load_glb(data, path).items()
    ]
    return [(part, show_colors(mesh)) for part, mesh in named]


def posed_scene(store: Store, scene_id: int) -> trimesh.Scene:
    """Floor, table or board, as far as there are, and objects where the stored rows put them.

    Raises InputError where the scene was not made.
    """
    record, stored = require_job(store), find_scene(store, scene_id)
    row = stored.scene(scene_id)
    if row is None:
        reason = next((f["reason"] for f in stored.rows["failures"] if f["scene_id"] == scene_id), "unknown")
        raise InputError(f"scene {scene_id} was not made ({reason}): it has no geometry")
    return pose_shapes(store, stored, row, record, Sources(record))


def pose_shapes(store: Store, stored: StoredRange, row: Row, record: JobRecord, sources: Sources) -> trimesh.Scene:
    """The same for a row of `scenes`: world frame, z up, metres. Raises as `read_meshes`.

    The floor is drawn again, its look being in no file; where what makes data is not installed there is none.
    """
    T_world, names, scene = {REGION_FLOOR: np.eye(4), **read_world_poses(row)}, region_names(row), trimesh.Scene()
    placed: list[tuple[str, int, list[Named]]] = []
    if record.job.captures is not None:
        placed.append((f"board {names.pop(REGION_TABLE)[1]}", REGION_TABLE, [("board", _board(stored, row))]))
    elif REGION_TABLE in names:
        placed.append(("floor", REGION_FLOOR, _floor(record, sources, row["scene_id"])))
    for region_id, of in names.items():
        # Two objects may be of one instance: only the region id tells them apart.
        region = f" {region_id}" if len(T_world) > 3 and region_id >= REGION_FIRST_OBJECT else ""
        placed.append((f"{' '.join(of)}{region}", region_id, read_meshes(store.read, sources, row["scene_id"], of)))
    for label, region_id, meshes in placed:
        for number, (name, mesh) in enumerate(meshes):
            part = f"{label}/{number}-{name}"
            scene.add_geometry(mesh, geom_name=part, node_name=part, transform=T_world[region_id])
    return scene


def _floor(record: JobRecord, sources: Sources, scene_id: int) -> list[Named]:
    try:
        with needs_making("the floor"):
            from workers.assets.look.appearance import draw_appearance
            from workers.scene.chance import SceneChance, Stream
            from workers.scene.draw.surround import lay_floor
    except MachineError:
        return []
    chance, look = SceneChance(record.job.seed, scene_id), record.job.drawn_look
    floor, _ = draw_appearance(chance.stream(Stream.APPEARANCE), record.job.render.tier)
    floor = floor if look.floor is None else lay_floor(look.floor, sources.catalogue, chance, floor)[0]
    return [(part.name, mesh_of_part(part)) for part in floor.parts]


def _board(stored: StoredRange, row: Row) -> trimesh.Trimesh:
    """The rectangle of a capture's board, its frame, metres."""
    board = next(asset for asset in stored.rows["assets"] if asset["instance_id"] == row["table_id"])
    x, y, _ = (0.5 * size for size in board["extents_m"])
    corners = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual = ColorVisuals(mesh, vertex_colors=linear_bytes(ColorVisuals(mesh).vertex_colors / 255.0))
    return mesh
