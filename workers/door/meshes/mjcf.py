"""Edge: what is seen of an MJCF file, MuJoCo's XML, and MuJoCo's own format of meshes (.msh), from outside.

After MuJoCo's XML reference: defaults by class, angles in degrees unless the compiler says radians, quaternions with w first,
and of a body with geoms that collide with nothing only these are seen, the others being its collision shapes.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np

from schemas.base import Array, Pose
from schemas.errors import MeshError
from workers.door.meshes.posed import MOST_ABOVE, Model, Source, Visual, make_body, numbers, scaled
from workers.door.meshes.raw import DEFAULT, FolderResolver, MeshVisual, RawMesh, check_nodes
from workers.geometry.frames import half_turn, pose, rotation_about, rotation_between, rotation_from_quaternion

Attributes = Mapping[str, str]
Node = ElementTree.Element

NOT_READ = ("attach", "composite", "flexcomp", "replicate", "skin")
"""Elements that put a body together from something else."""

HIDDEN_GROUP = 3
"""Groups from this one on are not shown unless one asks: collision shapes lie there."""


@dataclass(frozen=True)
class _Document:
    """A file: its compiler's settings, and the attributes of its defaults by class and element."""

    path: Path
    root: Node
    compiler: Attributes
    defaults: Mapping[str, Mapping[str, Attributes]]

    def attributes(self, element: Node, of_body: str) -> Attributes:
        """An element's attributes over those of its class, or else of the class that its body has for its children."""
        name = element.get("class", of_body)
        return {**self.defaults.get(name, self.defaults[""]).get(element.tag, {}), **element.attrib}

    def numbers(self, given: Attributes, name: str, usual: str) -> Array:
        """An attribute as numbers, as many as `usual` has."""
        return numbers(self.path, given.get(name, usual), len(usual.split()))


def read_mjcf(source: Source) -> Model:
    """The geoms of an MJCF's bodies that are seen, joints at zero, in the frame of the world, metres.

    Of a file with one body that moves freely only that: what is around it is its world. MeshError `format` where several do.
    """
    path, root = source.path, source.parse(source.path, ["mujoco"], "an MJCF")
    _include(source, root, 0)
    for tag in NOT_READ:
        if root.find(f".//{tag}") is not None:
            raise MeshError(
                "format", f"{path} has <{tag}>, which is not read: write the whole model with MuJoCo's mj_saveLastXML"
            )
    _leave_out_world(source, root)
    compiler = {name: value for item in root.iterfind("compiler") for name, value in item.attrib.items()}
    defaults = {"": dict[str, Attributes]()}
    for top in root.iterfind("default"):
        _add_defaults(top, defaults[""], defaults, 0)
        defaults[""] = defaults.get(top.get("class", "main"), defaults[""])
    document = _Document(path, root, compiler, defaults)
    meshes = {_name_of(mesh): mesh for mesh in root.iterfind("asset/mesh")}
    seen = [item for world in root.iterfind("worldbody") for item in _seen(document, world, np.eye(4), "", 0)]
    visuals = (_visual(document, geom, T, meshes) for geom, T in seen)
    names = (_file_of(document, mesh, "meshdir") for mesh in meshes.values() if mesh.get("file"))
    return Model(tuple(item for item in visuals if item is not None), tuple(dict.fromkeys(names)))


def _include(source: Source, element: Node, depth: int) -> None:
    """Puts what included files have in place of each <include>; MeshError `unreadable` where one is included twice."""
    if depth > MOST_ABOVE:
        raise MeshError("unreadable", f"{source.path} has more than {MOST_ABOVE} bodies inside one another")
    for number, child in reversed(list(enumerate(element))):
        if child.tag == "include":
            path = source.demand(child.get("file", ""))
            if path in (*source.files, source.path.resolve()):
                raise MeshError("unreadable", f"{source.path} includes {path.name} twice")
            source.files[path] = None
            check_nodes(source.path, len(source.files), "included files", source.limits)
            included = source.parse(path, ["mujoco", "mujocoinclude"], "an MJCF")
            _include(source, included, depth + 1)
            element[number : number + 1] = list(included)
        else:
            _include(source, child, depth + 1)


def _leave_out_world(source: Source, root: Node) -> None:
    """Takes out what is around the body that moves freely, which may be in a <frame> and in no other body."""
    tops = list(root.iterfind("worldbody"))
    for top in tops:
        tops += top.iterfind("frame")
    bodies = [(top, body) for top in tops for body in top.iterfind("body")]
    free = [
        body for _, body in bodies if body.find("freejoint") is not None or body.find("joint[@type='free']") is not None
    ]
    if len(free) > 1:
        what = f"is a world of {len(free)} bodies that move freely, and no object: write each into a file of its own"
        raise MeshError("format", f"{source.path} {what}")
    if free:
        around = [(top, body) for top, body in bodies if body is not free[0]]
        around += [(top, geom) for top in tops for geom in top.iterfind("geom") if geom.get("type") != "plane"]
        for top, element in around:
            top.remove(element)
        if around:
            source.notes.append("only its free body is used, and not the world around it")


