"""Which assets a job can choose from, and the one place that loads them."""

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import Assets, FolderSource, ProceduralSource, ShapeNetSource, SplitShares
from schemas.scene.shape import Asset
from workers.assets.builtin.make import VERSION, instance_id, make_asset
from workers.assets.cache import AssetCache
from workers.assets.external.folder import list_folder, load_folder_entry, locate_folder
from workers.assets.external.shapenet import list_shapenet, load_shapenet
from workers.assets.sources import TABLE, Entry, Listing, Weights

AnySource = ProceduralSource | ShapeNetSource | FolderSource

SELDOM_AGAIN = 10_000
"""Of more instances than this hardly one comes again: keeping them fills a worker's memory and saves nothing."""
CACHE_BYTES = 256 * 1024 * 1024
"""How much memory the assets that a process keeps at hand may take."""
PROBES = 3
"""Meshes of a source and category that are tried when a catalogue is opened; if none can be read, it cannot be used."""


@dataclass(frozen=True)
class InstanceRef:
    """One instance of a catalogue: number of its source among objects or tables, and its number within it."""

    source: int
    category: str
    index: int
    instance_id: str


@dataclass(frozen=True)
class Catalogue:
    """What a job can choose from. It pickles small and needs no files to choose, only to load.

    objects, tables: a listing for each source, None for a procedural one; skipped: how many instances were left out,
    by source folder and reason; digest: SHA-256 of everything that the choice and the shapes depend on.
    """

    assets: Assets
    objects: tuple[Listing | None, ...]
    tables: tuple[Listing | None, ...]
    digest: str
    skipped: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    def offers(self, category: str) -> list[tuple[int, AnySource, int]]:
        """Number, settings and count of instances of every source that has this category."""
        sources, listings = (
            (self.assets.tables, self.tables) if category == TABLE else (self.assets.objects, self.objects)
        )
        counted = [
            (number, settings, _count(settings, listing, category))
            for number, (settings, listing) in enumerate(zip(sources, listings, strict=True))
        ]
        return [offer for offer in counted if offer[2]]


def _count(settings: AnySource, listing: Listing | None, category: str) -> int:
    if isinstance(settings, ProceduralSource):
        return settings.instances
    return len(listing.entries.get(category, ())) if listing is not None else 0


def open_catalogue(assets: Assets, job_folder: Path, categories: Collection[str]) -> Catalogue:
    """Looks into every source now; raises AssetSourceError where a folder or a category cannot be served.

    Cost: every mesh and texture of the categories asked for is read to hash it, about two seconds a gigabyte where
    disks allow; nothing for procedural sources. Workers take the opened catalogue and read only what they load.
    """
    listed: dict[str, Listing | None] = {}
    objects = tuple(_listing(source, job_folder, categories, assets, listed) for source in assets.objects)
    tables = tuple(_listing(source, job_folder, (TABLE,), assets, listed) for source in assets.tables)
    _refuse_ambiguous(assets)
    skipped = {str(x.folder): dict(x.skipped) for x in (*objects, *tables) if x is not None and x.skipped}
    digest = _digest(assets, objects, tables, categories)
    catalogue = Catalogue(assets, objects, tables, digest, skipped)
    for category in (*sorted(categories), TABLE):
        _check_offered(catalogue, category)
    return catalogue


def _listing(
    settings: AnySource,
    job_folder: Path,
    categories: Collection[str],
    assets: Assets,
    listed: dict[str, Listing | None],
) -> Listing | None:
    """The listing of one source; the same source twice is read once."""
    key = f"{settings.model_dump_json()} {sorted(categories)}"
    if key not in listed:
        if isinstance(settings, ProceduralSource):
            listed[key] = None
        elif isinstance(settings, ShapeNetSource):
            folder = (job_folder / Path(settings.folder).expanduser()).resolve()
            listed[key] = list_shapenet(settings, folder, categories, assets.limits)
        else:
            folder = locate_folder(settings.folder, job_folder)
            listed[key] = list_folder(settings, folder, categories, assets.limits)
    return listed[key]


def _refuse_ambiguous(assets: Assets) -> None:
    """Two procedural sources of one seed and different sizes would give one id to two shapes."""
    sizes: dict[int, tuple[str, float]] = {}
    for source in assets.objects:
        if isinstance(source, ProceduralSource):
            size = (source.size, source.diagonal_m)
            if sizes.setdefault(source.seed, size) != size:
                raise AssetSourceError(
                    f"two procedural sources have the seed {source.seed} and different sizes: give one another seed."
                )


def _check_offered(catalogue: Catalogue, category: str) -> None:
    offers = catalogue.offers(category)
    where = "assets.tables" if category == TABLE else "assets.objects"
    if not offers:
        listings = catalogue.tables if category == TABLE else catalogue.objects
        seen = [_describe(listing) for listing in listings if listing is not None]
        hint = " ShapeNetCore has no box." if category == "box" else ""
        raise AssetSourceError(
            f"no source in {where} offers {category!r}: {'; '.join(seen)}.{hint} Add `- source: procedural` there, "
            + (f"or leave {category!r} out of `categories`." if category != TABLE else "or a folder that has tables.")
        )
    for number, settings, count in offers:
        if not isinstance(settings, ProceduralSource):
            _probe(catalogue, number, category, count)


