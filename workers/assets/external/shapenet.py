"""Edge: a user's own copy of ShapeNetCore, version 1 or 2 (dataset.md section 1, "ShapeNet")."""

from collections.abc import Collection
from pathlib import Path

from schemas.errors import AssetSourceError
from schemas.job.assets import ShapeNetSource
from schemas.job.category import TABLE
from workers.assets.external.folder import locate_folder
from workers.assets.external.listing import describe_folder

SYNSETS: dict[str, str] = {
    "bottle": "02876657",
    "bowl": "02880940",
    "camera": "02942699",
    "can": "02946921",
    "jar": "03593526",
    "laptop": "03642806",
    "mug": "03797390",
    TABLE: "04379243",
}
"""ShapeNetCore's synset of each category; it has no box."""

_MESHES = ("models/model_normalized.obj", "model.obj")
"""Where the mesh lies in a model's folder: version 2, version 1."""


def find_models(
    settings: ShapeNetSource, job_folder: Path, categories: Collection[str]
) -> tuple[Path, dict[str, list[Path]]]:
    """The source's folder, and the mesh of every model by category, of the categories that ShapeNetCore has.

    Raises AssetSourceError where the folder is not ShapeNetCore's.
    """
    folder = locate_folder(settings.folder, job_folder)
    if not folder.is_dir():
        raise AssetSourceError(
            f"{folder} is not a folder. Set `folder` of the shapenet source to your copy of ShapeNetCore: the folder "
            "that holds synset folders such as 03797390."
        )
    wanted = {category: folder / SYNSETS[category] for category in sorted(categories) if category in SYNSETS}
    if wanted and not any(synset.is_dir() for synset in wanted.values()):
        names = ", ".join(f"{synset.name} ({category})" for category, synset in wanted.items())
        raise AssetSourceError(f"{folder} has none of the synset folders {names}; it has {describe_folder(folder)}.")
    return folder, {
        category: [_find_mesh(p) for p in sorted(synset.iterdir()) if p.is_dir()] if synset.is_dir() else []
        for category, synset in wanted.items()
    }


def _find_mesh(model: Path) -> Path:
    """The mesh of a model; a path that does not exist where it has none, so that it is counted as missing."""
    return next((model / name for name in _MESHES if (model / name).is_file()), model / _MESHES[-1])
