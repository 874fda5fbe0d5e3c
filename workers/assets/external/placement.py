"""Pure: a cleaned shape becomes an asset: z up, metric, centred on its bounding box, with its mass."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, frozen_array
from schemas.errors import MeshError
from schemas.job.assets import Assets, FolderSource, ShapeNetSource
from schemas.scene.shape import Asset
from workers.assets.external.listing import Entry
from workers.assets.external.mesh import LoadedMesh, transform_shape
from workers.assets.mass import mass_properties
from workers.geometry.frames import pose

UP_AXES: Mapping[str, Array] = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""The rotation [3, 3] that takes a source's upward axis to z."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Source coordinates to the object frame: rotated by `axes` [3, 3], then times `scale` or to a diagonal in metres."""

    axes: Array
    scale: float
    diagonal_m: float | None = None


def place_asset(
    loaded: LoadedMesh,
    placement: Placement,
    entry: Entry,
    category: str,
    settings: ShapeNetSource | FolderSource,
    assets: Assets,
) -> Asset:
    """The asset of a cleaned shape in its source's frame; MeshError `no_size` where the shape has no extent."""
    rotated = transform_shape(loaded.shape, pose(placement.axes, np.zeros(3)))
    lower, upper = rotated.bounds
    diagonal = float(np.linalg.norm(upper - lower))
    if diagonal == 0.0:
        raise MeshError("no_size", f"{entry.files[0].path} has no extent")
    scale = placement.scale if placement.diagonal_m is None else placement.diagonal_m / diagonal
    centre = 0.5 * (lower + upper) * scale
    shape = transform_shape(rotated, pose(scale * np.eye(3), -centre))
    mass = mass_properties(shape, assets.density_kg_m3, assets.shell_kg_m2)
    return Asset(
        instance_id=entry.instance_id,
        category=category,
        source=settings.source,
        licence=entry.licence,
        path=entry.files[0].path,
        sha256=entry.files[0].sha256,
        shape=shape,
        mass=mass,
        T_source_to_object=frozen_array(pose(placement.axes, -centre)),
        scale=scale,
        watertight=mass.solid,
        volume_m3=mass.mass_kg / assets.density_kg_m3 if mass.solid else None,
        shareable=settings.copy_assets,
        notes=loaded.notes,
    )