def _describe(listing: Listing) -> str:
    found = (
        ", ".join(f"{len(entries)} {category}" for category, entries in listing.entries.items()) or "nothing asked for"
    )
    left = ", ".join(f"{count} {reason}" for reason, count in listing.skipped.items())
    return f"{listing.folder} has {found}" + (f" (skipped: {left})" if left else "")


def _probe(catalogue: Catalogue, number: int, category: str, count: int) -> None:
    """AssetSourceError where the first few meshes of a source are all refused."""
    errors = []
    for index in range(min(PROBES, count)):
        ref = _ref(catalogue, number, category, index)
        try:
            load_asset(catalogue, ref)
            return
        except MeshError as error:
            errors.append(str(error))
    raise AssetSourceError(f"none of the first {len(errors)} meshes for {category!r} can be used: {'; '.join(errors)}")


def _digest(
    assets: Assets, objects: tuple[Listing | None, ...], tables: tuple[Listing | None, ...], categories: Collection[str]
) -> str:
    """SHA-256 over the settings of every source and, for files, what was found: paths, sizes and digests."""
    record = []
    for settings, listing in zip((*assets.objects, *assets.tables), (*objects, *tables), strict=True):
        # Where a folder lies is not what is in it: the same files elsewhere are the same catalogue.
        plain = settings.model_dump(mode="json", exclude={"folder"})
        files = None
        if listing is not None:
            files = {
                category: [(e.instance_id, e.licence, [(f.path, f.size, f.sha256) for f in e.files]) for e in entries]
                for category, entries in listing.entries.items()
            }
        record.append({"settings": plain, "generator": VERSION if listing is None else None, "files": files})
    whole = {"sources": record, "objects": len(objects), "categories": sorted(categories), "assets": _scalars(assets)}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def _scalars(assets: Assets) -> dict[str, object]:
    return assets.model_dump(mode="json", exclude={"objects", "tables"})


def choose_object(catalogue: Catalogue, category: str, rng: np.random.Generator) -> InstanceRef:
    """An instance of the category: a source by weight among those that have it, then any of its instances alike."""
    offers = catalogue.offers(category)
    if not offers:
        raise AssetSourceError(f"no source offers {category!r}")
    share = float(rng.random()) * sum(settings.weight for _, settings, _ in offers)
    chosen = offers[-1]
    for offer in offers:
        share -= offer[1].weight
        if share < 0.0:
            chosen = offer
            break
    return _ref(catalogue, chosen[0], category, int(rng.integers(chosen[2])))


def choose_table(catalogue: Catalogue, rng: np.random.Generator) -> InstanceRef:
    """A table, chosen as objects are."""
    return choose_object(catalogue, TABLE, rng)


def _ref(catalogue: Catalogue, number: int, category: str, index: int) -> InstanceRef:
    settings, listing = _source(catalogue, number, category)
    if isinstance(settings, ProceduralSource):
        return InstanceRef(number, category, index, instance_id(category, settings.seed, index))
    assert listing is not None
    return InstanceRef(number, category, index, listing.entries[category][index].instance_id)


def _source(catalogue: Catalogue, number: int, category: str) -> tuple[AnySource, Listing | None]:
    if category == TABLE:
        return catalogue.assets.tables[number], catalogue.tables[number]
    return catalogue.assets.objects[number], catalogue.objects[number]


def load_asset(catalogue: Catalogue, ref: InstanceRef) -> Asset:
    """The asset, from this process's cache if it is there; MeshError where its mesh is refused."""
    settings, _ = _source(catalogue, ref.source, ref.category)
    if isinstance(settings, ProceduralSource) and settings.instances > SELDOM_AGAIN:
        return _load(catalogue, ref)
    return _cache.get((catalogue.digest, ref), lambda: _load(catalogue, ref))


_cache = AssetCache(CACHE_BYTES)


def _load(catalogue: Catalogue, ref: InstanceRef) -> Asset:
    settings, listing = _source(catalogue, ref.source, ref.category)
    assets = catalogue.assets
    if isinstance(settings, ProceduralSource):
        return make_asset(ref.category, settings, ref.index, assets.density_kg_m3)
    assert listing is not None
    entry: Entry = listing.entries[ref.category][ref.index]
    weights = Weights(assets.density_kg_m3, assets.shell_kg_m2)
    if isinstance(settings, ShapeNetSource):
        return load_shapenet(settings, listing, entry, ref.category, assets.limits, weights)
    return load_folder_entry(settings, listing, entry, ref.category, assets.limits, weights)


def split_of(instance: str, shares: SplitShares) -> str:
    """`train`, `val` or `test` by the hash of the instance's id: all scenes of an instance fall into one split."""
    place = int.from_bytes(hashlib.sha256(instance.encode()).digest()[:8], "big") / 2.0**64
    return "train" if place < shares.train else "val" if place < shares.train + shares.val else "test"
