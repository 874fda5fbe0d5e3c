"""The shapes of a dataset's objects, stored or from the job's sources, and the posed geometry of a stored scene or capture."""

import io
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals

from schemas.dataset.codec import Row, read_matrix, read_world_poses
from schemas.dataset.layout import asset_path
from schemas.errors import CorruptError, InputError, MachineError, VersoError, needs_making
from schemas.job.assets import TABLE
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE, Asset
from services.job.record import JobRecord, require_job
from services.read.dataset_reader import as_damage, find_scene, region_names
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
        self.record = record

    def asset(self, category: str, instance_id: str) -> Asset:
        """An object, or a table, of the job.

        Raises CorruptError for a capture, which has no other source; InputError where the sources cannot be read here,
        MachineError where they have changed or what makes data is not installed, SceneError where the mesh is refused.
        """
        path = asset_path(category, instance_id)
        if self.record.job.captures is not None:
            raise CorruptError(f"{path} is missing: `verso verify OUT` says what to do")
        missing = f"{path} is not in the dataset (its licence is not free, or assets.copy_assets is off), and"
        with needs_making(missing):
            from workers.assets.catalogue import load_asset
            from workers.scene.draw.studio import scaled_to
        try:
            catalogue = self.catalogue
        except InputError as error:
            raise InputError(f"{missing} its source cannot be read here: {error}") from error
        if (ref := catalogue.find(instance_id, category == TABLE)) is None:
            raise CorruptError(f"the job has no {category} {instance_id}: restore job.yaml from a copy")
        asset, job = load_asset(catalogue, ref), self.record.job
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
            return open_recorded(self.record)
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
    with as_damage(path):
        scene: Any = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        if not scene.geometry:
            raise ValueError("it has no mesh")
    meshes: Mapping[str, trimesh.Trimesh] = scene.geometry
    return meshes


def read_meshes(read: ReadShape, sources: Sources, name: tuple[str, str]) -> list[Named]:
    """The parts of the shape called (category, instance id), object frame, metres; colours are linear, as glTF has them.

    Raises CorruptError where the stored shape is damaged, and as `Sources.asset` where none is stored.
    """
    path = asset_path(*name)
    try:
        data = read(path)
    except FileNotFoundError:
        return [(part.name, mesh_of_part(part)) for part in sources.asset(*name).shape.parts]
    # A part gives its name to its material; trimesh names a mesh by the object.
    named = [
        (getattr(getattr(mesh.visual, "material", None), "name", None) or key, mesh)
        for key, mesh in load_glb(data, path).items()
    ]
    return [(part, show_colors(mesh)) for part, mesh in named]


def posed_scene(store: Store, scene_id: int) -> trimesh.Scene:
    """Floor, walls, table or board and clutter, as far as there are, and objects where the stored rows put them.

    Raises InputError where the scene was not made.
    """
    record, stored = require_job(store), find_scene(store, scene_id)
    row = stored.scene(scene_id)
    if row is None:
        reason = next((f["reason"] for f in stored.rows["failures"] if f["scene_id"] == scene_id), "unknown")
        raise InputError(f"scene {scene_id} was not made ({reason}): it has no geometry")
    return pose_shapes(store.read, row, stored.rows["assets"], Sources(record))


def pose_shapes(read: ReadShape, row: Mapping[str, Any], assets: Iterable[Row], sources: Sources) -> trimesh.Scene:
    """The same for a row of `scenes` and the rows of `assets`: world frame, z up, metres. Raises as `read_meshes`.

    Floor and walls are drawn again, being in no file; where what makes data is not installed there are none.
    """
    T_world, names, scene = {REGION_FLOOR: np.eye(4), **read_world_poses(row)}, region_names(row), trimesh.Scene()
    several = len(T_world) > 3
    placed: list[tuple[str, int, list[Named]]] = []
    for piece in (row["surroundings"] or {}).get("clutter") or ():
        of = piece["category"], piece["instance_id"]
        T_world[piece["region_id"]] = read_matrix(piece["T_world_obj"])
        placed.append(
            (f"clutter {' '.join(of)} {piece['region_id']}", piece["region_id"], read_meshes(read, sources, of))
        )
    if sources.record.job.captures is not None:
        placed.append((f"board {names.pop(REGION_TABLE)[1]}", REGION_TABLE, [("board", _board(assets, row))]))
    elif REGION_TABLE in names:
        placed += [(name, REGION_FLOOR, parts) for name, parts in _ground(sources, row["scene_id"]).items()]
    for region_id, of in names.items():
        # Two objects may be of one instance: only the region id tells them apart.
        region = f" {region_id}" if several and region_id >= REGION_FIRST_OBJECT else ""
        placed.append((f"{' '.join(of)}{region}", region_id, read_meshes(read, sources, of)))
    for label, region_id, meshes in placed:
        for number, (name, mesh) in enumerate(meshes):
            part = f"{label}/{number}-{name}"
            scene.add_geometry(mesh, geom_name=part, node_name=part, transform=T_world[region_id])
    return scene


def _ground(sources: Sources, scene_id: int) -> dict[str, list[Named]]:
    """The parts of `floor` and, in a room, of `walls`, world frame."""
    try:
        with needs_making("the floor"):
            from workers.assets.look.appearance import draw_appearance
            from workers.assets.look.environment import relight
            from workers.assets.look.lights import draw_environment, draw_lights
            from workers.assets.look.surroundings import build_room
            from workers.scene.chance import SceneChance, Stream
            from workers.scene.draw.surround import ROOM, lay_floor
    except MachineError:
        return {}
    job = sources.record.job
    chance, look = SceneChance(job.seed, scene_id), job.drawn_look
    floor, appearance = draw_appearance(chance.stream(Stream.APPEARANCE), job.render.tier)
    floor = floor if look.floor is None else lay_floor(look.floor, sources.catalogue, chance, floor)[0]
    shapes = {"floor": floor}
    if look.room is not None:  # whose window is where the light comes from
        lights = None if look.lights is None else draw_lights(chance.stream(Stream.LIGHTS), look.lights)
        if (around := look.environment) is None:
            lit = relight(appearance, lights, None, True)
        else:
            map_of = draw_environment(chance.stream(Stream.ENVIRONMENT), around, sources.catalogue.maps)
            lit = relight(appearance, lights, map_of, True)
        walls = build_room(look.room, lit.lights[0].direction, chance.stream(Stream.SURROUNDINGS, ROOM))
        shapes["walls"] = walls.shape
    return {name: [(part.name, mesh_of_part(part)) for part in shape.parts] for name, shape in shapes.items()}


def _board(assets: Iterable[Row], row: Mapping[str, Any]) -> trimesh.Trimesh:
    """The rectangle of a capture's board, its frame, metres."""
    board = next(asset for asset in assets if asset["instance_id"] == row["table_id"])
    x, y, _ = (0.5 * size for size in board["extents_m"])
    corners = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual = ColorVisuals(mesh, vertex_colors=linear_bytes(ColorVisuals(mesh).vertex_colors / 255.0))
    return mesh
