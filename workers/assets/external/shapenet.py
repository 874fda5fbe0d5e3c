"""Edge: a user's own copy of ShapeNetCore, version 1 or 2 (dataset.md section 1, "ShapeNet")."""

from collections.abc import Collection
from pathlib import Path

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import Assets, MeshLimits, ShapeNetSource
from schemas.scene.shape import Asset
from workers.assets.categories import TABLE
from workers.assets.external.listing import Entry, Listing, describe_folder, hash_files, list_entries
from workers.assets.external.mesh import load_shape
from workers.assets.external.placement import UP_AXES, Placement, place_asset
from workers.assets.external.reading import list_mesh_files

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


def list_shapenet(
    settings: ShapeNetSource, job_folder: Path, categories: Collection[str], limits: MeshLimits
) -> Listing:
    """Every model of the categories that ShapeNetCore has; AssetSourceError where the folder is not ShapeNetCore's.

    Reads and hashes the meshes and textures of these categories: about two seconds for each gigabyte, where disks allow.
    """
    folder = (job_folder / Path(settings.folder).expanduser()).resolve()
    if not folder.is_dir():
        raise AssetSourceError(
            f"{folder} is not a folder. Set `folder` of the shapenet source to your copy of ShapeNetCore: the folder "
            "that holds synset folders such as 03797390."
        )
    wanted = {category: folder / SYNSETS[category] for category in sorted(categories) if category in SYNSETS}
    if wanted and not any(synset.is_dir() for synset in wanted.values()):
        names = ", ".join(f"{synset.name} ({category})" for category, synset in wanted.items())
        raise AssetSourceError(f"{folder} has none of the synset folders {names}; it has {describe_folder(folder)}.")
    models = {
        category: sorted(path for path in synset.iterdir() if path.is_dir()) if synset.is_dir() else []
        for category, synset in wanted.items()
    }
    return list_entries(folder, models, lambda model: _make_entry(settings, folder, model, limits))


def _make_entry(settings: ShapeNetSource, folder: Path, model: Path, limits: MeshLimits) -> Entry:
    mesh = next((model / name for name in _MESHES if (model / name).is_file()), None)
    if mesh is None:
        raise MeshError("missing", f"{model} has neither {_MESHES[0]} nor {_MESHES[1]}")
    files = hash_files(list_mesh_files(mesh, model, limits), folder)
    return Entry(f"{model.parent.name}-{model.name}", files, settings.licence)


def load_shapenet(settings: ShapeNetSource, folder: Path, entry: Entry, category: str, assets: Assets) -> Asset:
    """One model, cleaned, z up, scaled; MeshError where its mesh is refused."""
    mesh = folder / entry.files[0].path
    model = mesh.parent.parent if mesh.parent.name == "models" else mesh.parent
    placement = Placement(UP_AXES["y"], settings.scale or (TABLE_SCALE if category == TABLE else OBJECT_SCALE))
    return place_asset(load_shape(mesh, assets.limits, root=model), placement, entry, category, settings, assets)
