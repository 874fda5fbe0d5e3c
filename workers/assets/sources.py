"""The three kinds of sources behind one set of functions: built-in shapes, ShapeNetCore, folders of meshes."""

from collections.abc import Collection
from pathlib import Path

from schemas.job.assets import Assets, FolderSource, MeshLimits, ProceduralSource, ShapeNetSource
from schemas.scene.shape import Asset
from workers.assets.builtin.make import instance_id, make_asset
from workers.assets.external.folder import find_files
from workers.assets.external.listing import Listing, read_listing
from workers.assets.external.placement import load_entry
from workers.assets.external.shapenet import find_models

AnySource = ProceduralSource | ShapeNetSource | FolderSource


def list_source(
    settings: AnySource, job_folder: Path, categories: Collection[str], limits: MeshLimits
) -> Listing | None:
    """What a source of files offers, None for built-in shapes; AssetSourceError where the folder cannot be used."""
    if isinstance(settings, ProceduralSource):
        return None
    if isinstance(settings, ShapeNetSource):
        return read_listing(settings, *find_models(settings, job_folder, categories), limits)
    return read_listing(settings, *find_files(settings, job_folder, categories), limits)


def count_instances(settings: AnySource, listing: Listing | None, category: str) -> int:
    """How many instances of a category a source has."""
    if isinstance(settings, ProceduralSource):
        return settings.instances
    return len(listing.entries.get(category, ())) if listing is not None else 0


def name_instance(settings: AnySource, listing: Listing | None, category: str, index: int) -> str:
    """The id of instance `index` of a category."""
    if isinstance(settings, ProceduralSource):
        return instance_id(category, settings.seed, index)
    assert listing is not None
    return listing.entries[category][index].instance_id


def load_instance(settings: AnySource, listing: Listing | None, category: str, index: int, assets: Assets) -> Asset:
    """Instance `index` of a category, made or read; MeshError where its mesh is refused or has changed."""
    if isinstance(settings, ProceduralSource):
        return make_asset(category, settings, index, assets.density_kg_m3)
    assert listing is not None
    return load_entry(settings, listing.folder, listing.entries[category][index], category, assets)
