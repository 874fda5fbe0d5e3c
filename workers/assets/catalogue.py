"""The catalogue: every asset that a job can choose from; and the choice of a scene's objects and table, loaded through a cache.

What makes or reads a shape is imported where it is called: it loads trimesh, scipy and numba, which take longer than the rest of
a command's start, and a coordinator of built-in shapes needs none of it.
"""

import hashlib
import json
import sys
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from cachetools import LRUCache

from schemas.capture import CaptureListing
from schemas.errors import AssetSourceError
from schemas.job.assets import (
    BUILT_IN,
    TABLE,
    VERSION,
    Assets,
    FolderSource,
    MeshLimits,
    ProceduralSource,
    ShapeNetSource,
    SplitShares,
    instance_id,
)
from schemas.job.identity import differing_keys
from schemas.scene.shape import Asset
from workers.assets.external.listing import Listing, Watch, find_files, find_models, ignore
from workers.geometry.frames import add_up

if TYPE_CHECKING:
    from workers.assets.external.verdicts import Verdicts


AnySource = ProceduralSource | ShapeNetSource | FolderSource


DOUBTS = 3
"""Files of a folder that a line of `Catalogue.describe_doubts` names."""


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
    by source folder and reason; digest: SHA-256 of everything that the choice and the shapes depend on. Files that cannot
    be read are known from the start and never drawn.
    """

    assets: Assets
    objects: "tuple[Listing | None, ...]"
    tables: "tuple[Listing | None, ...]"
    digest: str
    skipped: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    captures: tuple[CaptureListing, ...] = ()
    """Folders of captures, in order; the digest covers their files too."""

    def offers(self, category: str) -> list[tuple[int, AnySource, int]]:
        """Number, settings and count of instances of every source that has this category."""
        offers: list[tuple[int, AnySource, int]] = []
        for number, (settings, listing) in enumerate(self._sources(category)):
            if isinstance(settings, ProceduralSource):
                if category in BUILT_IN:
                    offers.append((number, settings, settings.instances))
            elif listing is not None and (count := listing.count(category)):
                offers.append((number, settings, count))
        return offers

    def draw(self, number: int, category: str, rng: np.random.Generator) -> InstanceRef:
        """One of a source's instances of a category, uniformly. A refused one is drawn again: the others stay as they are."""
        settings, listing = self._sources(category)[number]
        if isinstance(settings, ProceduralSource):
            return self.refer(number, category, int(rng.integers(settings.instances)))
        assert listing is not None
        refused, count = listing.refused.get(category, frozenset()), len(listing.entries[category])
        index = int(rng.integers(count))
        while index in refused:
            index = int(rng.integers(count))
        return self.refer(number, category, index)

    def settings(self, ref: InstanceRef) -> AnySource:
        """The settings of the source of an instance."""
        return self._sources(ref.category)[ref.source][0]

    def refer(self, number: int, category: str, index: int) -> InstanceRef:
        """Instance `index` of a category in a source, by its number among those of objects or of tables."""
        settings, listing = self._sources(category)[number]
        if isinstance(settings, ProceduralSource):
            name = instance_id(settings.named(category), settings.seed, index)
            return InstanceRef(number, category, index, name)
        assert listing is not None
        return InstanceRef(number, category, index, listing.entries[category][index].instance_id)

    def examples(self, folder: str) -> tuple[str, ...]:
        """Sentences on the first files that were left out of a source's folder."""
        listings = (listing for listing in (*self.objects, *self.tables) if listing is not None)
        return next((x.examples for x in listings if x.examples and str(x.folder) == folder), ())

    def describe_left_out(self) -> list[str]:
        """One line for each folder with files that were left out: how many, and why, with the first of them."""
        return [
            f"left out of {folder}: {', '.join(f'{count} {reason}' for reason, count in reasons.items())}"
            + (f"; {'; '.join(examples)}" if (examples := self.examples(folder)) else "")
            for folder, reasons in self.skipped.items()
        ]

    def describe_doubts(self) -> list[str]:
        """One line for each folder with files that stand on another axis than `up` says."""
        lines = []
        for listing in (*self.objects, *self.tables):
            if listing is None or not listing.doubts:
                continue
            doubts = sorted(listing.doubts.items())
            told = ", ".join(f"{path} on {axis}" for path, axis in doubts[:DOUBTS])
            more = f" and {len(doubts) - DOUBTS} more" if len(doubts) > DOUBTS else ""
            first = f"{{{json.dumps(doubts[0][0], ensure_ascii=False)}: {doubts[0][1]}}}"
            remedy = (
                f"if they lie on their side, set `up` of the source, such as {first}; `verso init` shows how they stand"
            )
            lines.append(f"{listing.folder}: files stand on another axis than `up` says: {told}{more}; {remedy}")
        return lines

    def load(self, ref: InstanceRef) -> Asset:
        """An instance, made, or read in a limited process; MeshError where its mesh is refused or has changed."""
        settings, listing = self._sources(ref.category)[ref.source]
        if isinstance(settings, ProceduralSource):
            from workers.assets.builtin.make import make_asset

            return make_asset(ref.category, settings, ref.index, self.assets.density_kg_m3)
        from workers.assets.external.verdicts import load_asset_file

        assert listing is not None
        entry = listing.entries[ref.category][ref.index]
        return load_asset_file(settings, listing.folder, entry, ref.category, self.assets)

    def _sources(self, category: str) -> "list[tuple[AnySource, Listing | None]]":
        if category == TABLE:
            return list(zip(self.assets.tables, self.tables, strict=True))
        return list(zip(self.assets.objects, self.objects, strict=True))


