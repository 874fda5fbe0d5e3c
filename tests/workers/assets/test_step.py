"""Choosing instances, and the cache of assets that keeps within its memory."""

import numpy as np
import pytest
import trimesh

from schemas.errors import MeshError
from schemas.job.assets import Assets, ProceduralSource
from tests.kit.shapes import asset_of
from workers.assets import catalogue as step
from workers.assets.catalogue import Catalogue, asset_bytes, choose_object, load_asset, open_cache, open_catalogue


def make(name):
    return asset_of(trimesh.creation.icosphere(2), category=name)


def opened(tmp_path, instances=9):
    source = ProceduralSource(source="procedural", instances=instances)
    return open_catalogue(Assets(objects=(source,), tables=(source,)), tmp_path, ("mug",))


@pytest.fixture
def loads(monkeypatch):
    """The index of every instance that is loaded and not found in an empty cache for two assets."""
    made = []
    monkeypatch.setattr(Catalogue, "load", lambda _, ref: made.append(ref.index) or make("mug"))
    monkeypatch.setattr(step, "_cache", open_cache(2 * asset_bytes(make("mug"))))
    return made


def test_the_oldest_assets_go_when_the_memory_is_full_and_a_used_one_stays(tmp_path, loads):
    catalogue = opened(tmp_path)
    for index in (0, 1, 0, 2, 0, 1):
        load_asset(catalogue, catalogue.refer(0, "mug", index))
    assert loads == [0, 1, 2, 1]
    assert len(step._cache) == 2
    assert step._cache.currsize == 2 * asset_bytes(make("mug"))


def test_one_asset_is_kept_however_large():
    cache = open_cache(1)
    first, second = make("a"), make("b")
    cache["a"] = first
    assert cache["a"] is first
    cache["b"] = second
    assert list(cache) == ["b"]


def test_a_mesh_that_was_refused_is_tried_again(tmp_path, loads, monkeypatch):
    def refuse(*args):
        raise MeshError("unreadable", "no")

    catalogue = opened(tmp_path)
    monkeypatch.setattr(Catalogue, "load", refuse)
    for _ in range(2):
        with pytest.raises(MeshError):
            load_asset(catalogue, catalogue.refer(0, "mug", 0))
    assert len(step._cache) == 0


@pytest.mark.parametrize(("instances", "kept"), [(1_000_000, False), (100, True)])
def test_shapes_of_which_hardly_one_comes_again_are_not_kept(tmp_path, instances, kept):
    catalogue = opened(tmp_path, instances)
    ref = choose_object(catalogue, "mug", np.random.default_rng(1))
    first, second = load_asset(catalogue, ref), load_asset(catalogue, ref)
    assert (first is second) == kept
    assert first.sha256 == second.sha256