def _add_defaults(
    element: Node, above: Mapping[str, Attributes], defaults: dict[str, dict[str, Attributes]], depth: int
) -> None:
    if depth > MOST_ABOVE:
        return
    mine = dict(above)
    for child in element:
        if child.tag != "default":
            mine[child.tag] = {**mine.get(child.tag, {}), **child.attrib}
    defaults[element.get("class", "main")] = mine
    for child in element.iterfind("default"):
        _add_defaults(child, mine, defaults, depth + 1)


def _name_of(asset: Node) -> str:
    return asset.get("name") or PurePosixPath(asset.get("file", "").replace("\\", "/")).stem


def _file_of(document: _Document, asset: Node, folder: str) -> str:
    """The name of an asset's file, below the folder that the compiler's settings say."""
    name = asset.get("file", "").replace("\\", "/")
    if document.compiler.get("strippath") == "true":
        name = PurePosixPath(name).name
    above = document.compiler.get(folder) or document.compiler.get("assetdir") or ""
    return f"{above.rstrip('/')}/{name}" if above else name


def _seen(document: _Document, body: Node, T: Pose, of_body: str, depth: int) -> Iterator[tuple[Attributes, Pose]]:
    """The attributes of the geoms of a body and of those inside it that are seen, with the pose of each."""
    if depth > MOST_ABOVE:
        raise MeshError("unreadable", f"{document.path} has more than {MOST_ABOVE} bodies inside one another")
    geoms = [
        (geom, T @ _pose(document, geom))
        for geom in (document.attributes(one, of_body) for one in body.iterfind("geom"))
    ]
    shown = [one for one in geoms if int(document.numbers(one[0], "group", "0")[0]) < HIDDEN_GROUP]
    apart = [one for one in shown if one[0].get("contype", "1") == one[0].get("conaffinity", "1") == "0"]
    yield from apart or shown
    for inner in body:
        if inner.tag in ("body", "frame"):
            below = T @ _pose(document, inner.attrib)
            yield from _seen(document, inner, below, inner.get("childclass", of_body), depth + 1)


def _visual(document: _Document, geom: Attributes, T: Pose, meshes: Mapping[str, Node]) -> Visual | None:
    """What a geom shows; None for a plane, a height field, and what is quite transparent."""
    colour, texture, by_side = _look(document, geom)
    kind = "mesh" if "mesh" in geom else geom.get("type", "sphere")
    if kind in ("plane", "hfield", "sdf") or (colour is not None and colour[3] == 0.0):
        return None
    if kind != "mesh":
        return Visual(
            T, None, make_body(document.path, kind, _sizes(document, geom, kind)), colour, texture, by_side=by_side
        )
    mesh = meshes.get(geom.get("mesh", ""))
    if mesh is None or not mesh.get("file"):
        raise MeshError("unreadable", f"{document.path} has no file of the mesh {geom.get('mesh')!r:.200}")
    given = document.attributes(mesh, "")
    reference = pose(
        _rotation(document.numbers(given, "refquat", "1 0 0 0")), document.numbers(given, "refpos", "0 0 0")
    )
    T = T @ scaled(document.path, document.numbers(given, "scale", "1 1 1")) @ np.linalg.inv(reference)
    return Visual(T, _file_of(document, mesh, "meshdir"), None, colour, texture, "all", by_side)


def _look(document: _Document, geom: Attributes) -> tuple[Array | None, str | None, bool]:
    """The colour and the picture of a geom, those of its material or its own colour, and whether the picture is on six sides.

    Of what MuJoCo draws itself the mean colour; a picture of several sides is not read.
    """
    material = _asset(document, "material", geom.get("material"))
    rgba = numbers(document.path, geom["rgba"], 4) if "rgba" in geom else None
    if material is None:
        return (None if rgba is None else np.clip(rgba, 0.0, 1.0)), None, False
    given = document.attributes(material, "")
    layers = [
        layer.get("texture") for layer in material.iterfind("layer") if layer.get("role", "rgb") in ("rgb", "rgba")
    ]
    texture = _asset(document, "texture", given.get("texture") or next(iter(layers), None))
    colour = np.clip(rgba if rgba is not None else document.numbers(given, "rgba", "1 1 1 1"), 0.0, 1.0)
    if texture is None or "gridsize" in texture.attrib:
        return colour, None, False
    drawn = texture.get("builtin", "none")
    if drawn != "none":
        one, two = (
            document.numbers(texture.attrib, *word) for word in (("rgb1", "0.8 0.8 0.8"), ("rgb2", "0.5 0.5 0.5"))
        )
        return colour * [*np.clip(one if drawn == "flat" else 0.5 * (one + two), 0.0, 1.0), 1.0], None, False
    named = _file_of(document, texture, "texturedir") if texture.get("file") else None
    return colour, named, named is not None and texture.get("type", "cube") == "cube"


def _asset(document: _Document, tag: str, name: str | None) -> Node | None:
    if name is None:
        return None
    return next((asset for asset in document.root.iterfind(f"asset/{tag}") if _name_of(asset) == name), None)


