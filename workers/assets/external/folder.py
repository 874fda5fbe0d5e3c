"""Edge: a folder of URDFs or plain meshes, with a map from file patterns to categories."""

import hashlib
import importlib.util
from collections.abc import Collection, Mapping
from pathlib import Path

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import FolderSource, MeshLimits
from schemas.job.job import CATEGORIES
from schemas.scene.shape import Asset
from workers.assets.external.mesh import load_shape
from workers.assets.external.urdf_file import find_mesh, load_urdf, mesh_names, parse_urdf
from workers.assets.sources import (
    TABLE,
    UNKNOWN,
    UP_AXES,
    Entry,
    Listing,
    Placement,
    SourceShape,
    Weights,
    check_unchanged,
    found_in,
    hashed,
    licence_files,
    licence_of,
    mesh_files,
    placed_asset,
    tally,
)

PYBULLET_DATA = "pybullet_data"
PYBULLET_MAP: Mapping[str, str] = {
    "objects/mug.urdf": "mug",
    "table/table.urdf": TABLE,
    "table_square/table_square.urdf": TABLE,
    "random_urdfs/*/*.urdf": "box",
}
"""What of the meshes inside the pybullet_data package is one of our categories."""


def locate_folder(name: str, job_folder: Path) -> Path:
    """The folder of a source: relative to the job file, or the installed pybullet_data package's, without importing it."""
    if name == PYBULLET_DATA and not (job_folder / name).is_dir():
        spec = importlib.util.find_spec(PYBULLET_DATA)
        if spec is None or not spec.submodule_search_locations:
            raise AssetSourceError("the package pybullet_data is not installed: `pip install pybullet` brings it")
        return Path(spec.submodule_search_locations[0]).resolve()
    return (job_folder / Path(name).expanduser()).resolve()


def list_folder(settings: FolderSource, folder: Path, categories: Collection[str], limits: MeshLimits) -> Listing:
    """Every file that the map names, for the categories asked for; AssetSourceError where map or folder cannot be used.

    Reads and hashes these files and all that they refer to.
    """
    folder = folder.resolve()  # what lies in it is compared with its resolved path
    category_map = _map_of(settings, folder)
    entries: dict[str, list[Entry]] = {
        category: [] for category in sorted(set(category_map.values()) & set(categories))
    }
    skipped = []
    licences = licence_files(folder.rglob("*")) if settings.licence == UNKNOWN else []
    for path, category in sorted(_matches(category_map, folder).items()):
        if category not in entries:
            continue
        try:
            entries[category].append(_entry(settings, folder, path, limits, licences))
        except MeshError as error:
            skipped.append(error.reason)
    return Listing(folder, {category: tuple(found) for category, found in entries.items()}, tally(skipped))


def _matches(category_map: Mapping[str, str], folder: Path) -> dict[Path, str]:
    """The category of every file inside the folder that a pattern finds; the first pattern wins."""
    matches: dict[Path, str] = {}
    for pattern, category in category_map.items():
        try:
            found = [path for path in folder.glob(pattern) if path.is_file()]
        except (ValueError, NotImplementedError) as error:
            raise AssetSourceError(f"category_map: {pattern!r} is not a pattern below the folder: {error}") from error
        for path in found:
            if path.resolve().is_relative_to(folder):
                matches.setdefault(path.resolve(), category)
    return matches


def _map_of(settings: FolderSource, folder: Path) -> Mapping[str, str]:
    if not folder.is_dir():
        raise AssetSourceError(
            f"{folder} is not a folder. Set `folder` of the urdf source to one, or to `{PYBULLET_DATA}`."
        )
    category_map = settings.category_map or (PYBULLET_MAP if settings.folder == PYBULLET_DATA else {})
    if not category_map:
        raise AssetSourceError(
            f'{folder} needs a `category_map`, such as {{"mugs/*.obj": mug}}: nothing says what its files are. '
            f"It has {found_in(folder)}."
        )
    for pattern, category in category_map.items():
        if category not in (*CATEGORIES, TABLE):
            allowed = ", ".join((*CATEGORIES, TABLE))
            raise AssetSourceError(f"category_map: {pattern!r} is given {category!r}, which is none of {allowed}.")
    return category_map


def _entry(settings: FolderSource, folder: Path, path: Path, limits: MeshLimits, licences: list[Path]) -> Entry:
    paths = [path]
    if path.suffix.lower() == ".urdf":
        for name in mesh_names(parse_urdf(path)):
            paths += mesh_files(find_mesh(name, path, folder), folder, limits)
    else:
        paths = mesh_files(path, folder, limits)
    files = hashed(dict.fromkeys(paths), folder)
    identity = _instance_id(settings, files[0].path, files[0].sha256)
    return Entry(identity, files, licence_of(path, folder, settings.licence, licences))


def _instance_id(settings: FolderSource, relative: str, sha256: str) -> str:
    """The path as one word, and eight digits of a digest of the file and of the settings that shape it."""
    word = "".join(
        c if c.isascii() and (c.isalnum() or c in "-_.") else "-" for c in str(Path(relative).with_suffix(""))
    )
    how = (relative, sha256, settings.up, settings.scale, settings.diagonal_m)
    return f"{word}-{hashlib.sha256(repr(how).encode()).hexdigest()[:8]}"


def load_folder_entry(
    settings: FolderSource, listing: Listing, entry: Entry, category: str, limits: MeshLimits, weights: Weights
) -> Asset:
    """One file, cleaned, z up, scaled; MeshError where it is refused or has changed."""
    check_unchanged(listing.folder, entry)
    path = listing.folder / entry.files[0].path
    if path.suffix.lower() == ".urdf":
        found = load_urdf(path, listing.folder, limits)
    else:
        loaded = load_shape(path, limits, root=listing.folder)
        found = SourceShape(loaded.shape, loaded.notes)
    diagonal = None if category == TABLE else settings.diagonal_m
    return placed_asset(
        found,
        Placement(UP_AXES[settings.up], settings.scale, diagonal),
        entry=entry,
        category=category,
        source="urdf",
        shareable=settings.copy_assets,
        weights=weights,
    )
