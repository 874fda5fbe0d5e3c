"""Edge: reads .glb and .gltf files from outside: the JSON tree, and the accessors that its meshes name.

A reader of its own, because none of the libraries fits: trimesh reads files and refuses `../` with a resolver, but decodes every
picture, and ignores texCoord, sparse accessors, texture transforms, alphaMode and required extensions without a word; pygltflib
reads the tree and leaves buffers, pictures, node poses and every check to its user, which is this file. Whatever a file states
is obeyed or named: an attribute in `_mesh`, a property of a material in gltf_materials.py, a required extension by `_REQUIRED`.

Everything that the tree says is a stranger's: counts are held to the caps before anything is built, names go through the folder's
resolver, and whatever malformed JSON raises is refused by `formats`.
"""

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.errors import MeshError
from workers.door.meshes.gltf_materials import Materials, image_of, read_references
from workers.door.meshes.raw import (
    DEFAULT,
    LONGEST_NAME,
    WHITE,
    FolderResolver,
    MeshVisual,
    RawMesh,
    check_counts,
    check_nodes,
    cut_strip,
)
from workers.door.opening import split_glb
from workers.geometry.colour import encode_srgb
from workers.geometry.frames import rotation_from_quaternion

INSTANCING = "EXT_mesh_gpu_instancing"
_REQUIRED = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_texture_basisu", "KHR_lights_punctual", INSTANCING)
"""Extensions that a file may require: those that are obeyed here, and those that leave the shape as it is."""
_HARMLESS = ("KHR_materials_", "EXT_texture_", "MSFT_texture_", "KHR_xmp", "KHR_animation_")
"""Beginnings of names of extensions that leave the shape as it is."""


_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def named_by_gltf(path: Path, data: bytes) -> list[str]:
    """Names of the files that a glTF file refers to, buffers first, each once."""
    tree, _ = _parse(path, data)
    references = [reference for material in tree.get("materials", []) for reference in read_references(material)]
    pictures = [image_of(tree, reference)[0] for reference in references]
    images = [tree["images"][number] for number in dict.fromkeys(pictures) if number is not None]
    uris = [item["uri"] for item in (*tree.get("buffers", []), *images) if isinstance(item.get("uri"), str)]
    return list(dict.fromkeys(unquote(uri) for uri in uris if not uri.startswith("data:") and not _is_address(uri)))


