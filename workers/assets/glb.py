"""Pure: an asset as one binary glTF 2.0 file, the same bytes for the same asset; and what trimesh makes of one, read back.

Coordinates are written as they are, in the object frame: metres, **z up**, where glTF viewers expect y up. The file
says so in `asset.extras`. Written by hand because it is short, and because other exporters do not promise the
order of parts or the compression of images, hence no bytes; the tests read it back with trimesh.
"""

import hashlib
import io
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from schemas.base import Array
from schemas.scene.shape import Asset, Material, Part, Shape
from workers.door.opening import split_glb
from workers.geometry.colour import attribute_colors, decode_srgb, encode_srgb

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_HEADER = struct.Struct("<4sIII4s")
"""Magic, version and length of the file; length and kind of its first chunk."""
PNG_LEVEL = 1
"""Textures are small and written often: the highest level saves a third of their size and costs four times the time."""

EncodeImage = Callable[[NDArray[np.uint8]], bytes]
"""A PNG of [h, w, 3 or 4] uint8."""


def encode_with_pillow(pixels: NDArray[np.uint8]) -> bytes:
    """The PNG of an image with or without alpha."""
    stream = io.BytesIO()
    Image.fromarray(np.asarray(pixels)).save(stream, "PNG", compress_level=PNG_LEVEL)
    return stream.getvalue()


class _Writer:
    """Collects buffer views, accessors and images in the order of the calls."""

    def __init__(self, encode_opaque: EncodeImage) -> None:
        self._encode_opaque = encode_opaque
        self.binary = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []
        self._numbers: dict[int, int] = {}

    def add_view(self, data: bytes, target: int | None = None) -> int:
        """The number of a new buffer view on these bytes."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.views.append(view if target is None else view | {"target": target})
        self.binary += data
        return len(self.views) - 1

    def add_accessor(self, array: NDArray, kind: str, component: int, target: int = _ARRAY_BUFFER, **more: Any) -> int:
        """The number of a new accessor on an array, one row an element."""
        view = self.add_view(np.ascontiguousarray(array).tobytes(), target)
        self.accessors.append(
            {"bufferView": view, "componentType": component, "count": len(array), "type": kind} | more
        )
        return len(self.accessors) - 1

    def add_texture(self, pixels: NDArray[np.uint8], jpeg: bytes | None) -> int:
        """The number of a texture [h, w, 3 or 4], as the JPEG that it came from; parts that share the array share the texture."""
        if id(pixels) not in self._numbers:
            data = jpeg or (self._encode_opaque(pixels) if pixels.shape[2] == 3 else encode_with_pillow(pixels))
            self._numbers[id(pixels)] = len(self.images)
            kind = "image/png" if jpeg is None else "image/jpeg"
            self.images.append({"bufferView": self.add_view(data), "mimeType": kind})
        return self._numbers[id(pixels)]


def asset_glb(
    asset: Asset, encode_opaque: EncodeImage = encode_with_pillow, library: dict[str, Any] | None = None
) -> bytes:
    """The asset's shape with its materials: positions and normals float32, one primitive for each part.

    `encode_opaque` makes the PNGs of images without alpha. `library`: what a library keeps of the asset.
    """
    writer = _Writer(encode_opaque)
    colors = decode_srgb(np.array([part.material.base_color[:3] for part in asset.shape.parts])).tolist()
    materials = [
        _material(writer, part, rgb, asset.watertight) for part, rgb in zip(asset.shape.parts, colors, strict=True)
    ]
    primitives = [_primitive(writer, part, number) for number, part in enumerate(asset.shape.parts)]
    extras: dict[str, Any] = {
        "frame": "object frame: metres, z up, origin at the centre of the bounding box",
        "category": asset.category,
        "source": asset.source,
        "sha256": asset.sha256,
    }
    if library is not None:
        extras["library"] = {**library, "bytes_sha256": hashlib.sha256(writer.binary).hexdigest()}
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "verso", "copyright": asset.licence, "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": asset.instance_id}],
        "meshes": [{"name": asset.instance_id, "primitives": primitives}],
        "materials": materials,
        "accessors": writer.accessors,
        "bufferViews": writer.views,
        "buffers": [{"byteLength": len(writer.binary) + -len(writer.binary) % 4}],
    }
    if writer.images:
        tree["images"] = writer.images
        tree["samplers"] = [{}]
        tree["textures"] = [{"source": number, "sampler": 0} for number in range(len(writer.images))]
    return join_glb(tree, bytes(writer.binary))


def join_glb(tree: dict[str, Any], binary: bytes) -> bytes:
    """A binary glTF file of a JSON tree and the bytes of its one buffer."""
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    head = _HEADER.pack(b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _material(writer: _Writer, part: Part, rgb: list[float], watertight: bool) -> dict[str, Any]:
    """The material of a part whose colour is `rgb`, linear: glTF's factors are, ours are sRGB; textures are sRGB in both."""
    material = part.material
    rough: dict[str, Any] = {
        "baseColorFactor": [*rgb, material.base_color[3]],
        "metallicFactor": material.metallic,
        "roughnessFactor": material.roughness,
    }
    see_through = material.base_color[3] < 1.0 or (part.colors is not None and bool((part.colors[:, 3] < 255).any()))
    if material.texture is not None and part.uv is not None:
        rough["baseColorTexture"] = {"index": writer.add_texture(material.texture, material.jpeg)}
        see_through |= material.texture.shape[2] == 4
    result: dict[str, Any] = {"name": part.name, "pbrMetallicRoughness": rough}
    return result | ({"alphaMode": "BLEND"} if see_through else {}) | ({} if watertight else {"doubleSided": True})