def list_source(
    settings: AnySource, job_folder: Path, categories: Collection[str], limits: MeshLimits, watch: Watch = ignore
) -> "Listing | None":
    """What a source of files offers, None for built-in shapes; AssetSourceError where the folder cannot be used."""
    if isinstance(settings, ProceduralSource):
        return None
    from workers.assets.external.verdicts import read_listing

    if isinstance(settings, ShapeNetSource):
        return read_listing(settings, *find_models(settings, job_folder, categories), limits, watch)
    return read_listing(settings, *find_files(settings, job_folder, categories), limits, watch)


def open_catalogue(
    assets: Assets, job_folder: Path, categories: Collection[str], watch: Watch = ignore, kept: "Verdicts | None" = None
) -> Catalogue:
    """Lists every source and finds out which files can be read, or looks that up in `kept` (default: the user's cache).

    `watch` is told now and then how far it is. Raises AssetSourceError where a folder cannot be used, no source has a
    category, or a source has nothing of it that can be read.

    Cost: every mesh and texture of the categories asked for is read to hash it, about two seconds a gigabyte where disks
    allow, and once for ever to see whether it can be used; nothing for procedural sources. Workers take the opened
    catalogue and read only what they load.
    """

    def open_source(settings: AnySource, wanted: Collection[str]) -> "Listing | None":
        listing = list_source(settings, job_folder, wanted, assets.limits, watch)
        if isinstance(settings, ProceduralSource) or listing is None:
            return None
        from workers.assets.external.verdicts import check_listing

        assert kept is not None
        return check_listing(settings, listing, assets, kept, watch)

    if kept is None and any(not isinstance(source, ProceduralSource) for source in (*assets.objects, *assets.tables)):
        from workers.assets.external.verdicts import USUAL_FOLDER, Verdicts

        kept = Verdicts(USUAL_FOLDER)
    objects = tuple(open_source(source, categories) for source in assets.objects)
    tables = tuple(open_source(source, (TABLE,)) for source in assets.tables)
    _refuse_ambiguous(assets)
    skipped: dict[str, Counter[str]] = {}
    for listing in (*objects, *tables):
        if listing is not None and listing.skipped:
            skipped.setdefault(str(listing.folder), Counter()).update(listing.skipped)
    digest = _digest(assets, objects, tables, categories)
    catalogue = Catalogue(
        assets, objects, tables, digest, {folder: dict(reasons) for folder, reasons in skipped.items()}
    )
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
    for listing in catalogue.tables if category == TABLE else catalogue.objects:
        if listing is not None and listing.entries.get(category) and not listing.count(category):
            most = f"none of {len(listing.entries[category])} meshes for {category!r} in {listing.folder} can be used"
            raise AssetSourceError(f"{most}: {'; '.join(listing.examples)}")
    where = "assets.tables" if category == TABLE else "assets.objects"
    if not offers:
        listings = catalogue.tables if category == TABLE else catalogue.objects
        seen = [_describe(listing) for listing in listings if listing is not None]
        foreign = category in BUILT_IN and BUILT_IN[category].synset is None
        hint = f" ShapeNetCore has no {category}." if foreign else ""
        raise AssetSourceError(
            f"no source in {where} offers {category!r}: {'; '.join(seen)}.{hint} Add `- source: procedural` there, "
            + (f"or leave {category!r} out of `categories`." if category != TABLE else "or a folder that has tables.")
        )


