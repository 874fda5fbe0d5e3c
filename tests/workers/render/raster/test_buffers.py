"""The store of shapes on the GPU: what was drawn last stays, and the rest goes where it is too much."""

import pytest
import trimesh

from tests.kit.shapes import shape_of
from workers.render.raster.buffers import ShapeStore


def test_the_least_recently_used_shapes_are_freed_and_those_in_use_stay(renderer):
    store = ShapeStore(renderer._gl, max_shapes=2)
    shapes = [shape_of(trimesh.creation.box((0.1 * k, 0.1, 0.1))) for k in range(1, 5)]
    uploaded = [store.fetch(shape) for shape in shapes]
    assert store.fetch(shapes[0]) is uploaded[0], "not uploaded again, and used last from now on"
    store.trim(3)
    assert [shape in store for shape in shapes] == [True, False, True, True]
    store.trim(1)
    assert [shape in store for shape in shapes] == [True, False, False, True]


def test_a_bound_on_bytes_keeps_what_is_in_use(renderer):
    store = ShapeStore(renderer._gl, max_bytes=1)
    shapes = [shape_of(trimesh.creation.box((0.1 * k, 0.1, 0.1))) for k in range(1, 4)]
    for shape in shapes:
        store.fetch(shape)
    store.trim(1)
    assert len(store) == 1 and shapes[2] in store


def test_what_nothing_else_holds_goes_and_its_place_is_free_again(renderer):
    store = ShapeStore(renderer._gl)
    kept = shape_of(trimesh.creation.box((0.1, 0.1, 0.1)))
    store.fetch(kept)
    for k in range(2, 30):
        store.fetch(shape_of(trimesh.creation.box((0.1 * k, 0.1, 0.1))))
        assert store.fetch(shape := shape_of(trimesh.creation.box((0.1 * k, 0.2, 0.1)))).corners[-1] == pytest.approx(
            [0.05 * k, 0.1, 0.05]
        ), "not what had the id before"
    store.trim(1)
    assert len(store) == 2 and kept in store and shape in store
