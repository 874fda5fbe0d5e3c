"""The catalogue: every asset that a job can choose from; and the choice of a scene's objects and table, loaded through a cache.

What makes or reads a shape is imported where it is called: it loads trimesh, scipy and numba, which take longer than the rest of
a command's start, and a coordinator of built-in shapes needs none of it.
"""

import hashlib
import json
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from cachetools import LRUCache

from schemas.capture import CaptureListing
from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import (
    BUILT_IN,
    CATEGORIES,
    MOST_TOLD,
    TABLE,
    VERSION,
    Assets,
    LibrarySource,
    ProceduralSource,
    instance_id,
)
from schemas.job.job import differing_keys
from schemas.job.look import Recolour
from schemas.scene.shape import Asset, MapSource
from workers.assets.poses import PoseFile
from workers.geometry.frames import add_up

if TYPE_CHECKING:
    from workers.assets.library.table import Library
    from workers.assets.look.pictures import Pictures

AnySource = ProceduralSource | LibrarySource

Watch = Callable[[str, int, int], None]
"""Is told what is being done, and with how many of how many files."""


def ignore(what: str, done: int, asked: int) -> None:
    """A watch that says nothing."""


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
    """Every asset that a job can choose from. It pickles small.

    objects, tables: a library for each source, None for a procedural one; digest: SHA-256 of everything that the choice and
    the shapes depend on. A shape that cannot be made is known where it is first drawn, and another is drawn in its place.
    """

    assets: Assets
    objects: "tuple[Library | None, ...]"
    tables: "tuple[Library | None, ...]"
    digest: str
    captures: tuple[CaptureListing, ...] = ()
    """Folders of captures, in order; the digest covers their files too."""
    poses: Mapping[str, PoseFile] = field(default_factory=dict)
    """Tables of camera poses by the name of their camera; the digest covers them too."""
    scenes: PoseFile | None = None
    """The table of scenes that the job names; the digest covers it too."""
    maps: tuple[MapSource, ...] = ()
    """Maps of light of the folder that `look.environment` names; the digest covers them too."""
    recolour: Recolour = "as_made"
    """Colours of built-in objects; the digest covers them too."""
    pictures: "Pictures" = field(default_factory=dict)
    """Those of the folders of `look`; the digest covers them too."""

    def offers(self, category: str) -> list[tuple[int, AnySource, int]]:
        """Number, settings and count of instances of every source that has this category."""
        offers: list[tuple[int, AnySource, int]] = []
        for number, (settings, library) in enumerate(self._sources(category)):
            if isinstance(settings, ProceduralSource):
                if category in BUILT_IN:
                    offers.append((number, settings, settings.instances))
            elif library is not None and (count := library.count(category)):
                offers.append((number, settings, count))
        return offers

    def draw(self, number: int, category: str, rng: np.random.Generator) -> InstanceRef:
        """One of a source's instances of a category, uniformly. A refused one is drawn again: the others stay as they are.

        Raises MeshError where all are refused.
        """
        settings, library = self._sources(category)[number]
        if isinstance(settings, ProceduralSource):
            return self.refer(number, category, int(rng.integers(settings.instances)))
        from workers.assets.library.shapes import is_fit

        assert library is not None
        rows, unfit = library.entries[category], set[int]()
        while len(unfit) < len(rows):
            index = int(rng.integers(len(rows)))
            if index not in unfit and is_fit(library, rows[index]):
                return self.refer(number, category, index)
            unfit.add(index)
        raise MeshError("no_shape", f"none of {len(rows)} shapes for {category!r} in {library.source} can be made")

    def settings(self, ref: InstanceRef) -> AnySource:
        """The settings of the source of an instance."""
        return self._sources(ref.category)[ref.source][0]

    def refer(self, number: int, category: str, index: int) -> InstanceRef:
        """Instance `index` of a category in a source, by its number among those of objects or of tables."""
        settings, library = self._sources(category)[number]
        if isinstance(settings, ProceduralSource):
            name = instance_id(settings.named(category), settings.seed, index)
            return InstanceRef(number, category, index, name)
        assert library is not None
        name = library.entries[category][index].instance_id
        if settings.diagonal_m is not None and category != TABLE:
            name += f"-{1000 * settings.diagonal_m:g}mm".replace(".", "_")
        return InstanceRef(number, category, index, name)

    def find(self, name: str, tables: bool = False) -> InstanceRef | None:
        """The instance of an object, or of a table, by its id; None where no source has it."""
        stem, _, index = name.rpartition("-")
        for number, (settings, library) in enumerate(self._sources(TABLE if tables else "")):
            if library is not None:  # whose names may end in a size
                places = [library.places[each] for each in (name, stem) if each in library.places]
            else:
                assert isinstance(settings, ProceduralSource)
                known = index.isdecimal() and int(index) < settings.instances
                places = [(category, int(index)) for category in ((TABLE,) if tables else CATEGORIES) if known]
            for category, place in places:
                if (category == TABLE) is tables and (ref := self.refer(number, category, place)).instance_id == name:
                    return ref
        return None

    def libraries(self) -> "list[Library]":
        """Those of all sources, each once."""
        opened = [library for library in (*self.objects, *self.tables) if library is not None]
        return list({library.source: library for library in opened}.values())

    def describe_left_out(self) -> list[str]:
        """One line for each folder with files that were left out: how many, and why, with the first of them."""
        return [
            f"left out of {library.source}: {', '.join(f'{count} {reason}' for reason, count in library.skipped.items())}; "
            f"{'; '.join(library.examples)}"
            for library in self.libraries()
            if library.skipped
        ]

    def describe_plain(self) -> list[str]:
        """One line for each folder with shapes that no file gives a picture or a colour."""
        return [f"{library.source}: {message}" for library in self.libraries() for message in library.plain]

    def describe_doubts(self) -> list[str]:
        """Lines on each folder with files that stand on another axis than was decided, or that have no colour."""
        lines = self.describe_plain()
        for library in self.libraries():
            if not library.doubts:
                continue
            doubts = sorted(library.doubts.items())
            message = ", ".join(f"{path} on {axis}" for path, axis in doubts[:DOUBTS])
            more = f" and {len(doubts) - DOUBTS} more" if len(doubts) > DOUBTS else ""
            remedy = "if they lie on their side, `verso init` it and change `up` in its table"
            lines.append(f"{library.source}: files stand on another axis than `up` says: {message}{more}; {remedy}")
        return lines

    def load(self, ref: InstanceRef) -> Asset:
        """An instance, made, or read from its library; MeshError where its mesh is refused or has changed."""
        settings, library = self._sources(ref.category)[ref.source]
        if isinstance(settings, ProceduralSource):
            from workers.assets.builtin.make import make_asset
            from workers.assets.look.recolour import recoloured

            asset = make_asset(ref.category, settings, ref.index, self.assets.density_of(ref.category))
            return asset if ref.category == TABLE else recoloured(asset, self.recolour)
        from workers.assets.library.shapes import load_shape

        assert library is not None
        row = library.entries[ref.category][ref.index]
        return load_shape(library, row, settings, self.assets, ref.instance_id)

    def _sources(self, category: str) -> "list[tuple[AnySource, Library | None]]":
        if category == TABLE:
            return list(zip(self.assets.tables, self.tables, strict=True))
        return list(zip(self.assets.objects, self.objects, strict=True))