def read_gltf(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """Every triangle mesh of the file's scene at the pose of each of its nodes, v upwards, colours sRGB.

    A picture that is missing or refused leaves a note. MeshError `missing` where a buffer is not below the resolver's root,
    `too_large` where something is over a cap, `format` where the file is not one that can be read.
    """
    tree, chunk = _parse(path, data)
    _refuse_extensions(path, tree)
    _check_caps(path, tree, len(data), resolver)
    with np.errstate(all="ignore"):  # what is not finite is refused where the mesh is placed
        return list(_File(path, tree, chunk, resolver).meshes())


def _parse(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """The tree, and the bytes behind the JSON chunk of a GLB, empty for a .gltf."""
    tree, binary = split_glb(data) if path.suffix.lower() == ".glb" else (json.loads(data), b"")
    if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
        raise ValueError("no glTF: it has no `asset`")
    if not str(tree["asset"].get("version", "")).startswith("2"):
        stated = f"{tree['asset'].get('version')!r:.20}"
        raise MeshError("format", f"{path} is glTF of version {stated}, and only 2.x is read: export it as glTF 2.0")
    return tree, binary


def _refuse_extensions(path: Path, tree: dict[str, Any]) -> None:
    """MeshError `format` where the file requires an extension that is neither obeyed nor harmless."""
    for name in tree.get("extensionsRequired", []):
        if name not in _REQUIRED and not str(name).startswith(_HARMLESS):
            raise MeshError(
                "format", f"{path} needs the glTF extension {name!s:.80}, which is not read: export it without"
            )


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
    shown = [[_times(counts, node) * n for n in of_mesh[node["mesh"]]] for node in nodes if "mesh" in node]
    vertices, faces, parts = (sum(column) for column in zip((0, 0, 0), *shown, strict=True))
    check_nodes(path, max(len(nodes), parts), "nodes or parts", resolver.limits)
    check_counts(path, vertices, faces, resolver.limits)


def _instances(node: dict[str, Any]) -> dict[str, int]:
    """The accessors that place copies of a node's mesh, by attribute; none where it is shown once."""
    return dict(node.get("extensions", {}).get(INSTANCING, {}).get("attributes", {}))


def _times(counts: list[int], node: dict[str, Any]) -> int:
    return max((counts[number] for number in _instances(node).values()), default=1)


class _File:
    """A file whose counts are within the caps: its buffers, accessors, materials and nodes."""

    def __init__(self, path: Path, tree: dict[str, Any], chunk: bytes, resolver: FolderResolver) -> None:
        self.path, self.tree, self.resolver = path, tree, resolver
        self.buffers = [self._buffer(number, buffer, chunk) for number, buffer in enumerate(tree.get("buffers", []))]
        self.materials = Materials(tree, resolver, self._image)

    def meshes(self) -> Iterator[RawMesh]:
        """The primitives of triangles, in the order in which a walk of the scene's nodes meets them."""
        poses: dict[int, Pose] = {}
        for node, _, matrix in self._nodes(self._roots()):
            if "mesh" not in node:
                continue
            mesh, bones = self.tree["meshes"][node["mesh"]], None
            weights = node.get("weights", mesh.get("weights", []))
            if "skin" in node:
                poses = poses or {n: matrix for _, n, matrix in self._nodes(None)}
                bones, matrix = self._bones(self.tree["skins"][node["skin"]], poses), np.eye(4)
            placed = [matrix @ copy for copy in self._copies(node)]
            for primitive in mesh["primitives"]:
                if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN):
                    yield from (self._mesh(primitive, matrix, weights, bones) for matrix in placed)

    def _roots(self) -> list[int] | None:
        """The roots of the scene that is shown; None for those of all nodes, where the file has no scene."""
        scenes = self.tree.get("scenes", [])
        return sorted(int(root) for root in scenes[self.tree.get("scene", 0)].get("nodes", [])) if scenes else None

    def _nodes(self, roots: list[int] | None) -> Iterator[tuple[dict[str, Any], int, Pose]]:
        """Nodes below `roots`, or all: each, its number, its pose in the scene [4, 4]. ValueError where one is met twice."""
        nodes = self.tree.get("nodes", [])
        if roots is None:
            roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
        waiting = [(root, np.eye(4)) for root in reversed(roots)]
        seen = set[int]()
        while waiting:
            number, above = waiting.pop()
            if number in seen or number < 0:
                raise ValueError("a node has two parents")
            seen.add(number)
            matrix = above @ _pose(nodes[number])
            yield nodes[number], number, matrix
            waiting += [(int(child), matrix) for child in reversed(nodes[number].get("children", []))]

    def _bones(self, skin: dict[str, Any], poses: dict[int, Pose]) -> Array:
        """[J, 4, 4]: what takes a point of a skinned mesh with each joint; the node's own pose means nothing then."""
        joints = np.stack([poses[int(joint)] for joint in skin["joints"]])
        if "inverseBindMatrices" not in skin:
            return joints
        back = self._accessor(skin["inverseBindMatrices"], 16).reshape(-1, 4, 4).transpose(0, 2, 1)
        return np.asarray(joints @ back[: len(joints)])

    def _copies(self, node: dict[str, Any]) -> list[Pose]:
        """The poses [4, 4] in the node at which its mesh is shown: one, or those of EXT_mesh_gpu_instancing."""
        attributes = _instances(node)
        columns = {name: self._accessor(number, None) for name, number in attributes.items()}
        names = [name for name in ("TRANSLATION", "ROTATION", "SCALE") if name in columns]
        count = min((len(columns[name]) for name in names), default=0)
        return [_pose({name.lower(): columns[name][k] for name in names}) for k in range(count)] or [np.eye(4)]

    def _mesh(self, primitive: dict[str, Any], matrix: Pose, weights: list[float], bones: Array | None) -> RawMesh:
        attributes, targets = primitive["attributes"], primitive.get("targets", [])
        vertices = self._accessor(attributes["POSITION"], 3)
        indices = primitive.get("indices")
        corners = np.arange(len(vertices)) if indices is None else self._accessor(indices, 1)[:, 0].astype(np.int64)
        normals = self._accessor(attributes["NORMAL"], 3) if "NORMAL" in attributes else None
        for weight, target in zip(weights, targets, strict=False):
            if weight and "POSITION" in target:
                vertices, normals = vertices + float(weight) * self._accessor(target["POSITION"], 3), None
        if bones is not None and "JOINTS_0" in attributes:
            vertices, normals = self._skinned(attributes, bones, vertices), None
        visual = self._visual(primitive, len(vertices))
        return RawMesh(vertices, _triangles(corners, primitive.get("mode", _TRIANGLES)), normals, visual, matrix)

    def _skinned(self, attributes: dict[str, Any], bones: Array, vertices: Array) -> Array:
        """Points [V, 3] moved by up to four joints each, or more where there are more sets."""
        moved, total = np.zeros((len(vertices), 3)), np.zeros((len(vertices), 1))
        points = np.column_stack([vertices, np.ones(len(vertices))])
        for k in range(len(attributes)):
            if f"JOINTS_{k}" not in attributes:
                break
            joints = self._accessor(attributes[f"JOINTS_{k}"], 4).astype(np.int64)
            shares = self._accessor(attributes[f"WEIGHTS_{k}"], 4)
            for joint, share in zip(joints.T, shares.T, strict=True):
                moved += share[:, None] * np.einsum("vij,vj->vi", bones[joint, :3], points)
                total += share[:, None]
        return moved / np.where(total > 0.0, total, 1.0)

    def _visual(self, primitive: dict[str, Any], count: int) -> MeshVisual:
        attributes, number, colors = primitive["attributes"], primitive.get("material"), None
        look = None if number is None else self.materials.look(number)
        if "COLOR_0" in attributes:
            colors = _colors(self._accessor(attributes["COLOR_0"], None), count)
        if colors is not None and (look is None or look.opaque):
            colors[:, 3] = 255
        coordinates = "TEXCOORD_0" if look is None else look.coordinates
        uv = self._accessor(attributes[coordinates], 2) if coordinates in attributes else None
        uv = None if uv is None or uv.shape != (count, 2) or not np.isfinite(uv).all() else uv
        if look is None:  # the default material of the format is white; of a file without any it is told by nothing
            plain = WHITE if colors is not None or self.tree.get("materials") else DEFAULT
            return MeshVisual(plain, None if uv is None else np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]), colors)
        if uv is None:
            return MeshVisual(replace(look.material, texture=None), None, colors)
        return self.materials.visual(look, uv, colors)

    def _image(self, image: dict[str, Any]) -> bytes:
        """The bytes of a picture; FileNotFoundError where it is missing or refused, which is noted."""
        uri = image.get("uri")
        return _read(uri, self.resolver) if isinstance(uri, str) else self._view(image["bufferView"]).tobytes()

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
        count, component, size = int(accessor["count"]), accessor["componentType"], _WIDTHS[accessor["type"]]
        if number < 0 or size != (width or size) or count < 1:
            raise ValueError(f"an accessor of {count} {accessor['type']}")
        if "bufferView" in accessor:
            stride = int(self.tree["bufferViews"][accessor["bufferView"]].get("byteStride", 0))
            values = self._elements(accessor, component, size, count, stride)
        elif "sparse" in accessor:
            if count > max(self.resolver.limits.max_vertices, self.resolver.limits.max_faces):
                raise ValueError(f"a sparse accessor of {count} elements")
            values = np.zeros((count, size), _TYPES[component])
        else:
            raise ValueError("an accessor without a view")
        if (sparse := accessor.get("sparse")) is not None:
            few, values = int(sparse["count"]), values.copy()
            at = self._elements(sparse["indices"], sparse["indices"]["componentType"], 1, few, 0)[:, 0].astype(np.int64)
            values[at] = self._elements(sparse["values"], component, size, few, 0)
        if accessor.get("normalized", False) and values.dtype.kind in "iu":
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values if width == 1 else values.astype(np.float64)


