"""Assets of a capture: the object as it was reconstructed, and the board that it stands on. Pure."""

from dataclasses import dataclass

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.capture import Reconstruction
from schemas.job.assets import Assets
from schemas.job.captures import Board
from schemas.scene.shape import Asset, Material, Part, Shape
from workers.assets.builtin.make import shape_digest
from workers.assets.external.mesh import is_solid
from workers.assets.mass import mass_properties
from workers.geometry.frames import translation

BOARD = "board"
"""Category of the board in `objects` and `assets`."""

ROUGHNESS = 0.8
"""Of a reconstructed surface, whose reflection nobody measured."""

NOTE = "reconstructed from a capture: what no view saw, and what lies below the clearance above the board, is missing"


@dataclass(frozen=True)
class CaptureNames:
    """What an object is called: the capture's instance id, category, licence, and `source` of its shape."""

    instance_id: str
    category: str
    licence: str
    source: str


def reconstructed_asset(found: Reconstruction, names: CaptureNames, settings: Assets) -> tuple[Asset, Pose]:
    """The merged mesh in its object frame, and T_board_obj [4, 4]: the origin at the middle of the bounding box.

    The axes are the board's. Mass is that of a thin shell, unless the mesh is closed.
    """
    centre = 0.5 * (found.vertices.min(axis=0) + found.vertices.max(axis=0))
    opaque = np.full((len(found.vertex_colors), 1), 255, np.uint8)
    part = Part(
        "surface",
        frozen_array(found.vertices - centre),
        frozen_array(found.faces, np.int32),
        Material(base_color=(1.0, 1.0, 1.0, 1.0), roughness=ROUGHNESS),
        colors=frozen_array(np.concatenate([found.vertex_colors, opaque], axis=1), np.uint8),
    )
    shape = Shape((part,), closed=is_solid(part.vertices, part.faces.astype(np.int64)))
    T_board_obj = frozen_array(translation(*centre))
    return _asset(names, shape, settings, frozen_array(translation(*-centre)), (NOTE,)), T_board_obj


def board_asset(board: Board, settings: Assets) -> Asset:
    """The board as a rectangle at the print's true size, in the board frame."""
    x, y = 0.5 * board.scale * board.width_m, 0.5 * board.scale * board.height_m
    corners = frozen_array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    shape = Shape((Part("board", corners, frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)),))
    size = f"{board.columns}x{board.rows}-{1e3 * board.scale * board.marker_m:g}mm"
    names = CaptureNames(f"{board.dictionary}-{size}-from-{board.first_id}", BOARD, "CC0-1.0", BOARD)
    return _asset(names, shape, settings, frozen_array(np.eye(4)), ("its markers are not drawn",))


def _asset(
    names: CaptureNames, shape: Shape, settings: Assets, T_source_to_object: Pose, notes: tuple[str, ...]
) -> Asset:
    mass = mass_properties(shape, settings.density_kg_m3, settings.shell_kg_m2)
    return Asset(
        instance_id=names.instance_id,
        category=names.category,
        source=names.source,
        licence=names.licence,
        path=None,
        sha256=shape_digest(shape),
        shape=shape,
        mass=mass,
        T_source_to_object=T_source_to_object,
        scale=1.0,
        watertight=mass.solid,
        volume_m3=mass.mass_kg / settings.density_kg_m3 if mass.solid else None,
        shareable=True,
        notes=notes,
    )