def open_catalogue(assets: Assets, job_folder: Path, categories: Collection[str], watch: Watch = ignore) -> Catalogue:
    """Opens every library, and makes one of each source that is none yet.

    `watch` is told now and then how far it is. Raises AssetSourceError where a folder cannot be used, no source has a
    category, or a source has nothing of it that can be read. Workers take the opened catalogue and read only what they load.
    """
    opened: dict[str, Library] = {}

    def open_source(settings: AnySource) -> "Library | None":
        if isinstance(settings, ProceduralSource):
            return None
        from workers.assets.library.making import open_library

        if settings.folder not in opened:
            opened[settings.folder] = open_library(settings.folder, job_folder, watch)
        return opened[settings.folder]

    objects = tuple(open_source(source) for source in assets.objects)
    tables = tuple(open_source(source) for source in assets.tables)
    _refuse_ambiguous(assets)
    catalogue = Catalogue(assets, objects, tables, _digest(assets, objects, tables, categories))
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
    libraries = catalogue.tables if category == TABLE else catalogue.objects
    for library in libraries:
        if library is not None and library.entries.get(category) and not library.count(category):
            most = f"none of {len(library.entries[category])} meshes for {category!r} in {library.source} can be used"
            raise AssetSourceError(f"{most}: {'; '.join(library.examples)}")
    if catalogue.offers(category):
        return
    where = "assets.tables" if category == TABLE else "assets.objects"
    seen = [_describe(library) for library in libraries if library is not None]
    foreign = category in BUILT_IN and BUILT_IN[category].synset is None
    hint = f" ShapeNetCore has no {category}." if foreign else ""
    raise AssetSourceError(
        f"no source in {where} offers {category!r}: {'; '.join(seen)}.{hint} Add `- source: procedural` there, "
        + (f"or leave {category!r} out of `categories`." if category != TABLE else "or a library that has tables.")
    )


def _describe(library: "Library") -> str:
    names = [f"{library.count(category)} {category}" for category in library.entries]
    more = f" and {len(names) - MOST_TOLD} more" if len(names) > MOST_TOLD else ""
    left = ", ".join(f"{count} {reason}" for reason, count in library.skipped.items())
    return f"{library.source} has {', '.join(names[:MOST_TOLD]) or 'nothing'}{more}" + (
        f" (skipped: {left})" if left else ""
    )


def _digest(
    assets: Assets,
    objects: "tuple[Library | None, ...]",
    tables: "tuple[Library | None, ...]",
    categories: Collection[str],
) -> str:
    """SHA-256 over the settings of every source and, for libraries, over their rows."""
    record = [
        # The folder's path is left out: the same files elsewhere are the same catalogue.
        {
            "settings": differing_keys(settings, {"folder"}),
            "generator": VERSION if library is None else None,
            "files": None if library is None else library.digest,
        }
        for settings, library in zip((*assets.objects, *assets.tables), (*objects, *tables), strict=True)
    ]
    scalars = differing_keys(assets, {"objects", "tables"})
    whole = {"sources": record, "objects": len(objects), "categories": sorted(categories), "assets": scalars}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


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
    key = (catalogue.digest, catalogue.recolour, ref)
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


def open_cache(capacity_bytes: int) -> LRUCache[tuple[str, Recolour, InstanceRef], Asset]:
    """An LRU cache of assets. An asset larger than the capacity counts as the capacity, so that one is always kept."""
    return LRUCache(capacity_bytes, getsizeof=lambda asset: min(asset_bytes(asset), capacity_bytes))


_cache = open_cache(CACHE_BYTES)
