"""The posed geometry of a stored capture: its board, and the mesh that was reconstructed from it."""

import io
from collections.abc import Iterator

import trimesh
from trimesh.visual import ColorVisuals

from schemas.base import Pose
from schemas.dataset.codec import Row, read_world_poses
from schemas.dataset.layout import asset_path
from schemas.errors import CorruptError
from schemas.scene.region import REGION_FIRST_OBJECT, REGION_TABLE
from services.read.dataset_reader import StoredRange
from workers.assets.external.formats import read_visual
from workers.store.store import Store


def captured_geometry(store: Store, stored: StoredRange, row: Row) -> Iterator[tuple[str, trimesh.Trimesh, Pose]]:
    """(name, mesh, T_world_mesh) of board and object. Raises CorruptError where the stored shape cannot be read."""
    T_world = read_world_poses(row)
    board = next(asset for asset in stored.rows["assets"] if asset["instance_id"] == row["table_id"])
    x, y, _ = (0.5 * size for size in board["extents_m"])
    rectangle = trimesh.Trimesh([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    yield f"board {row['table_id']}", rectangle, T_world[REGION_TABLE]
    path = asset_path(row["category"], row["instance_id"])
    try:
        scene = trimesh.load_scene(io.BytesIO(store.read(path)), file_type="glb", process=False)
    except Exception as error:  # trimesh raises errors of many kinds for a damaged file
        raise CorruptError(
            f"{path} cannot be read: {error}; `verso replay {store.name} --repair` makes it again"
        ) from error
    for mesh in scene.geometry.values():
        visual, _ = read_visual(mesh, linear=True)
        mesh.visual = ColorVisuals(mesh, vertex_colors=visual.colors)
        yield f"{row['category']} {row['instance_id']}", mesh, T_world[REGION_FIRST_OBJECT]
