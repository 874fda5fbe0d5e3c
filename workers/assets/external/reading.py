"""Edge: reads a mesh file of a stranger's into trimesh, behind caps that hold before anything large is built."""

import io
import json
import re
import struct
import warnings
from pathlib import Path
from typing import Any

import trimesh
from PIL import Image
from trimesh.resolvers import Resolver

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb")
"""What trimesh reads without further libraries."""

LEAST_BYTES = 8
"""No format writes a vertex or a face in fewer: `v 0 0 0` and its line end."""

_PICTURES = {b"\x89PNG\r\n\x1a\n": "PNG", b"\xff\xd8\xff": "JPEG"}
_PLY_ELEMENT = re.compile(rb"^element\s+(\w+)\s+(\d+)", re.MULTILINE)
_OBJ_COUNTED_BACK = re.compile(rb"^f[ \t][^\n]*-\d", re.MULTILINE)
_ADDRESS = re.compile(r"\s*<[^<>]* at 0x[0-9a-fA-F]+>")
_MTLLIB = re.compile(rb"mtllib[ \t]+([^\r\n]+)")


class FolderResolver(Resolver):
    """Hands trimesh the material files and PNG or JPEG textures of one folder, and nothing else.

    Names are relative to the mesh, may use either slash, and must stay below `root`. What is refused or missing is
    told in `notes`, and the mesh goes without it.
    """

    def __init__(self, mesh: Path, root: Path, limits: MeshLimits) -> None:
        self.folder = mesh.parent
        self.root = root.resolve()
        self.limits = limits
        self.notes: list[str] = []
        self.read: list[Path] = []

    def get(self, key: str) -> bytes:
        """The bytes of a file; raises FileNotFoundError where it is missing or refused."""
        name = str(key).strip().replace("\\", "/")
        path = self.find(name)
        if path is None:
            raise self._refuse(name, "is missing")
        if path.stat().st_size > self.limits.max_file_mb * 1e6:
            raise self._refuse(name, f"is larger than max_file_mb = {self.limits.max_file_mb:g}")
        data = path.read_bytes()
        if path.suffix.lower() != ".mtl" and (why := picture_fault(data, self.limits)) is not None:
            raise self._refuse(name, why)
        self.read.append(path)
        return data

    def find(self, name: str) -> Path | None:
        """The file that a name means, if it lies below `root`: relative to the mesh, or beside it."""
        name = name.strip().replace("\\", "/")
        for candidate in (self.folder / name, self.folder / Path(name).name):
            try:
                path = candidate.resolve()
                inside = path.is_relative_to(self.root)
            except (OSError, ValueError, RuntimeError):
                continue
            if inside and path.is_file():
                return path
        return None

    def _refuse(self, name: str, why: str) -> FileNotFoundError:
        self.notes.append(f"{name} {why}: plain base colour used")
        return FileNotFoundError(name)

    def write(self, name: str, data: object) -> None:
        """Refused: reading never writes."""
        raise PermissionError(name)

    def namespaced(self, namespace: str) -> "FolderResolver":
        """This resolver itself."""
        return self

    def keys(self) -> list[str]:
        """Nothing is listed."""
        return []


def plain_words(error: Exception) -> str:
    """Kind and message of an error without addresses in memory: what is said of a mesh goes into the dataset."""
    return _ADDRESS.sub("", repr(error))


def picture_fault(data: bytes, limits: MeshLimits) -> str | None:
    """Why these bytes may not be a texture, or None: a PNG or JPEG by its first bytes, of a size within the cap."""
    kind = next((kind for magic, kind in _PICTURES.items() if data.startswith(magic)), None)
    if kind is None:
        return "is not a PNG or JPEG file"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=(kind,)) as image:
                largest = max(image.size)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        return f"cannot be opened ({plain_words(error)})"
    return (
        f"has {largest} px, over max_texture_px = {limits.max_texture_px}" if largest > limits.max_texture_px else None
    )


