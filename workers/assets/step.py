"""The stage's entry: chooses a scene's objects and table from the catalogue and loads them."""

import sys

import numpy as np
from cachetools import LRUCache

from schemas.errors import AssetSourceError
from schemas.job.assets import ProceduralSource
from schemas.job.category import TABLE
from schemas.scene.shape import Asset
from workers.assets.catalogue import Catalogue, InstanceRef

MAX_CACHED_INSTANCES = 10_000
"""Sources with more built-in instances are not cached: instances hardly ever repeat."""
CACHE_BYTES = 256 * 1024 * 1024
"""Memory that the cached assets of a process may take."""


def choose_object(catalogue: Catalogue, category: str, rng: np.random.Generator) -> InstanceRef:
    """An instance of the category: a source by weight among those that have it, then one that is fit uniformly."""
    offers = catalogue.offers(category)
    if not offers:
        raise AssetSourceError(f"no source offers {category!r}")
    share = rng.random() * sum(settings.weight for _, settings, _ in offers)
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