def _primitive(writer: _Writer, part: Part, material: int) -> dict[str, Any]:
    positions = part.vertices.astype("<f4")
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {"POSITION": writer.add_accessor(positions, "VEC3", _FLOAT, **bounds)}
    if part.normals is not None:
        attributes["NORMAL"] = writer.add_accessor(part.normals.astype("<f4"), "VEC3", _FLOAT)
    if part.uv is not None:
        flipped = part.uv.astype("<f4")
        flipped[:, 1] = 1.0 - part.uv[:, 1]  # glTF's v runs down
        attributes["TEXCOORD_0"] = writer.add_accessor(flipped, "VEC2", _FLOAT)
    if part.colors is not None:
        color = part.colors / 255.0
        color[:, :3] = decode_srgb(color[:, :3])
        opaque = bool((part.colors[:, 3] == 255).all())
        floats = color[:, : 3 if opaque else 4].astype("<f4")  # trimesh cuts shorts down to their lower byte
        attributes["COLOR_0"] = writer.add_accessor(floats, "VEC3" if opaque else "VEC4", _FLOAT)
    small = len(part.vertices) <= 65535
    index = part.faces.ravel().astype("<u2" if small else "<u4")
    indices = writer.add_accessor(index, "SCALAR", _USHORT if small else _UINT, _ELEMENT_BUFFER)
    return {"attributes": attributes, "indices": indices, "material": material}


def mesh_of_part(part: Part) -> trimesh.Trimesh:
    """The part in the shape's frame, metres. Its material is as glTF has it: colours linear, textures sRGB."""
    return trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, visual=_visual(part), process=False)


def _visual(part: Part) -> TextureVisuals | ColorVisuals:
    material = part.material
    if part.colors is not None and material.texture is None:
        return ColorVisuals(vertex_colors=linear_bytes(part.colors / 255.0))
    pbr = PBRMaterial(
        baseColorFactor=linear_bytes(np.array(material.base_color)),
        metallicFactor=material.metallic,
        roughnessFactor=material.roughness,
        baseColorTexture=None if material.texture is None else Image.fromarray(material.texture),
    )
    return TextureVisuals(uv=part.uv, material=pbr)


def linear_bytes(srgb: Array) -> NDArray[np.uint8]:
    """[..., 4] colours and vertex colours as glTF has them: linear, where textures and ours are sRGB; alpha as it is."""
    return np.rint(255.0 * np.concatenate([decode_srgb(srgb[..., :3]), srgb[..., 3:]], axis=-1)).astype(np.uint8)


