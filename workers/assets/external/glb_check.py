"""Pure: checks a GLB file from outside against the caps before it is parsed."""

import json
import struct
from pathlib import Path
from typing import Any

from schemas.errors import MeshError
from workers.assets.external.caps import Budget, FolderResolver, check_counts, check_nodes, describe_error
from workers.assets.external.gltf_file import MALFORMED, refuse_compressed


def check_glb(path: Path, data: bytes, resolver: FolderResolver) -> bytes:
    """The bytes of a GLB without the textures that are refused; MeshError where its counts or its node tree are."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sIII4s", data)
        tree: dict[str, Any] = json.loads(data[20 : 20 + length])
        if magic != b"glTF" or kind != b"JSON" or not isinstance(tree, dict):
            raise ValueError("no glTF header")
        refuse_compressed(path, tree)
        counts = [int(accessor["count"]) for accessor in tree.get("accessors", [])]
        vertices, faces, parts = _drawn_counts(tree, counts)
        children = [int(child) for node in tree.get("nodes", []) for child in node.get("children", [])]
        faults = _image_faults(tree, data[20 + length + 8 :], resolver.budget)
    except MALFORMED as error:
        raise MeshError(
            "unreadable", f"{path} is not a glb file that can be read: {describe_error(error):.200}"
        ) from error
    if len(set(children)) != len(children):
        raise MeshError("unreadable", f"{path}: a node has two parents")
    if min(counts, default=0) < 0 or sum(counts) > len(data):
        raise MeshError("unreadable", f"{path} promises {min(sum(counts), 10**18)} elements in {len(data)} bytes")
    check_nodes(path, max(len(tree.get("nodes", [])), parts), "nodes or parts", resolver.limits)
    check_counts(path, vertices, faces, resolver.limits)
    if not faults:
        return data
    resolver.notes += faults
    return _without_images(tree, data[20 + length :])


def _drawn_counts(tree: dict[str, Any], counts: list[int]) -> tuple[int, int, int]:
    """Vertices, faces and primitives of a glTF tree, counting a mesh each time that a node shows it."""
    of_mesh = []
    for mesh in tree.get("meshes", []):
        primitives = [(p["attributes"]["POSITION"], p.get("indices")) for p in mesh["primitives"]]
        vertices = sum(counts[position] for position, _ in primitives)
        faces = sum(counts[p if indices is None else indices] // 3 for p, indices in primitives)
        of_mesh.append((vertices, faces, len(primitives)))
    shown = [of_mesh[node["mesh"]] for node in tree.get("nodes", []) if "mesh" in node]
    vertices, faces, parts = (sum(counts) for counts in zip((0, 0, 0), *shown, strict=True))
    return vertices, faces, parts


def _image_faults(tree: dict[str, Any], binary: bytes, budget: Budget) -> list[str]:
    faults = []
    for number, image in enumerate(tree.get("images", [])):
        if "bufferView" not in image:
            faults.append(f"image {number} is not inside the file: plain base colour used")
            continue
        view = tree["bufferViews"][image["bufferView"]]
        start = int(view.get("byteOffset", 0))
        if (why := budget.take_image(binary[start : start + int(view["byteLength"])])) is not None:
            faults.append(f"image {number} {why}: plain base colour used")
    return faults


def _without_images(tree: dict[str, Any], rest: bytes) -> bytes:
    """The GLB again, with no images; `rest` is everything after the JSON chunk."""
    bare = {key: value for key, value in tree.items() if key not in ("images", "textures", "samplers")}
    for material in bare.get("materials", []):
        for level in (material, material.get("pbrMetallicRoughness", {})):
            for key in [key for key in level if key.endswith("Texture")]:
                del level[key]
        material.pop("extensions", None)
    text = json.dumps(bare).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest
