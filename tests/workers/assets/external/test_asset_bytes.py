"""An asset as bytes: back bit by bit, and refused where it makes no sense."""

import json

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.errors import MeshError
from schemas.scene.shape import Asset, MassProperties, Material, Part, Shape
from workers.assets.external.answers import ALIGNMENT
from workers.assets.external.asset_bytes import pack_asset, unpack_asset

PICTURE = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
VERTICES = np.asfortranarray(np.random.default_rng(0).random((4, 3)))


def part(texture=None, **more):
    faces = frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)
    material = Material((0.1, 1 / 3, 0.3, 1.0), 0.2, 0.7, texture)
    return Part("a", frozen_array(VERTICES), faces, material, **more)


def packed(sent):
    """The blocks as they arrive: each aligned, in one."""
    return memoryview(b"".join(bytes(block) + bytes(-len(block) % ALIGNMENT) for block in pack_asset(sent)))


def asset():
    rich = part(PICTURE, normals=VERTICES, uv=frozen_array(np.zeros((4, 2))), colors=np.zeros((4, 4), np.uint8))
    mass = MassProperties(0.1 + 0.2, frozen_array([1 / 3, 0, 0]), frozen_array(np.eye(3) / 7), False)
    return Asset(
        "id", "mug", "urdf", "MIT", "a.obj", "e" * 64, Shape((rich, part(PICTURE), part()), True), mass,
        frozen_array(np.eye(4)), 1 / 3, False, None, True, ("a note",),
    )  # fmt: skip


def test_an_asset_comes_back_bit_by_bit_in_its_memory_order_with_its_shared_texture():
    sent = asset()
    back = unpack_asset(packed(sent))
    assert (back.mass.mass_kg, back.scale, back.notes, back.shape.closed) == (0.1 + 0.2, 1 / 3, ("a note",), True)
    assert back.mass.inertia.tobytes() == sent.mass.inertia.tobytes()
    one, two, three = back.shape.parts
    assert one.vertices.tobytes("A") == sent.shape.parts[0].vertices.tobytes("A")
    assert one.vertices.strides == sent.shape.parts[0].vertices.strides == (8, 32)
    assert one.material.texture is two.material.texture and three.material.texture is None
    assert (one.material.texture == PICTURE).all() and one.material.base_color == (0.1, 1 / 3, 0.3, 1.0)
    assert (three.normals, three.uv, three.colors) == (None, None, None)
    assert not any(array.flags.writeable for array in (one.vertices, one.faces, one.normals, one.uv, one.colors))


def changed(**change):
    _, text, *rest = pack_asset(asset())
    text = json.dumps(json.loads(text) | change).encode()
    blocks = [len(text).to_bytes(ALIGNMENT, "little"), text, *rest]
    return memoryview(b"".join(bytes(block) + bytes(-len(block) % ALIGNMENT) for block in blocks))


NAMED_TWICE = [["float64", [4, 3], "C"], ["int32", [2, 3], "C"]]


@pytest.mark.parametrize(
    "data",
    [
        memoryview(b""),
        memoryview(bytes(64)),
        packed(asset())[:-20],
        changed(parts=[{"name": "a"}]),
        changed(arrays=[["object", [1], "C"]]),
        changed(arrays=[["float64", [1 << 60], "C"]]),
        changed(arrays=NAMED_TWICE),
        changed(mass=[1.0]),
    ],
)
def test_bytes_that_make_no_sense_are_refused(data):
    with pytest.raises(MeshError, match="makes no sense"):
        unpack_asset(data)


@pytest.mark.parametrize("harm", ["nan", "face"])
def test_arrays_are_checked_again(harm):
    bad = asset()
    values = bad.shape.parts[0].vertices if harm == "nan" else bad.shape.parts[0].faces
    values.setflags(write=True)
    values[0, 0] = np.nan if harm == "nan" else 9
    with pytest.raises(MeshError, match="makes no sense"):
        unpack_asset(packed(bad))
