"""Edge: a user's own copy of ShapeNetCore, version 1 or 2 (dataset.md section 1, "ShapeNet")."""

from collections.abc import Collection
from pathlib import Path

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import MeshLimits, ShapeNetSource
from schemas.scene.shape import Asset
from workers.assets.external.mesh import load_shape
from workers.assets.sources import (
    TABLE,
    UP_AXES,
    Entry,
    Listing,
    Placement,
    SourceShape,
    Weights,
    check_unchanged,
    found_in,
    hashed,
    mesh_files,
    placed_asset,
    tally,
)

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

OBJECT_SCALE, TABLE_SCALE = 0.25, 1.5
"""The article's factors on normalised units."""

_MESHES = ("models/model_normalized.obj", "model.obj")
"""Where the mesh lies in a model's folder: version 2, version 1."""


def list_shapenet(settings: ShapeNetSource, folder: Path, categories: Collection[str], limits: MeshLimits) -> Listing:
    """Every model of the categories that ShapeNetCore has; AssetSourceError where the folder is not ShapeNetCore's.

    Reads and hashes the meshes and textures of these categories: about two seconds for each gigabyte, where disks allow.
    """
    if not folder.is_dir():
        raise AssetSourceError(
            f"{folder} is not a folder. Set `folder` of the shapenet source to your copy of ShapeNetCore: the folder "
            "that holds synset folders such as 03797390."
        )
    wanted = {category: SYNSETS[category] for category in sorted(categories) if category in SYNSETS}
    if wanted and not any((folder / synset).is_dir() for synset in wanted.values()):
        names = ", ".join(f"{synset} ({category})" for category, synset in wanted.items())
        raise AssetSourceError(f"{folder} has none of the synset folders {names}; it has {found_in(folder)}.")
    entries, skipped = {}, []
    for category, synset in wanted.items():
        models = sorted(p for p in (folder / synset).iterdir() if p.is_dir()) if (folder / synset).is_dir() else []
        found = []
        for model in models:
            try:
                found.append(_entry(settings, folder, synset, model, limits))
            except MeshError as error:
                skipped.append(error.reason)
        entries[category] = tuple(found)
    return Listing(folder, entries, tally(skipped))


def _entry(settings: ShapeNetSource, folder: Path, synset: str, model: Path, limits: MeshLimits) -> Entry:
    mesh = next((model / name for name in _MESHES if (model / name).is_file()), None)
    if mesh is None:
        raise MeshError("missing", f"{model} has neither {_MESHES[0]} nor {_MESHES[1]}")
    files = hashed(mesh_files(mesh, model, limits), folder)
    return Entry(f"{synset}-{model.name}", files, settings.licence)


def load_shapenet(
    settings: ShapeNetSource, listing: Listing, entry: Entry, category: str, limits: MeshLimits, weights: Weights
) -> Asset:
    """One model, cleaned, z up, scaled; MeshError where its mesh is refused or has changed."""
    check_unchanged(listing.folder, entry)
    mesh = listing.folder / entry.files[0].path
    model = mesh.parent.parent if mesh.parent.name == "models" else mesh.parent
    loaded = load_shape(mesh, limits, root=model)
    scale = settings.scale or (TABLE_SCALE if category == TABLE else OBJECT_SCALE)
    return placed_asset(
        SourceShape(loaded.shape, loaded.notes),
        Placement(UP_AXES["y"], scale),
        entry=entry,
        category=category,
        source="shapenet",
        shareable=settings.copy_assets,
        weights=weights,
    )
