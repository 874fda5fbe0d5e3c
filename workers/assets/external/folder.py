"""Edge: a folder of URDFs or plain meshes, with a map from file patterns to categories."""

import importlib.util
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from schemas.errors import AssetSourceError
from schemas.job.assets import FolderSource
from schemas.job.category import TABLE
from schemas.job.pattern import matches
from workers.assets.external.listing import describe_folder

PYBULLET_DATA = "pybullet_data"
PYBULLET_MAP: Mapping[str, str] = {
    "objects/mug.urdf": "mug",
    "table/table.urdf": TABLE,
    "table_square/table_square.urdf": TABLE,
    "random_urdfs/*/*.urdf": "box",
}
"""The category of each mesh inside the pybullet_data package that has one."""


def locate_folder(name: str, job_folder: Path) -> Path:
    """The folder of a source: relative to the job file, or that of the installed package pybullet_data, not imported."""
    if name == PYBULLET_DATA and not (job_folder / name).is_dir():
        spec = importlib.util.find_spec(PYBULLET_DATA)
        if spec is None or not spec.submodule_search_locations:
            raise AssetSourceError("the package pybullet_data is not installed: `pip install pybullet` brings it")
        return Path(spec.submodule_search_locations[0]).resolve()
    try:
        return (job_folder / Path(name).expanduser()).resolve()
    except RuntimeError as error:
        raise AssetSourceError(f"{name}: there is no such user, or no home folder") from error


def find_files(
    settings: FolderSource, job_folder: Path, categories: Collection[str]
) -> tuple[Path, dict[str, list[Path]]]:
    """The source's folder, and every file that the map names by category, of the categories asked for.

    Raises AssetSourceError where map or folder cannot be used.
    """
    folder = locate_folder(settings.folder, job_folder)
    category_map = _read_map(settings, folder)
    found: dict[str, list[Path]] = {category: [] for category in sorted(set(category_map.values()) & set(categories))}
    matched = _match_files(category_map, folder)
    _check_up(settings, folder, matched)
    for path, category in sorted(matched.items()):
        if category in found:
            found[category].append(path)
    return folder, found


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


def _check_up(settings: FolderSource, folder: Path, files: Iterable[Path]) -> None:
    """AssetSourceError for a pattern of `up` that finds none of the files: it is most likely misspelt."""
    if isinstance(settings.up, str):
        return
    names = [path.relative_to(folder).as_posix() for path in files]
    for pattern in settings.up:
        if not any(matches(name, pattern) for name in names):
            first = ", ".join(names[:3])
            raise AssetSourceError(
                f"up: {pattern!r} finds none of the {len(names)} files of {folder} (such as {first})"
            )


def _read_map(settings: FolderSource, folder: Path) -> Mapping[str, str]:
    """The category by file pattern; AssetSourceError where there is none."""
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
    return category_map
