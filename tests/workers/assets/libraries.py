"""Libraries of a few meshes, as `verso init` makes them, for tests that need some from outside."""

from pathlib import Path

from schemas.job.assets import Assets, LibrarySource, MeshLimits
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.assets.library.making import Making, make_library


def library_of(folder: Path, category: str = "mug", **making) -> dict[str, str]:
    """The source of a library of all meshes of a folder, which are in metres with z up, unless `making` says otherwise."""
    out = folder.parent / f"{folder.name}_library"
    how = {"units": (("*", 1.0),), "up": "z", "licence": "MIT", **making}
    make_library(folder, out, Making(category, **how))
    return {"source": "library", "folder": str(out)}


def open_folder(folder: Path, category: str = "mug", limits: MeshLimits | None = None, **making) -> Catalogue:
    """The catalogue of such a library."""
    source = LibrarySource.model_validate(library_of(folder, category, limits=limits or MeshLimits(), **making))
    return open_catalogue(Assets(objects=(source,)), folder, () if category == "table" else (category,))
