"""Edge: reads .glb and .gltf files from outside: the JSON tree, and the accessors that its meshes name.

A reader of its own, because none of the libraries fits: trimesh reads files and refuses `../` with a resolver, but decodes every
picture, and ignores texCoord, sparse accessors, texture transforms, alphaMode and required extensions without a word; pygltflib
reads the tree and leaves buffers, pictures, node poses and every check to its user, which is this file. Whatever a file states
can be obeyed or named here: an attribute in `_mesh`, a property of a material in `_material`, a required extension in
`_refuse_extensions`.

Everything that the tree says is a stranger's: counts are held to the caps before anything is built, names go through the folder's
resolver, and whatever malformed JSON raises becomes a MeshError.
"""

import base64
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.errors import MeshError
from schemas.scene.shape import Material
from workers.assets.external.caps import (
    LONGEST_NAME,
    FolderResolver,
    check_counts,
    check_nodes,
    decode_picture,
    unreadable,
)
from workers.assets.external.mesh import DEFAULT, WHITE, MeshVisual, RawMesh, make_material
from workers.assets.glb import split_glb
from workers.geometry.colour import encode_srgb

MALFORMED = (struct.error, ArithmeticError, ValueError, LookupError, TypeError, AttributeError, RecursionError)
"""What reading a stranger's JSON may raise."""

COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
"""Extensions that hide coordinates from a reader that does not know them."""

_GLOSS = "KHR_materials_pbrSpecularGlossiness"
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def named_by_gltf(path: Path, data: bytes) -> list[str]:
    """Names of the files that a glTF file refers to, buffers first, each once; MeshError `unreadable`."""
    try:
        tree, _ = _parse(path, data)
        pictures = [
            _picture_of(tree, reference) for material in tree.get("materials", []) if (reference := _colour(material))
        ]
        images = [tree["images"][number] for number in pictures if number is not None]
        uris = [item["uri"] for item in (*tree.get("buffers", []), *images) if isinstance(item.get("uri"), str)]
        return list(dict.fromkeys(unquote(uri) for uri in uris if not uri.startswith("data:") and not _is_address(uri)))
    except MALFORMED as error:
        raise unreadable(path, error) from error


