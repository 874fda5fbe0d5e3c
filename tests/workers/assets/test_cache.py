"""The cache of assets keeps within its memory."""

import pytest
import trimesh

from schemas.errors import MeshError
from tests.shapes import asset_of
from workers.assets.cache import AssetCache, asset_bytes


def make(name):
    return asset_of(trimesh.creation.icosphere(2), category=name)


def test_the_oldest_assets_go_when_the_memory_is_full_and_a_used_one_stays():
    size = asset_bytes(make("a"))
    cache, loads = AssetCache(2 * size), []

    def get(name):
        return cache.get(name, lambda: loads.append(name) or make(name))

    for name in ("a", "b", "a", "c", "a", "b"):
        get(name)
    assert loads == ["a", "b", "c", "b"]
    assert len(cache) == 2
    assert cache.bytes == 2 * size


def test_one_asset_is_kept_however_large():
    cache = AssetCache(1)
    first = cache.get("a", lambda: make("a"))
    assert cache.get("a", lambda: make("a")) is first
    assert len(cache) == 1


def test_a_mesh_that_was_refused_is_tried_again():
    cache = AssetCache(10**9)

    def refuse():
        raise MeshError("unreadable", "no")

    for _ in range(2):
        with pytest.raises(MeshError):
            cache.get("a", refuse)
    assert len(cache) == 0
