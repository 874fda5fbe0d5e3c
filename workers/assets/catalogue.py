"""The catalogue: every asset that a job can choose from."""

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits, ProceduralSource, ShapeNetSource, SplitShares
from schemas.scene.shape import Asset
from workers.assets.builtin.make import TABLE, VERSION, instance_id, make_asset
from workers.assets.external.folder import find_files
from workers.assets.external.listing import Listing, read_listing
from workers.assets.external.placement import load_entry
from workers.assets.external.shapenet import find_models

PROBES = 3
"""Meshes of a source and category that are loaded to test it when a catalogue is opened; one must be usable."""

AnySource = ProceduralSource | ShapeNetSource | FolderSource


@dataclass(frozen=True)
class InstanceRef:
    """One instance of a catalogue: number of its source among objects or tables, and its number within it."""

    source: int
    category: str
    index: int
    instance_id: str


@dataclass(frozen=True)
class Catalogue:
    """Every asset that a job can choose from. It pickles small; choosing needs no files, loading does.

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
        offers: list[tuple[int, AnySource, int]] = []
        for number, (settings, listing) in enumerate(self._sources(category)):
            if isinstance(settings, ProceduralSource):
                offers.append((number, settings, settings.instances))
            elif listing is not None and (entries := listing.entries.get(category)):
                offers.append((number, settings, len(entries)))
        return offers

    def settings(self, ref: InstanceRef) -> AnySource:
        """The settings of the source of an instance."""
        return self._sources(ref.category)[ref.source][0]

    def refer(self, number: int, category: str, index: int) -> InstanceRef:
        """Instance `index` of a category in a source, by its number among those of objects or of tables."""
        settings, listing = self._sources(category)[number]
        if isinstance(settings, ProceduralSource):
            return InstanceRef(number, category, index, instance_id(category, settings.seed, index))
        assert listing is not None
        return InstanceRef(number, category, index, listing.entries[category][index].instance_id)

    def load(self, ref: InstanceRef) -> Asset:
        """An instance, made or read; MeshError where its mesh is refused or has changed."""
        settings, listing = self._sources(ref.category)[ref.source]
        if isinstance(settings, ProceduralSource):
            return make_asset(ref.category, settings, ref.index, self.assets.density_kg_m3)
        assert listing is not None
        return load_entry(settings, listing.folder, listing.entries[ref.category][ref.index], ref.category, self.assets)

    def _sources(self, category: str) -> list[tuple[AnySource, Listing | None]]:
        if category == TABLE:
            return list(zip(self.assets.tables, self.tables, strict=True))
        return list(zip(self.assets.objects, self.objects, strict=True))


def list_source(
    settings: AnySource, job_folder: Path, categories: Collection[str], limits: MeshLimits
) -> Listing | None:
    """What a source of files offers, None for built-in shapes; AssetSourceError where the folder cannot be used."""
    if isinstance(settings, ProceduralSource):
        return None
    if isinstance(settings, ShapeNetSource):
        return read_listing(settings, *find_models(settings, job_folder, categories), limits)
    return read_listing(settings, *find_files(settings, job_folder, categories), limits)


def open_catalogue(assets: Assets, job_folder: Path, categories: Collection[str]) -> Catalogue:
    """Lists every source; raises AssetSourceError where a folder cannot be used or no source has a category.

    Cost: every mesh and texture of the categories asked for is read to hash it, about two seconds a gigabyte where
    disks allow; nothing for procedural sources. Workers take the opened catalogue and read only what they load.
    """
    objects = tuple(list_source(source, job_folder, categories, assets.limits) for source in assets.objects)
    tables = tuple(list_source(source, job_folder, (TABLE,), assets.limits) for source in assets.tables)
    _refuse_ambiguous(assets)
    skipped = {str(x.folder): dict(x.skipped) for x in (*objects, *tables) if x is not None and x.skipped}
    digest = _digest(assets, objects, tables, categories)
    catalogue = Catalogue(assets, objects, tables, digest, skipped)
    for category in (*sorted(categories), TABLE):
        _check_offered(catalogue, category)
    return catalogue


def _refuse_ambiguous(assets: Assets) -> None:
    """AssetSourceError for two procedural sources of one seed and different sizes: they would give one id to two shapes."""
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
        try:
            catalogue.load(catalogue.refer(number, category, index))
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
        # The folder's path is left out: the same files elsewhere are the same catalogue.
        plain = settings.model_dump(mode="json", exclude={"folder"})
        files = None
        if listing is not None:
            files = {
                category: [(e.instance_id, e.licence, [(f.path, f.size, f.sha256) for f in e.files]) for e in entries]
                for category, entries in listing.entries.items()
            }
        record.append({"settings": plain, "generator": VERSION if listing is None else None, "files": files})
    scalars = assets.model_dump(mode="json", exclude={"objects", "tables"})
    whole = {"sources": record, "objects": len(objects), "categories": sorted(categories), "assets": scalars}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def split_of(instance: str, shares: SplitShares) -> str:
    """`train`, `val` or `test` by the hash of the instance's id: all scenes of an instance fall into one split."""
    place = int.from_bytes(hashlib.sha256(instance.encode()).digest()[:8], "big") / 2.0**64
    return "train" if place < shares.train else "val" if place < shares.train + shares.val else "test"
