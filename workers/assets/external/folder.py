"""Edge: a folder of URDFs or plain meshes, with a map from file patterns to categories."""

import hashlib
import importlib.util
from collections.abc import Collection, Mapping
from pathlib import Path

from schemas.errors import AssetSourceError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from schemas.scene.shape import Asset
from workers.assets.categories import ASSET_CATEGORIES, TABLE
from workers.assets.external.listing import Entry, Listing, describe_folder, hash_files, list_entries
from workers.assets.external.mesh import load_shape
from workers.assets.external.placement import UP_AXES, Placement, place_asset
from workers.assets.external.reading import list_mesh_files
from workers.assets.external.urdf_file import find_mesh, load_urdf, mesh_names, parse_urdf

PYBULLET_DATA = "pybullet_data"
PYBULLET_MAP: Mapping[str, str] = {
    "objects/mug.urdf": "mug",
    "table/table.urdf": TABLE,
    "table_square/table_square.urdf": TABLE,
    "random_urdfs/*/*.urdf": "box",
}
"""What of the meshes inside the pybullet_data package is one of our categories."""

UNKNOWN = "unknown"
"""The licence of a source whose user states none."""


def locate_folder(name: str, job_folder: Path) -> Path:
    """The folder of a source: relative to the job file, or the installed pybullet_data package's, without importing it."""
    if name == PYBULLET_DATA and not (job_folder / name).is_dir():
        spec = importlib.util.find_spec(PYBULLET_DATA)
        if spec is None or not spec.submodule_search_locations:
            raise AssetSourceError("the package pybullet_data is not installed: `pip install pybullet` brings it")
        return Path(spec.submodule_search_locations[0]).resolve()
    return (job_folder / Path(name).expanduser()).resolve()


def list_folder(settings: FolderSource, job_folder: Path, categories: Collection[str], limits: MeshLimits) -> Listing:
    """Every file that the map names, for the categories asked for; AssetSourceError where map or folder cannot be used.

    Reads and hashes these files and all that they refer to.
    """
    folder = locate_folder(settings.folder, job_folder)
    category_map = _read_map(settings, folder)
    candidates: dict[str, list[Path]] = {name: [] for name in sorted(set(category_map.values()) & set(categories))}
    for path, category in sorted(_match_files(category_map, folder).items()):
        if category in candidates:
            candidates[category].append(path)
    licences = list_licences(folder) if settings.licence == UNKNOWN else []
    return list_entries(folder, candidates, lambda path: _make_entry(settings, folder, path, limits, licences))


def _match_files(category_map: Mapping[str, str], folder: Path) -> dict[Path, str]:
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


def _read_map(settings: FolderSource, folder: Path) -> Mapping[str, str]:
    """The category by file pattern; AssetSourceError where there is none or it names another category."""
    if not folder.is_dir():
        raise AssetSourceError(
            f"{folder} is not a folder. Set `folder` of the urdf source to one, or to `{PYBULLET_DATA}`."
        )
    category_map = settings.category_map or (PYBULLET_MAP if settings.folder == PYBULLET_DATA else {})
    if not category_map:
        raise AssetSourceError(
            f'{folder} needs a `category_map`, such as {{"mugs/*.obj": mug}}: nothing says what its files are. '
            f"It has {describe_folder(folder)}."
        )
    for pattern, category in category_map.items():
        if category not in ASSET_CATEGORIES:
            allowed = ", ".join(ASSET_CATEGORIES)
            raise AssetSourceError(f"category_map: {pattern!r} is given {category!r}, which is none of {allowed}.")
    return category_map


def _make_entry(settings: FolderSource, folder: Path, path: Path, limits: MeshLimits, licences: list[Path]) -> Entry:
    if path.suffix.lower() == ".urdf":
        meshes = [find_mesh(name, path, folder) for name in mesh_names(parse_urdf(path))]
        paths = [path, *(file for mesh in meshes for file in list_mesh_files(mesh, folder, limits))]
    else:
        paths = list_mesh_files(path, folder, limits)
    files = hash_files(dict.fromkeys(paths), folder)
    identity = _instance_id(settings, files[0].path, files[0].sha256)
    return Entry(identity, files, find_licence(path, folder, settings.licence, licences))


def _instance_id(settings: FolderSource, relative: str, sha256: str) -> str:
    """The path as one word, and eight digits of a digest of the file and of the settings that shape it."""
    stem = str(Path(relative).with_suffix(""))
    word = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "-" for c in stem)
    how = (relative, sha256, settings.up, settings.scale, settings.diagonal_m)
    return f"{word}-{hashlib.sha256(repr(how).encode()).hexdigest()[:8]}"


def list_licences(folder: Path) -> list[Path]:
    """The files below a folder whose name is a licence's."""
    return sorted(path for path in folder.rglob("*") if path.stem.lower() in ("license", "licence", "copying"))


def find_licence(path: Path, folder: Path, stated: str, licences: Collection[Path]) -> str:
    """The stated licence; where none is stated, the nearest licence file from the mesh's folder up to the source's."""
    if stated == UNKNOWN:
        for parent in path.parents:
            for file in licences:
                if file.parent == parent:
                    return f"see {file.relative_to(folder).as_posix()}"
    return stated


def load_folder_entry(settings: FolderSource, folder: Path, entry: Entry, category: str, assets: Assets) -> Asset:
    """One file, cleaned, z up, scaled; MeshError where it is refused."""
    path = folder / entry.files[0].path
    load = load_urdf if path.suffix.lower() == ".urdf" else load_shape
    placement = Placement(UP_AXES[settings.up], settings.scale, None if category == TABLE else settings.diagonal_m)
    return place_asset(load(path, assets.limits, folder), placement, entry, category, settings, assets)