def _pose(node: dict[str, Any]) -> Pose:
    """A node's pose [4, 4] in its parent: a matrix by columns, or translation, rotation (x, y, z, w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    turn = np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=np.float64).reshape(4)
    result = np.eye(4)
    result[:3, :3] = rotation_from_quaternion(turn) if turn.any() else np.eye(3)
    result[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64).reshape(3)
    result[:3, 3] = np.array(node.get("translation", (0.0, 0.0, 0.0)), dtype=np.float64).reshape(3)
    return result


def _triangles(corners: NDArray, mode: int) -> NDArray[np.int64]:
    """[F, 3]: the faces that a list, strip or fan of corners draws; every second face of a strip is turned."""
    corners = corners.astype(np.int64)
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if mode == _FAN:
        return np.column_stack([np.full(max(len(corners) - 2, 0), corners[0]), corners[1:-1], corners[2:]])
    return cut_strip(corners)


def _colors(values: NDArray, count: int) -> NDArray[np.uint8] | None:
    """[V, 4] uint8 sRGB of vertex colours, linear and in [0, 1] or in the whole range of their type."""
    if values.shape not in ((count, 3), (count, 4)) or not np.isfinite(values).all():
        return None
    share = np.ones((count, 4))
    share[:, : values.shape[1]] = np.clip(values, 0.0, 1.0)
    share[:, :3] = encode_srgb(share[:, :3])
    return np.round(255.0 * share).astype(np.uint8)


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