def _ends(document: _Document, given: Attributes) -> Array | None:
    """The two ends [2, 3] of a geom that is told by them."""
    return document.numbers(given, "fromto", "0 0 0 0 0 0").reshape(2, 3) if "fromto" in given else None


def _sizes(document: _Document, geom: Attributes, kind: str) -> Array:
    """The sizes of a simple geom as `make_body` has them, from half lengths."""
    half = numbers(document.path, geom.get("size"), len(geom.get("size", "").split()), positive=False)
    ends = _ends(document, geom)
    if ends is not None:
        half = np.append(
            half[:1] if kind in ("cylinder", "capsule") else half[[0, 0]], 0.5 * np.linalg.norm(ends[1] - ends[0])
        )
    count = {"sphere": 1, "cylinder": 2, "capsule": 2}.get(kind, 3)
    if len(half) < count or (half[:count] <= 0.0).any():
        raise MeshError("unreadable", f"{document.path}: size {geom.get('size')!r:.60} is not {count} positive numbers")
    return half[:count] * np.array({"box": [2.0] * 3, "cylinder": [1.0, 2.0], "capsule": [1.0, 2.0]}.get(kind, [1.0]))


def _pose(document: _Document, given: Attributes) -> Pose:
    """[4, 4] of a body or geom in that around it, from whichever way its attributes say it."""
    unit = 1.0 if document.compiler.get("angle") == "radian" else np.pi / 180
    ends = _ends(document, given)
    if ends is not None:
        return pose(_upright(ends[0] - ends[1]), ends.mean(axis=0))
    if "euler" in given:
        R = np.eye(3)
        angles = unit * document.numbers(given, "euler", "0 0 0")
        for letter, angle in zip(document.compiler.get("eulerseq", "xyz"), angles, strict=False):
            step = rotation_about(np.eye(3)["xyz".find(letter.lower())], float(angle))
            R = R @ step if letter.islower() else step @ R
    elif "axisangle" in given:
        about = document.numbers(given, "axisangle", "0 0 1 0")
        R = rotation_about(about[:3] / np.linalg.norm(about[:3]), unit * float(about[3]))
    elif "xyaxes" in given:
        x, y = document.numbers(given, "xyaxes", "1 0 0 0 1 0").reshape(2, 3)
        x = x / np.linalg.norm(x)
        y = y - (y @ x) * x
        R = np.stack([x, y / np.linalg.norm(y), np.cross(x, y / np.linalg.norm(y))], axis=1)
    elif "zaxis" in given:
        R = _upright(document.numbers(given, "zaxis", "0 0 1"))
    else:
        R = _rotation(document.numbers(given, "quat", "1 0 0 0"))
    return pose(R, document.numbers(given, "pos", "0 0 0"))


def _rotation(quaternion: Array) -> Array:
    """[3, 3] of a quaternion [4], w first, of any length but 0."""
    return rotation_from_quaternion(np.roll(quaternion, -1))


def _upright(direction: Array) -> Array:
    """[3, 3]: the smallest turn that takes z to a direction [3] of any length; about x where that is -z."""
    direction = direction / np.linalg.norm(direction)
    opposite = direction[2] < -1.0 + 1e-12
    return half_turn(np.array([1.0, 0.0, 0.0])) if opposite else rotation_between(np.array([0.0, 0.0, 1.0]), direction)


_MSH_HEAD = struct.Struct("<4i")


def count_msh(data: bytes) -> tuple[int, int]:
    """Vertices and faces of an .msh file; MeshError `format` or `unreadable` where its bytes are not as many as its head says."""
    if data.startswith(b"$MeshFormat"):
        raise MeshError("format", "is a mesh of Gmsh, which is not read: export it as .stl")
    vertices, normals, coordinates, faces = (
        _MSH_HEAD.unpack_from(data) if len(data) >= _MSH_HEAD.size else (-1, 0, 0, 0)
    )
    if (
        min(vertices, normals, coordinates, faces) < 0
        or len(data) != 16 + 12 * (vertices + normals + faces) + 8 * coordinates
    ):
        raise MeshError("unreadable", "is not a mesh of MuJoCo: its head does not tell its length")
    return vertices, faces


def read_msh(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """The mesh of a file in MuJoCo's format: counts, then vertices, normals, texture coordinates (v down) and faces."""
    count_msh(data)
    vertices, normals, coordinates, faces = _MSH_HEAD.unpack_from(data)
    floats = np.frombuffer(data, "<f4", 3 * (vertices + normals) + 2 * coordinates, 16).astype(np.float64)
    points, across, uv = np.split(floats, [3 * vertices, 3 * (vertices + normals)])
    corners = np.frombuffer(data, "<i4", 3 * faces, 16 + 4 * len(floats)).astype(np.int64).reshape(-1, 3)
    uv = uv.reshape(-1, 2) * (1.0, -1.0) + (0.0, 1.0)
    visual = MeshVisual(DEFAULT, uv if coordinates == vertices else None)
    return [
        RawMesh(
            points.reshape(-1, 3), corners, across.reshape(-1, 3) if normals == vertices else None, visual, np.eye(4)
        )
    ]
