"""Edge: .gltf and .glb files: packs the files that a .gltf names into one GLB, and checks a GLB against the caps."""

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from schemas.errors import MeshError
from workers.assets.external.caps import (
    LONGEST_NAME,
    Budget,
    FolderResolver,
    check_counts,
    check_nodes,
    describe_error,
    open_image,
)

MALFORMED = (struct.error, ArithmeticError, ValueError, LookupError, TypeError, AttributeError, RecursionError)
"""What reading a stranger's JSON may raise."""

GEOMETRY_EXTENSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
"""Extensions that hide coordinates from a reader that does not know them."""


def named_by_gltf(path: Path, data: bytes) -> list[str]:
    """Names of the files that a .gltf refers to, buffers first, each once; MeshError `unreadable`."""
    try:
        files = [uri for uri in _references(_parse(data)) if not uri.startswith("data:") and not _is_address(uri)]
        return list(dict.fromkeys(map(unquote, files)))
    except MALFORMED as error:
        raise _unreadable(path, error) from error


def refuse_compressed(path: Path, tree: dict[str, Any]) -> None:
    """MeshError `format` where the file keeps its coordinates in an extension that is not read."""
    needed = tree.get("extensionsRequired", [])
    for name in GEOMETRY_EXTENSIONS:
        if name in needed:
            raise MeshError("format", f"{path} needs the glTF extension {name}, which is not read: export it without")


def pack_gltf(path: Path, data: bytes, resolver: FolderResolver) -> bytes:
    """The .gltf as one GLB: its buffers one after another, the pictures of base colours behind them.

    Other pictures are left out, because nothing reads them, and so is one that is missing or refused, with a note.
    MeshError `missing` where a buffer is not below the resolver's root, `too_large` where it is over a cap, `format` or
    `unreadable` where the file is not one that can be read.
    """
    try:
        tree = _parse(data)
        refuse_compressed(path, tree)
        binary = _Binary()
        starts = [binary.add(_read_buffer(path, buffer, resolver)) for buffer in tree.get("buffers", [])]
        for view in tree.get("bufferViews", []):
            view["byteOffset"] = starts[view["buffer"]] + _inside(view, tree["buffers"][view["buffer"]])
            view["buffer"] = 0
        _embed_colours(tree, binary, resolver)
    except MALFORMED as error:
        raise _unreadable(path, error) from error
    tree["buffers"] = [{"byteLength": len(binary.data)}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    length = 28 + len(text) + len(binary.data)
    head = struct.pack("<4sIII4s", b"glTF", 2, length, len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary.data), b"BIN\0") + bytes(binary.data)


class _Binary:
    """Blocks of bytes, each aligned to four."""

    def __init__(self) -> None:
        self.data = bytearray()

    def add(self, block: bytes) -> int:
        """Appends a block; where it begins."""
        start = len(self.data)
        self.data += block + bytes(-len(block) % 4)
        return start


def _parse(data: bytes) -> dict[str, Any]:
    tree = json.loads(data)
    if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
        raise ValueError("no glTF: it has no `asset`")
    if not str(tree["asset"].get("version", "")).startswith("2"):
        raise ValueError(f"glTF version {tree['asset'].get('version')!r:.20}: only 2.x is read")
    return tree


def _references(tree: dict[str, Any]) -> Iterator[str]:
    """What the buffers and the pictures of base colours refer to."""
    numbers = [
        _picture_of(tree, slot[key]) for material in tree.get("materials", []) for slot, key in _colours(material)
    ]
    pictures = [tree["images"][number] for number in dict.fromkeys(numbers) if number is not None]
    for item in (*tree.get("buffers", []), *pictures):
        if isinstance(uri := item.get("uri"), str):
            yield uri


def _colours(material: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """Where a material refers to a picture of its base colour: the branch and its key."""
    gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    slots = ((material.get("pbrMetallicRoughness", {}), "baseColorTexture"), (gloss, "diffuseTexture"))
    return [(branch, key) for branch, key in slots if key in branch]


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
    try:
        return base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise ValueError(f"data that is not base64 ({error})") from error


def _read_buffer(path: Path, buffer: dict[str, Any], resolver: FolderResolver) -> bytes:
    """A buffer's bytes, as many as it declares."""
    length, uri = int(buffer["byteLength"]), buffer.get("uri")
    if not isinstance(uri, str):
        raise ValueError("a buffer without a file")
    try:
        data = _read(uri, resolver)
    except FileNotFoundError as error:
        reason = "too_large" if " over max_" in f" {error}" or "larger than max_" in str(error) else "missing"
        raise MeshError(reason, f"{path}: its buffer {error}") from error
    if not 0 <= length <= len(data):
        raise ValueError(f"a buffer of {len(data)} bytes that declares {length}")
    return data[:length]


def _inside(view: dict[str, Any], buffer: dict[str, Any]) -> int:
    """Where a view begins in its own buffer; ValueError where it reaches over its ends, into another buffer's bytes."""
    start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
    if start < 0 or length < 0 or start + length > int(buffer["byteLength"]):
        raise ValueError("a view beyond its buffer")
    return start


def _embed_colours(tree: dict[str, Any], binary: _Binary, resolver: FolderResolver) -> None:
    """Puts the pictures of base colours behind the buffers and leaves all others out, which nothing reads."""
    images: list[dict[str, Any]] = []
    placed: dict[int | None, int | None] = {}
    for material in tree.get("materials", []):
        colours = _colours(material)
        for branch, key in colours:
            number = _picture_of(tree, branch[key])
            if number not in placed:
                placed[number] = _embed(tree, number, binary, images, resolver)
            branch[key] = {**branch[key], "index": placed[number]}
        _keep_references(material, [branch[key] for branch, key in colours if branch[key]["index"] is not None])
    for key in ("images", "textures", "samplers"):
        tree.pop(key, None)
    if images:
        tree |= {"images": images, "textures": [{"source": number} for number in range(len(images))]}


def _embed(
    tree: dict[str, Any],
    number: int | None,
    binary: _Binary,
    images: list[dict[str, Any]],
    resolver: FolderResolver,
) -> int | None:
    """Adds a picture to `images`; its number there, or None with a note where it cannot be had."""
    if number is None:
        resolver.note("a texture", "is neither PNG nor JPEG")
        return None
    picture = tree["images"][number]
    view = picture.get("bufferView")
    if view is None:
        try:
            data = _read(picture["uri"], resolver)
        except FileNotFoundError:
            return None
        if (why := open_image(data, resolver.limits)[1]) is not None:
            resolver.note("a picture within it" if picture["uri"].startswith("data:") else unquote(picture["uri"]), why)
            return None
        view = len(tree.setdefault("bufferViews", []))
        tree["bufferViews"].append({"buffer": 0, "byteOffset": binary.add(data), "byteLength": len(data)})
    images.append({"bufferView": view, "mimeType": picture.get("mimeType", "image/png")})
    return len(images) - 1


def _keep_references(branch: Any, kept: list[dict[str, Any]]) -> None:
    """Deletes every reference to a texture from a material, but for those in `kept`."""
    for key, value in list(branch.items()):
        if key.endswith("Texture") and not any(value is one for one in kept):
            del branch[key]
        elif isinstance(value, dict) and not key.endswith("Texture"):
            _keep_references(value, kept)


def _unreadable(path: Path, error: Exception) -> MeshError:
    return MeshError("unreadable", f"{path} is not a gltf file that can be read: {describe_error(error):.200}")


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