def read_gltf(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """Every triangle mesh of the file's scene at the pose of each of its nodes, v upwards, colours sRGB.

    A picture that is missing or refused leaves a note. MeshError `missing` where a buffer is not below the resolver's root,
    `too_large` where something is over a cap, `format` or `unreadable` where the file is not one that can be read.
    """
    try:
        tree, chunk = _parse(path, data)
        _refuse_extensions(path, tree)
        _check_caps(path, tree, len(data), resolver)
        with np.errstate(all="ignore"):  # what is not finite is refused where the mesh is placed
            return list(_File(path, tree, chunk, resolver).meshes())
    except MALFORMED as error:
        raise unreadable(path, error) from error


def _parse(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """The tree, and the bytes behind the JSON chunk of a GLB, empty for a .gltf."""
    tree, binary = split_glb(data) if path.suffix.lower() == ".glb" else (json.loads(data), b"")
    if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
        raise ValueError("no glTF: it has no `asset`")
    if not str(tree["asset"].get("version", "")).startswith("2"):
        raise ValueError(f"glTF version {tree['asset'].get('version')!r:.20}: only 2.x is read")
    return tree, binary


def _refuse_extensions(path: Path, tree: dict[str, Any]) -> None:
    """MeshError `format` where the file keeps its coordinates in an extension that is not read."""
    needed = tree.get("extensionsRequired", [])
    for name in COMPRESSED:
        if name in needed:
            raise MeshError("format", f"{path} needs the glTF extension {name}, which is not read: export it without")


def _check_caps(path: Path, tree: dict[str, Any], size: int, resolver: FolderResolver) -> None:
    """MeshError where nodes or the counts of what is drawn are over a cap, a mesh counted each time that a node shows it."""
    counts = [int(accessor["count"]) for accessor in tree.get("accessors", [])]
    size += sum(int(buffer["byteLength"]) for buffer in tree.get("buffers", []))
    if min(counts, default=0) < 0 or sum(counts) > size:
        raise MeshError("unreadable", f"{path} promises {min(sum(counts), 10**18)} elements in {size} bytes")
    of_mesh = []
    for mesh in tree.get("meshes", []):
        primitives = [(p["attributes"]["POSITION"], p.get("indices")) for p in mesh["primitives"]]
        faces = sum(counts[place if indices is None else indices] // 3 for place, indices in primitives)
        of_mesh.append((sum(counts[place] for place, _ in primitives), faces, len(primitives)))
    nodes = tree.get("nodes", [])
    shown = [of_mesh[node["mesh"]] for node in nodes if "mesh" in node]
    vertices, faces, parts = (sum(column) for column in zip((0, 0, 0), *shown, strict=True))
    check_nodes(path, max(len(nodes), parts), "nodes or parts", resolver.limits)
    check_counts(path, vertices, faces, resolver.limits)


class _File:
    """A file whose counts are within the caps: its buffers, accessors, materials and nodes."""

    def __init__(self, path: Path, tree: dict[str, Any], chunk: bytes, resolver: FolderResolver) -> None:
        self.path, self.tree, self.resolver = path, tree, resolver
        self.buffers = [self._buffer(number, buffer, chunk) for number, buffer in enumerate(tree.get("buffers", []))]
        self._pictures: dict[int, NDArray[np.uint8] | None] = {}
        self._materials: dict[tuple[int, bool], Material] = {}

    def meshes(self) -> Iterator[RawMesh]:
        """The primitives of triangles, in the order in which a walk of the scene's nodes meets them."""
        for node, matrix in self._nodes():
            if "mesh" in node:
                for primitive in self.tree["meshes"][node["mesh"]]["primitives"]:
                    if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN):
                        yield self._mesh(primitive, matrix)

    def _nodes(self) -> Iterator[tuple[dict[str, Any], Pose]]:
        """The scene's nodes, each with its pose in the scene [4, 4]; ValueError where one is met twice."""
        nodes, scenes = self.tree.get("nodes", []), self.tree.get("scenes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[self.tree.get("scene", 0)].get("nodes", []) if scenes else set(range(len(nodes))) - children
        waiting = [(int(root), np.eye(4)) for root in sorted(roots, reverse=True)]
        seen = set[int]()
        while waiting:
            number, above = waiting.pop()
            if number in seen or number < 0:
                raise ValueError("a node has two parents")
            seen.add(number)
            matrix = above @ _pose(nodes[number])
            yield nodes[number], matrix
            waiting += [(int(child), matrix) for child in reversed(nodes[number].get("children", []))]

    def _mesh(self, primitive: dict[str, Any], matrix: Pose) -> RawMesh:
        attributes = primitive["attributes"]
        vertices = self._accessor(attributes["POSITION"], 3)
        indices = primitive.get("indices")
        corners = np.arange(len(vertices)) if indices is None else self._accessor(indices, 1)[:, 0].astype(np.int64)
        normals = self._accessor(attributes["NORMAL"], 3) if "NORMAL" in attributes else None
        number, uv, colors, material = primitive.get("material"), None, None, DEFAULT
        if number is not None:
            reference = _colour(self.tree["materials"][number]) or {}
            name = f"TEXCOORD_{int(reference.get('texCoord', 0))}"
            uv = self._accessor(attributes[name], 2) if name in attributes else None
            if uv is not None and (uv.shape != (len(vertices), 2) or not np.isfinite(uv).all()):
                uv = None
        if "COLOR_0" in attributes:
            colors = _colors(self._accessor(attributes["COLOR_0"], None), len(vertices))
            material = DEFAULT if colors is None else WHITE
        if number is not None:
            material = self._material(number, uv is not None)
        if uv is not None:
            uv = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])  # glTF's v runs down
        visual = MeshVisual(material, uv, colors)
        return RawMesh(vertices, _triangles(corners, primitive.get("mode", _TRIANGLES)), normals, visual, matrix)

    def _material(self, number: int, textured: bool) -> Material:
        """A material; linear factors become sRGB. A picture only where the mesh has coordinates for it."""
        if (number, textured) not in self._materials:
            source = self.tree["materials"][number]
            rough, gloss = source.get("pbrMetallicRoughness", {}), source.get("extensions", {}).get(_GLOSS)
            reference = _colour(source)
            picture = self._picture(reference) if reference and textured else None
            factor, metallic = rough.get("baseColorFactor"), float(rough.get("metallicFactor", 1.0))
            roughness = float(rough.get("roughnessFactor", 1.0))
            if gloss is not None and not rough:
                factor, metallic = gloss.get("diffuseFactor"), 0.0
                roughness = 1.0 - float(gloss.get("glossinessFactor", 1.0))
            linear = np.ones(4) if factor is None else np.asarray(factor, dtype=np.float64).reshape(4)
            color = np.append(encode_srgb(np.clip(linear[:3], 0.0, 1.0)), linear[3])
            self._materials[number, textured], notes = make_material(color, metallic, roughness, picture)
            self.resolver.notes += notes
        return self._materials[number, textured]

    def _picture(self, reference: dict[str, Any]) -> NDArray[np.uint8] | None:
        """The picture that a reference to a texture means, [h, w, 3 or 4] uint8; None with a note where it cannot be had."""
        number = _picture_of(self.tree, reference)
        if number is None:
            self.resolver.note("a texture", "is neither PNG nor JPEG")
            return None
        if number not in self._pictures:
            self._pictures[number] = self._decode(number)
        return self._pictures[number]

    def _decode(self, number: int) -> NDArray[np.uint8] | None:
        image = self.tree["images"][number]
        uri, name = image.get("uri"), f"image {number}"
        if isinstance(uri, str):
            name = name if uri.startswith("data:") else unquote(uri)
            try:
                data = _read(uri, self.resolver)
            except FileNotFoundError:
                return None  # the resolver has noted it
        else:
            data = self._view(image["bufferView"]).tobytes()
        if (why := self.resolver.budget.take_image(data)) is not None:
            self.resolver.note(name, why)
            return None
        return decode_picture(data, self.resolver.notes)

    def _buffer(self, number: int, buffer: dict[str, Any], chunk: bytes) -> NDArray[np.uint8]:
        """A buffer's bytes, as many as it declares."""
        length, uri = int(buffer["byteLength"]), buffer.get("uri")
        if isinstance(uri, str):
            try:
                chunk = _read(uri, self.resolver)
            except FileNotFoundError as error:
                reason = "too_large" if " max_" in str(error) else "missing"
                raise MeshError(reason, f"{self.path}: its buffer {error}") from error
        elif number or self.path.suffix.lower() != ".glb":
            raise ValueError("a buffer without a file")
        if not 0 <= length <= len(chunk):
            raise ValueError(f"a buffer of {len(chunk)} bytes that declares {length}")
        return np.frombuffer(chunk, np.uint8, length)

    def _view(self, number: int) -> NDArray[np.uint8]:
        view = self.tree["bufferViews"][number]
        start, length, data = int(view.get("byteOffset", 0)), int(view["byteLength"]), self.buffers[view["buffer"]]
        if start < 0 or length < 0 or start + length > len(data):
            raise ValueError("a view beyond its buffer")
        return data[start : start + length]

    def _elements(self, place: dict[str, Any], component: int, width: int, count: int, stride: int) -> NDArray:
        """[count, width] of a view, of the component's type."""
        kind, data = np.dtype(_TYPES[component]), self._view(place["bufferView"])
        size, offset = width * kind.itemsize, int(place.get("byteOffset", 0))
        step = stride or size
        if offset < 0 or step < size or offset + step * (count - 1) + size > len(data):
            raise ValueError("an accessor beyond its view")
        return np.ndarray((count, width), kind, data.tobytes(), offset, (step, kind.itemsize))

    def _accessor(self, number: int, width: int | None) -> NDArray:
        """An accessor [count, width]: float64, integers that are not normalised as they are. Sparse values are put in."""
        accessor = self.tree["accessors"][number]
        count, component, own = int(accessor["count"]), accessor["componentType"], _WIDTHS[accessor["type"]]
        if number < 0 or own != (width or own) or count < 1:
            raise ValueError(f"an accessor of {count} {accessor['type']}")
        if "bufferView" in accessor:
            stride = int(self.tree["bufferViews"][accessor["bufferView"]].get("byteStride", 0))
            values = self._elements(accessor, component, own, count, stride)
        elif "sparse" in accessor:
            if count > max(self.resolver.limits.max_vertices, self.resolver.limits.max_faces):
                raise ValueError(f"a sparse accessor of {count} elements")
            values = np.zeros((count, own), _TYPES[component])
        else:
            raise ValueError("an accessor without a view")
        if (sparse := accessor.get("sparse")) is not None:
            few, values = int(sparse["count"]), values.copy()
            at = self._elements(sparse["indices"], sparse["indices"]["componentType"], 1, few, 0)[:, 0].astype(np.int64)
            values[at] = self._elements(sparse["values"], component, own, few, 0)
        if accessor.get("normalized", False) and values.dtype.kind in "iu":
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values if width == 1 else values.astype(np.float64)


def _pose(node: dict[str, Any]) -> Pose:
    """A node's pose [4, 4] in its parent: a matrix by columns, or translation, rotation (x, y, z, w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = (float(value) for value in node.get("rotation", (0.0, 0.0, 0.0, 1.0)))
    length = math.sqrt(x * x + y * y + z * z + w * w) or 1.0
    x, y, z, w = x / length, y / length, z / length, w / length
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result = np.eye(4)
    result[:3, :3] = np.array(turn) * np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64).reshape(3)
    result[:3, 3] = np.array(node.get("translation", (0.0, 0.0, 0.0)), dtype=np.float64).reshape(3)
    return result


def _triangles(corners: NDArray, mode: int) -> NDArray[np.int64]:
    """[F, 3]: the faces that a list, strip or fan of corners draws; every second face of a strip is turned."""
    corners = corners.astype(np.int64)
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if mode == _FAN:
        return np.column_stack([np.full(max(len(corners) - 2, 0), corners[0]), corners[1:-1], corners[2:]])
    faces = np.column_stack([corners[:-2], corners[1:-1], corners[2:]])
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def _colors(values: NDArray, count: int) -> NDArray[np.uint8] | None:
    """[V, 4] uint8 sRGB of vertex colours, linear and in [0, 1] or in the whole range of their type."""
    if values.shape not in ((count, 3), (count, 4)) or not np.isfinite(values).all():
        return None
    share = np.ones((count, 4))
    share[:, : values.shape[1]] = np.clip(values, 0.0, 1.0)
    share[:, :3] = encode_srgb(share[:, :3])
    return np.round(255.0 * share).astype(np.uint8)


def _colour(material: dict[str, Any]) -> dict[str, Any] | None:
    """A material's reference to the texture of its base colour."""
    gloss = material.get("extensions", {}).get(_GLOSS, {})
    found = material.get("pbrMetallicRoughness", {}).get("baseColorTexture") or gloss.get("diffuseTexture")
    return found if isinstance(found, dict) else None


def _picture_of(tree: dict[str, Any], reference: dict[str, Any]) -> int | None:
    """The number of the picture that a reference to a texture means; None where it is in a format of an extension."""
    number = tree["textures"][reference["index"]].get("source")
    return None if number is None else int(number)


def _is_address(uri: str) -> bool:
    return "://" in uri[:LONGEST_NAME] or uri.startswith("file:")


def _read(uri: str, resolver: FolderResolver) -> bytes:
    """The bytes of a reference. ValueError where its data is malformed, FileNotFoundError where it is missing or refused."""
    if _is_address(uri):
        raise resolver.refuse(uri[:LONGEST_NAME], "is an address, and only files below the folder are read")
    if not uri.startswith("data:"):
        return resolver.read(unquote(uri))
    head, comma, text = uri.partition(",")
    if not comma or not head.endswith(";base64"):
        raise ValueError(f"{head!r:.60} is not data in base64")
    return base64.b64decode(text, validate=True)