def read_bytes(path: Path, limits: MeshLimits) -> bytes:
    """A mesh file's bytes; MeshError `missing`, `format` or `too_large`."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError("format", f"{path}: {path.suffix or 'no suffix'} is not one of {', '.join(MESH_SUFFIXES)}")
    try:
        size = path.stat().st_size
        if size > limits.max_file_mb * 1e6:
            raise MeshError("too_large", f"{path} has {size / 1e6:.1f} MB, over max_file_mb = {limits.max_file_mb:g}")
        return path.read_bytes()
    except OSError as error:
        raise MeshError("missing", f"{path} cannot be read: {error.strerror}") from error


def read_scene(path: Path, data: bytes, resolver: FolderResolver) -> trimesh.Scene:
    """The file as a trimesh scene, unprocessed; MeshError `too_large`, `index_out_of_range` or `unreadable`."""
    kind = path.suffix.lower()
    if kind == ".glb":
        data = _checked_glb(path, data, resolver)
    else:
        check_counts(path, *declared_counts(kind, data), resolver.limits)
    if kind == ".obj" and _counts_back(data):
        raise MeshError("unreadable", f"{path} counts vertices back from each face, which is not supported")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return trimesh.load_scene(io.BytesIO(data), file_type=kind[1:], resolver=resolver, process=False)
    except MemoryError:
        raise
    except IndexError as error:
        raise MeshError("index_out_of_range", f"{path}: a face names a vertex that is not there ({error})") from error
    except Exception as error:
        raise MeshError(
            "unreadable", f"{path} is not a {kind[1:]} file that can be read: {plain_words(error):.200}"
        ) from error


def may_be_too_large(data: bytes, limits: MeshLimits) -> bool:
    """Whether a file is long enough to hold more than the caps allow; a shorter one needs no counting."""
    return len(data) > LEAST_BYTES * min(limits.max_vertices, limits.max_faces)


def declared_counts(kind: str, data: bytes) -> tuple[int, int]:
    """How many vertices and faces a file says that it holds, read without parsing it; (0, 0) where it does not say."""
    if kind == ".obj":
        return data.count(b"\nv "), data.count(b"\nf ")
    if kind == ".ply":
        counts = {name: int(count) for name, count in _PLY_ELEMENT.findall(data[: data.find(b"end_header")][:65536])}
        if any(count > len(data) for count in counts.values()):
            raise MeshError(
                "unreadable", f"the PLY header promises {max(counts.values())} elements in {len(data)} bytes"
            )
        return counts.get(b"vertex", 0), counts.get(b"face", 0)
    if kind == ".stl" and len(data) >= 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        faces = (len(data) - 84) // 50
        return 3 * faces, faces
    return 0, data.count(b"endfacet")


def material_files(data: bytes) -> list[str]:
    """Names of the material files that an OBJ file's bytes ask for."""
    # Anchoring the expression to line starts would make it ten times slower, and it reads every byte of every mesh.
    begins = [
        match
        for match in _MTLLIB.finditer(data)
        if data[match.start() - 1 : match.start()].isspace() or match.start() == 0
    ]
    return [match.group(1).decode("utf-8", "replace").strip() for match in begins]


def check_counts(path: Path, vertices: int, faces: int, limits: MeshLimits) -> None:
    """MeshError `too_large` where a count is over its cap."""
    for name, count, cap in (("vertices", vertices, limits.max_vertices), ("faces", faces, limits.max_faces)):
        if count > cap:
            raise MeshError("too_large", f"{path} has {count} {name}, over max_{name} = {cap}")


def _counts_back(data: bytes) -> bool:
    """Whether an OBJ file has negative indices that mean something else than counted from the file's end."""
    return _OBJ_COUNTED_BACK.search(data) is not None and data.rfind(b"\nv ") > data.find(b"\nf ")


def _checked_glb(path: Path, data: bytes, resolver: FolderResolver) -> bytes:
    """A GLB whose counts are within the caps, whose nodes form a tree, without the textures that may not be read."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sIII4s", data)
        tree: dict[str, Any] = json.loads(data[20 : 20 + length])
        if magic != b"glTF" or kind != b"JSON" or not isinstance(tree, dict):
            raise ValueError("no glTF header")
        counts = [int(accessor["count"]) for accessor in tree.get("accessors", [])]
        declared = _drawn_counts(tree, counts)
        children = [int(child) for node in tree.get("nodes", []) for child in node.get("children", [])]
        faults = _picture_faults(tree, data[20 + length + 8 :], resolver.limits)
    except (struct.error, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise MeshError(
            "unreadable", f"{path} is not a glb file that can be read: {plain_words(error):.200}"
        ) from error
    if len(set(children)) != len(children):
        raise MeshError("unreadable", f"{path}: a node has two parents")
    if min(counts, default=0) < 0 or sum(counts) > len(data):
        raise MeshError("unreadable", f"{path} promises {sum(counts)} elements in {len(data)} bytes")
    check_counts(path, *declared, resolver.limits)
    if not faults:
        return data
    resolver.notes += faults
    return _without_pictures(tree, data[20 + length :])


def _drawn_counts(tree: dict[str, Any], counts: list[int]) -> tuple[int, int]:
    """Vertices and faces of a glTF tree, counting a mesh each time that a node shows it."""
    of_mesh = []
    for mesh in tree.get("meshes", []):
        primitives = [(p["attributes"]["POSITION"], p.get("indices")) for p in mesh["primitives"]]
        vertices = sum(counts[position] for position, _ in primitives)
        of_mesh.append((vertices, sum(counts[p if indices is None else indices] // 3 for p, indices in primitives)))
    shown = [of_mesh[node["mesh"]] for node in tree.get("nodes", []) if "mesh" in node]
    return sum(vertices for vertices, _ in shown), sum(faces for _, faces in shown)


def _picture_faults(tree: dict[str, Any], binary: bytes, limits: MeshLimits) -> list[str]:
    faults = []
    for number, image in enumerate(tree.get("images", [])):
        if "bufferView" not in image:
            faults.append(f"image {number} is not inside the file: plain base colour used")
            continue
        view = tree["bufferViews"][image["bufferView"]]
        start = int(view.get("byteOffset", 0))
        if (why := picture_fault(binary[start : start + int(view["byteLength"])], limits)) is not None:
            faults.append(f"image {number} {why}: plain base colour used")
    return faults


def _without_pictures(tree: dict[str, Any], rest: bytes) -> bytes:
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
