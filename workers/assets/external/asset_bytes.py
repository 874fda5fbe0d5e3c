"""Pure: an asset as bytes and back, without pickle, because they come from a process that has read a stranger's file.

A block of JSON, then one for each array, each aligned to 16 bytes. Floats come back bit by bit, and arrays in the memory
order that they had, on which the last bits of sums depend.
"""

import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import frozen_array
from schemas.errors import MeshError
from schemas.scene.shape import Asset, MassProperties, Material, Part, Shape
from workers.assets.external.answers import ALIGNMENT

_KINDS = ("float64", "int32", "uint8")
_PLAIN = (
    "instance_id",
    "category",
    "source",
    "licence",
    "path",
    "sha256",
    "scale",
    "watertight",
    "volume_m3",
    "shareable",
)
"""Fields of an asset that JSON holds as they are."""


class _Writer:
    """Collects arrays; the same array is kept once, because parts that share a texture must go on sharing it."""

    def __init__(self) -> None:
        self.heads: list[list[Any]] = []
        self.blocks: list[memoryview] = []
        self._numbers: dict[int, int] = {}

    def add(self, array: NDArray | None) -> int | None:
        if array is None:
            return None
        if id(array) not in self._numbers:
            order = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
            flat = np.ascontiguousarray(array.T if order == "F" else array)
            self._numbers[id(array)] = len(self.heads)
            self.heads.append([str(array.dtype), list(array.shape), order])
            self.blocks.append(flat.reshape(-1).view(np.uint8).data)
        return self._numbers[id(array)]


def pack_asset(asset: Asset) -> list[bytes | memoryview]:
    """The asset's blocks of bytes. Built-in shapes have fields that files have not, and are not packed."""
    writer = _Writer()
    parts = [
        {
            "name": part.name,
            "base_color": part.material.base_color,
            "metallic": part.material.metallic,
            "roughness": part.material.roughness,
            "texture": writer.add(part.material.texture),
            **{name: writer.add(getattr(part, name)) for name in ("vertices", "faces", "normals", "uv", "colors")},
        }
        for part in asset.shape.parts
    ]
    mass = asset.mass
    tree = {
        **{name: getattr(asset, name) for name in _PLAIN},
        "notes": asset.notes,
        "parts": parts,
        "closed": asset.shape.closed,
        "mass": [mass.mass_kg, mass.com.tolist(), mass.inertia.tolist(), mass.solid],
        "T_source_to_object": asset.T_source_to_object.tolist(),
        "arrays": writer.heads,
    }
    text = json.dumps(tree).encode()
    return [len(text).to_bytes(ALIGNMENT, "little"), text, *writer.blocks]


def unpack_asset(data: memoryview) -> Asset:
    """The asset of `pack_asset`'s blocks, each aligned, in one; its arrays are views of them.

    Raises MeshError `unreadable` where the blocks are not such, or the arrays do not fit.
    """
    try:
        stop = ALIGNMENT + int.from_bytes(data[:ALIGNMENT], "little")
        tree = json.loads(bytes(data[ALIGNMENT:stop]))
        arrays = _arrays(tree["arrays"], data[stop + -stop % ALIGNMENT :])
        parts = tuple(_part(part, arrays) for part in tree["parts"])
        mass_kg, com, inertia, solid = tree["mass"]
        return Asset(
            **{name: tree[name] for name in _PLAIN},
            shape=Shape(parts, tree["closed"]),
            mass=MassProperties(mass_kg, frozen_array(com), frozen_array(inertia), solid),
            T_source_to_object=frozen_array(tree["T_source_to_object"]),
            notes=tuple(tree["notes"]),
        )
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise MeshError("unreadable", f"the mesh reader's answer makes no sense: {error!r:.200}") from error


def _arrays(heads: list[list[Any]], data: memoryview) -> list[NDArray]:
    arrays, start = [], 0
    for kind, shape, order in heads:
        if kind not in _KINDS:
            raise ValueError(f"an array of {kind}")
        count = math.prod(shape)
        flat = np.frombuffer(data, dtype=kind, count=count, offset=start)
        array = flat.reshape(shape, order=order)
        array.setflags(write=False)
        arrays.append(array)
        start += array.nbytes + -array.nbytes % ALIGNMENT
    return arrays


def _part(tree: dict[str, Any], arrays: list[NDArray]) -> Part:
    vertices, faces, texture, normals, uv, colors = (
        None if tree[name] is None else arrays[tree[name]]
        for name in ("vertices", "faces", "texture", "normals", "uv", "colors")
    )
    assert vertices is not None and faces is not None
    count = len(vertices)
    _require("vertices", vertices, np.float64, (count, 3))
    _require("faces", faces, np.int32, (len(faces), 3))
    _require("normals", normals, np.float64, (count, 3))
    _require("uv", uv, np.float64, (count, 2))
    _require("colors", colors, np.uint8, (count, 4))
    if texture is not None and (texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] not in (3, 4)):
        raise ValueError(f"a texture {texture.shape} of {texture.dtype}")
    if not len(faces) or int(faces.min()) < 0 or int(faces.max()) >= count:
        raise ValueError("a face names a vertex that is not there")
    red, green, blue, alpha = (float(value) for value in tree["base_color"])
    material = Material((red, green, blue, alpha), float(tree["metallic"]), float(tree["roughness"]), texture)
    return Part(str(tree["name"]), vertices, faces, material, normals, uv, colors)


def _require(name: str, array: NDArray | None, kind: type, shape: tuple[int, ...]) -> None:
    """ValueError where an array is not of this kind and shape, or not finite."""
    if array is None:
        return
    if array.dtype != kind or array.shape != shape or (kind is np.float64 and not np.isfinite(array).all()):
        raise ValueError(f"{name} {array.shape} of {array.dtype}")