def _describe(listing: "Listing") -> str:
    found = (
        ", ".join(f"{len(entries)} {category}" for category, entries in listing.entries.items()) or "nothing asked for"
    )
    left = ", ".join(f"{count} {reason}" for reason, count in listing.skipped.items())
    return f"{listing.folder} has {found}" + (f" (skipped: {left})" if left else "")


def _digest(
    assets: Assets,
    objects: "tuple[Listing | None, ...]",
    tables: "tuple[Listing | None, ...]",
    categories: Collection[str],
) -> str:
    """SHA-256 over the settings of every source and, for files, what was found: paths, sizes and digests."""
    record = []
    for settings, listing in zip((*assets.objects, *assets.tables), (*objects, *tables), strict=True):
        # The folder's path is left out: the same files elsewhere are the same catalogue.
        plain = differing_keys(settings, {"folder"})
        files: dict[str, Any] | None = None
        if listing is not None:
            files = {
                category: [(e.instance_id, e.licence, [(f.path, f.size, f.sha256) for f in e.files]) for e in entries]
                for category, entries in listing.entries.items()
            }
            if any(listing.refused.values()):
                files["refused"] = {category: sorted(numbers) for category, numbers in listing.refused.items()}
        record.append({"settings": plain, "generator": VERSION if listing is None else None, "files": files})
    scalars = differing_keys(assets, {"objects", "tables"})
    whole = {"sources": record, "objects": len(objects), "categories": sorted(categories), "assets": scalars}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def split_of(instance: str, shares: SplitShares) -> str:
    """`train`, `val` or `test` by the hash of the instance's id: all scenes of an instance fall into one split."""
    place = int.from_bytes(hashlib.sha256(instance.encode()).digest()[:8], "big") / 2.0**64
    return "train" if place < shares.train else "val" if place < shares.train + shares.val else "test"


MAX_CACHED_INSTANCES = 10_000
"""Sources with more built-in instances are not cached: instances hardly ever repeat."""
CACHE_BYTES = 256 * 1024 * 1024
"""Memory that the cached assets of a process may take."""


def choose_object(catalogue: Catalogue, category: str, rng: np.random.Generator) -> InstanceRef:
    """An instance of the category: a source by weight among those that have it, then one that is fit uniformly."""
    offers = catalogue.offers(category)
    if not offers:
        raise AssetSourceError(f"no source offers {category!r}")
    share = rng.random() * add_up(settings.weight for _, settings, _ in offers)
    chosen = offers[-1]
    for offer in offers:
        share -= offer[1].weight
        if share < 0.0:
            chosen = offer
            break
    return catalogue.draw(chosen[0], category, rng)


def choose_table(catalogue: Catalogue, rng: np.random.Generator) -> InstanceRef:
    """A table, chosen as objects are."""
    return choose_object(catalogue, TABLE, rng)


def load_asset(catalogue: Catalogue, ref: InstanceRef) -> Asset:
    """The asset, from this process's cache if it is there; MeshError where its mesh is refused."""
    key = (catalogue.digest, ref)
    if key in _cache:
        return _cache[key]
    asset, settings = catalogue.load(ref), catalogue.settings(ref)
    if not (isinstance(settings, ProceduralSource) and settings.instances > MAX_CACHED_INSTANCES):
        _cache[key] = asset
    return asset


def asset_bytes(asset: Asset) -> int:
    """Memory that an asset takes: its arrays, and about as much again for its hull, its joined mesh and its file."""
    total = sys.getsizeof(asset)
    for part in asset.shape.parts:
        arrays = (part.vertices, part.faces, part.normals, part.uv, part.colors, part.material.texture)
        total += 2 * sum(array.nbytes for array in arrays if array is not None)
    return total


def open_cache(capacity_bytes: int) -> LRUCache[tuple[str, InstanceRef], Asset]:
    """An LRU cache of assets. An asset larger than the capacity counts as the capacity, so that one is always kept."""
    return LRUCache(capacity_bytes, getsizeof=lambda asset: min(asset_bytes(asset), capacity_bytes))


_cache = open_cache(CACHE_BYTES)