def show_colors(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A mesh of a stored GLB that shows its vertex colours, linear as in the file.

    trimesh keeps them aside where a material stands with them, and without one other viewers draw dark metal, or white.
    """
    visual: Any = mesh.visual
    if visual.kind == "texture" and "color" in visual.vertex_attributes and visual.material.baseColorTexture is None:
        colors = attribute_colors(visual.vertex_attributes["color"], len(mesh.vertices))
        mesh.visual = ColorVisuals(mesh, vertex_colors=colors)
    return mesh


def read_shape(data: bytes) -> tuple[Shape, dict[str, Any]]:
    """The shape of a stored GLB, and what its library keeps of it (empty for other GLBs), the inverse of `asset_glb`.

    Raises ValueError, LookupError, TypeError, struct.error or OSError where the bytes are not such.
    """
    tree, binary = split_glb(data)
    kept = tree["asset"]["extras"].get("library", {})
    end = max(view["byteOffset"] + view["byteLength"] for view in tree["bufferViews"])
    if kept and hashlib.sha256(binary[:end]).hexdigest() != kept["bytes_sha256"]:
        raise ValueError("its buffer was changed")
    images: list[tuple[NDArray[np.uint8], bytes | None]] = []
    for image in tree.get("images", ()):
        view = tree["bufferViews"][image["bufferView"]]
        encoded = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        with Image.open(io.BytesIO(encoded)) as opened:
            pixels = np.asarray(opened.convert("RGBA" if "A" in opened.getbands() else "RGB"))
        images.append((pixels, encoded if image["mimeType"] == "image/jpeg" else None))
    (mesh,) = tree["meshes"]
    opaque = not any(material.get("doubleSided") for material in tree["materials"])
    parts = tuple(_read_part(tree, binary, primitive, images) for primitive in mesh["primitives"])
    return Shape(parts, bool(kept.get("closed", opaque))), kept


_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES: dict[int, np.dtype[Any]] = {_FLOAT: np.dtype("<f4"), _USHORT: np.dtype("<u2"), _UINT: np.dtype("<u4")}


def _read_part(
    tree: dict[str, Any], binary: bytes, primitive: dict[str, Any], images: list[tuple[NDArray[np.uint8], bytes | None]]
) -> Part:
    def array(number: int) -> NDArray:
        accessor = tree["accessors"][number]
        width, start = _WIDTHS[accessor["type"]], tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
        values = np.frombuffer(binary, _TYPES[accessor["componentType"]], accessor["count"] * width, start)
        if not np.isfinite(values).all():
            raise ValueError("a number that is not finite")
        return values.reshape(-1, width)

    given = {name: array(number) for name, number in primitive["attributes"].items()}
    vertices = given["POSITION"].astype(np.float64)
    faces = array(primitive["indices"]).reshape(-1, 3).astype(np.int32)
    if not len(faces) or int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise ValueError("a face names a vertex that is not there")
    if any(len(values) != len(vertices) for values in given.values()):
        raise ValueError("attributes of unlike lengths")
    uv = given["TEXCOORD_0"].astype(np.float64) if "TEXCOORD_0" in given else None
    if uv is not None:
        uv[:, 1] = 1.0 - uv[:, 1]
    stored = tree["materials"][primitive["material"]]
    rough = stored["pbrMetallicRoughness"]
    red, green, blue = encode_srgb(np.array(rough["baseColorFactor"][:3], np.float64)).tolist()
    texture, jpeg = images[rough["baseColorTexture"]["index"]] if "baseColorTexture" in rough else (None, None)
    color = red, green, blue, float(rough["baseColorFactor"][3])
    material = Material(
        color, float(rough["metallicFactor"]), float(rough["roughnessFactor"]), texture=texture, jpeg=jpeg
    )
    normals = given["NORMAL"].astype(np.float64) if "NORMAL" in given else None
    colors = attribute_colors(given.get("COLOR_0"), len(vertices), linear=True)
    for values in (vertices, faces, normals, uv, colors):
        if values is not None:
            values.setflags(write=False)
    return Part(str(stored["name"]), vertices, faces, material, normals, uv, colors)
