"""Edge: loads an instance of a source of files as an asset: z up, metric, centred on its bounding box, weighed."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from schemas.base import Array, frozen_array
from schemas.errors import MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits, ShapeNetSource, UpAxis
from schemas.job.category import TABLE
from schemas.scene.shape import Asset
from workers.assets.external.caps import MOST_NOTES, one_line
from workers.assets.external.listing import Entry, check_unchanged, mesh_root
from workers.assets.external.mesh import LoadedMesh, load_shape, transform_shape
from workers.assets.external.upright import find_upright
from workers.assets.external.urdf_file import load_urdf
from workers.assets.mass import mass_properties
from workers.geometry.frames import pose

UP_AXES: Mapping[str, Array] = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""The rotation [3, 3] that takes a source's upward axis to z."""
OBJECT_SCALE, TABLE_SCALE = 0.25, 1.5
"""The article's factors on ShapeNetCore's normalised units."""


def load_entry(
    settings: ShapeNetSource | FolderSource, folder: Path, entry: Entry, category: str, assets: Assets
) -> Asset:
    """One instance, cleaned, z up, scaled; MeshError where its mesh is refused or has changed."""
    check_unchanged(folder, entry)
    path = folder / entry.files[0].path
    if path.suffix.lower() == ".urdf":
        loaded = load_urdf(path, assets.limits, folder)
    else:
        loaded = load_shape(path, assets.limits, mesh_root(settings, folder, path))
    return place_asset(loaded, entry, category, settings, assets)


def place_asset(
    loaded: LoadedMesh, entry: Entry, category: str, settings: ShapeNetSource | FolderSource, assets: Assets
) -> Asset:
    """The asset of a cleaned shape in its source's frame; MeshError `no_size` or `size` where its extent is not allowed."""
    diagonal_m = None
    if isinstance(settings, ShapeNetSource):
        axes, scale = UP_AXES["y"], settings.scale or (TABLE_SCALE if category == TABLE else OBJECT_SCALE)
    else:
        axes, scale = UP_AXES[settings.up_of(entry.files[0].path)], settings.scale
        diagonal_m = None if category == TABLE else settings.diagonal_m
    rotated = transform_shape(loaded.shape, pose(axes, np.zeros(3)))
    lower, upper = rotated.bounds
    diagonal = float(np.linalg.norm(upper - lower))
    if diagonal == 0.0:
        raise MeshError("no_size", f"{entry.files[0].path} has no extent")
    if not np.isfinite(diagonal):
        raise MeshError("not_finite", f"{entry.files[0].path} is too large for floating-point numbers")
    scale = scale if diagonal_m is None else diagonal_m / diagonal
    _check_size(entry.files[0].path, scale * diagonal, assets.limits)
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
        T_source_to_object=frozen_array(pose(axes, -centre)),
        scale=scale,
        watertight=mass.solid,
        volume_m3=mass.mass_kg / assets.density_kg_m3 if mass.solid else None,
        shareable=settings.copy_assets,
        notes=tuple(one_line(note) for note in loaded.notes[:MOST_NOTES]),
    )


def find_doubt(asset: Asset, settings: ShapeNetSource | FolderSource, hull_vertices: Array) -> UpAxis | None:
    """The axis of its file on which alone an asset stands, where `up` names another; None where nothing speaks against `up`.

    hull_vertices [H, 3] of the asset's convex hull, object frame.
    """
    if isinstance(settings, ShapeNetSource) or asset.path is None or not settings.category_map:
        return None  # what pybullet_data's own map names lies as it happens to
    R_object_source = asset.T_source_to_object[:3, :3]
    found = find_upright(hull_vertices @ R_object_source, asset.mass.com @ R_object_source)
    sure = found is not None and found.confidence == "sure" and found.axis != settings.up_of(asset.path)
    return found.axis if found is not None and sure else None


def _check_size(name: str, diagonal_m: float, limits: MeshLimits) -> None:
    """MeshError `size` where a body is so small or large that nothing about it could be simulated or seen."""
    for over, word, key, cap in (
        (diagonal_m < limits.min_size_m, "under", "min_size_m", limits.min_size_m),
        (diagonal_m > limits.max_size_m, "over", "max_size_m", limits.max_size_m),
    ):
        if over:
            remedy = "set `scale` (0.001 for millimetres) or `diagonal_m` of its source"
            raise MeshError("size", f"{name} is {diagonal_m:.3g} m across, {word} {key} = {cap:g}: {remedy}")
