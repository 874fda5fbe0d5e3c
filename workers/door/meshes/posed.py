"""Edge: files that pose meshes and simple bodies, parsed with the standard library: their XML, and what of them is seen."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Literal
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import shapely
import trimesh
from manifold3d import CrossSection, FillRule

from schemas.base import Array, Pose, frozen_array
from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Part
from workers.door.meshes.raw import DEFAULT, LONGEST_NAME, FolderResolver, check_nodes, find_inside
from workers.door.opening import as_utf8, read_bytes
from workers.geometry.frames import pose, rotation_about

_DECLARATION, _REMARK = re.compile(rb"<\?xml\s[^>]*\?>"), re.compile(rb"<!--.*?-->", re.DOTALL)
_NAMESPACE = re.compile(rb"\sxmlns=([\"'])[^\"']*\1")
_BARE = re.compile(rb"=\"<([^\"<>&]*)>\"")
_PREFIX = re.compile(rb"(</?|\s)([A-Za-z_][\w.-]*):(?=[A-Za-z_])")
MAX_XML_BYTES = 10_000_000
SEGMENTS = 48
"""Facets around cylinders and spheres."""

MOST_ABOVE = 256
"""Joints or bodies between one and its root: the pose is the product of all of theirs."""


@dataclass(frozen=True, eq=False)
class Visual:
    """One thing that a file poses: a mesh by the name of its file, or a simple body.

    T: affine, [4, 4], to the frame of the whole, metres; colour: sRGB and alpha; texture: the name of a picture; dresses: what
    of the mesh these replace: what is bare of any look, also what is plain, of one colour without a picture, or all; by_side:
    whether the picture is on each of six sides, by direction, and not by the mesh's coordinates; opacity: of all of it.
    """

    T: Pose
    mesh: str | None = None
    body: Part | None = None
    colour: Array | None = None
    texture: str | None = None
    dresses: Literal["bare", "plain", "all"] = "bare"
    by_side: bool = False
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Model:
    """What a file poses: what is seen of it, the names of all its meshes, and what collides, where a format tells it.

    collisions: reads them, which most files never need; turns: whether its programs turn a glTF's y up to z: RViz (since 2025)
    and Drake do, Gazebo and MuJoCo do not.
    """

    visuals: tuple[Visual, ...]
    meshes: tuple[str, ...]
    collisions: Callable[[], Sequence[Visual]] = tuple
    turns: bool = False


class Source(FolderResolver):
    """A file that poses others; all that it names must lie below `root`. files: what it reads beside meshes and pictures."""

    def __init__(self, path: Path, root: Path, limits: MeshLimits) -> None:
        super().__init__(path, root, limits)
        self.path = path
        self.files: dict[Path, None] = {}

    def parse(self, path: Path, tags: Sequence[str], kind: str) -> ElementTree.Element:
        """The root element of this file, or of one that it includes; MeshError `missing`, `too_large` or as `parse_tree`."""
        data, encoding = as_utf8(read_bytes(path, MAX_XML_BYTES, MeshError))
        if encoding is not None:
            self.notes.append(f"{path.name} {encoding}")
        root = parse_tree(path, data, tags, kind)
        for what, many in _COUNTED.items():
            check_nodes(path, sum(1 for _ in root.iter(what)), many, self.limits)
        return root

    def find(self, name: str) -> Path | None:
        """The file inside `root` that a name means; None where there is none.

        `package://`, `model://` and folders that are not there are passed over: every tail of the name is looked for, the
        longest first, in the file's own folder and in those above it up to `root`; as it stands, and then with `%20` for a space.
        """
        return find_inside(self.root, *self.places(name))

    def demand(self, name: str) -> Path:
        """As `find`; MeshError `missing`."""
        if (path := self.find(name)) is None:
            lost = f"{name!r:.200}, which is not inside {self.root}: name a folder that holds both"
            raise MeshError("missing", f"{self.path} names {lost}")
        return path

    def find_all(self, names: Iterable[str]) -> list[Path]:
        """The files of those names that mean some, each once."""
        return list(dict.fromkeys(path for name in names if (path := self.find(name)) is not None))

    def places(self, name: str) -> Iterator[Path]:
        """Where what a name means may lie, in that order."""
        plain = re.sub(r"^(package|file|model)://", "", name[: LONGEST_NAME + 1].strip().replace("\\", "/"))
        above = [folder for folder in (self.path.parent, *self.path.parent.parents) if folder.is_relative_to(self.root)]
        for parts in (PurePosixPath(word).parts for word in dict.fromkeys((plain, unquote(plain)))):
            tails = [PurePosixPath(*parts[k:]) for k in range(min(len(parts), MOST_TAILS))]
            yield from (folder / tail for tail in tails for folder in above)


_COUNTED = {
    "link": "links",
    "joint": "joints",
    "visual": "visuals",
    "body": "bodies",
    "geom": "geoms",
    "polyline": "polylines",
}

MOST_TAILS = 32
"""Folders of a name that may be passed over."""


def parse_tree(path: Path, data: bytes, tags: Sequence[str], kind: str) -> ElementTree.Element:
    """The root element, its default namespace left out; MeshError `unreadable`, also for a DTD or entities.

    data: as `as_utf8` has it; tags: those that the root may have.
    """
    if b"<!" in data.replace(b"<!--", b"").replace(b"<![CDATA[", b"") or b"\0" in data:
        raise MeshError("unreadable", f"{path} has a document type or entities, which are refused, or is no text")
    # pybullet's own files declare XML version 0.0, which no parser accepts, and Gazebo's after a remark.
    declared = _DECLARATION.search(data)
    if declared is not None and not _REMARK.sub(b"", data[: declared.start()]).strip():
        data = data[declared.end() :]
    data = _BARE.sub(rb'="&lt;\1&gt;"', data)  # Assimp's exporter names nodes so, <STL_BINARY>
    data = _NAMESPACE.sub(b"", data, count=1)
    if b"xmlns:" not in data:
        data = _PREFIX.sub(rb"\1\2_", data)  # robots' own parsers know no namespaces, and let such pass undeclared
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise MeshError("unreadable", f"{path} is not XML: {error}") from error
    if root.tag not in tags:
        raise MeshError("unreadable", f"{path} is not {kind}: its root is <{root.tag:.40}>")
    return root


def make_body(path: Path, kind: str, sizes: Array) -> Part:
    """A body about its middle, along z; MeshError `unreadable` for a kind that is not known.

    sizes: of a `box` its sides [3], of an `ellipsoid` its half axes [3], of a `sphere` its radius [1], of a `cylinder` or
    `capsule` its radius and length [2].
    """
    if kind == "box":
        mesh = trimesh.creation.box(sizes)
    elif kind in ("sphere", "ellipsoid"):
        mesh = trimesh.creation.uv_sphere(1.0, count=[SEGMENTS, SEGMENTS])
        mesh.vertices = mesh.vertices * sizes
    elif kind == "cylinder":
        mesh = trimesh.creation.cylinder(sizes[0], sizes[1], sections=SEGMENTS)
    elif kind == "capsule":
        mesh = trimesh.creation.capsule(radius=sizes[0], height=sizes[1])
    else:
        raise MeshError("unreadable", f"{path}: geometry <{kind:.40}> is not known")
    return Part(kind, frozen_array(mesh.vertices), frozen_array(mesh.faces, np.int32), DEFAULT)


def wrap_body(part: Part, by_side: bool = False) -> Part:
    """The simple body with coordinates of a picture: once on each flat side, once around a round one; seen from outside, z up.

    by_side: once on each of six sides, whatever the body is; a face is on that which it is nearest to from the middle.
    """
    corners, size = part.vertices[part.faces], np.ptp(part.vertices, axis=0).clip(1e-12)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if by_side:
        corners = corners - part.vertices.min(axis=0) - 0.5 * size
        normal = corners.mean(axis=1) / size
    axis = np.abs(normal).argmax(axis=1)
    up = np.eye(3)[np.where(axis == 2, 1, 2)]
    right = np.cross(up, np.eye(3)[axis] * np.sign(np.take_along_axis(normal, axis[:, None], axis=1)))
    around = np.arctan2(corners[..., 1], corners[..., 0]) / (2.0 * np.pi) + 0.5
    around += (around < 0.5) & (np.ptp(around, axis=1, keepdims=True) > 0.5)  # a face across the seam
    uv = np.stack([around, corners[..., 2] / size[2] + 0.5], axis=-1)
    flat = by_side | (part.name == "box") | (np.abs(normal[:, 2]) > 0.999 * np.linalg.norm(normal, axis=1))
    uv[flat] = (np.einsum("fkc,afc->fka", corners / size, np.stack([right, up])) + 0.5)[flat]
    faces = np.arange(corners.size // 3, dtype=np.int32).reshape(-1, 3)
    each = part.faces.ravel()
    return replace(
        part,
        vertices=frozen_array(part.vertices[each]),
        faces=frozen_array(faces, np.int32),
        normals=None if part.normals is None else frozen_array(part.normals[each]),
        uv=frozen_array(uv.reshape(-1, 2)),
        colors=None if part.colors is None else frozen_array(part.colors[each], np.uint8),
    )


def read_geometry(
    path: Path, visual: ElementTree.Element, T: Pose, stated: Callable[..., str | None], file: str
) -> Visual | None:
    """What a visual of a URDF or SDF shows, its own frame at T; None for what has no end, no size, or is nothing.

    Raises MeshError `unreadable`.

    stated: how an element states a value by its name; file: the name of a mesh's file.
    """
    for kind in visual.iterfind("geometry/*"):
        value_of = partial(stated, kind)
        if kind.tag == "mesh":
            words = (value_of("scale") or "1").split()
            scale = scaled(path, numbers(path, " ".join(words * 3 if len(words) == 1 else words), 3))
            return Visual(T @ scale, (value_of(file) or "").strip())
        if kind.tag in ("plane", "empty"):
            return None
        if kind.tag == "polyline":
            return Visual(T, body=_extrude(path, list(visual.iterfind("geometry/polyline"))))
        sizes = [numbers(path, value_of(name), count, positive=True) for name, count in _SIZES.get(kind.tag, ())]
        if any((size == 0.0).any() for size in sizes):
            return None
        return Visual(T, body=make_body(path, kind.tag, np.concatenate(sizes or [np.zeros(0)])))
    return None


_SIZES = {
    "box": (("size", 3),),
    "ellipsoid": (("radii", 3),),
    "sphere": (("radius", 1),),
    **dict.fromkeys(("cylinder", "capsule"), (("radius", 1), ("length", 1))),
}
"""The sizes of bodies in URDF and SDF, and how many numbers each is."""


def _extrude(path: Path, polylines: Sequence[ElementTree.Element]) -> Part:
    """The body above outlines, from z = 0 up to their height: one inside another is a hole in it, one in a hole a body again.

    MeshError `unreadable` where they cross, or enclose nothing.
    """
    height = float(numbers(path, polylines[0].findtext("height"), 1, positive=True)[0])
    points = [[numbers(path, point.text, 2) for point in polyline.iterfind("point")] for polyline in polylines]
    outlines = [np.array(outline) for outline in points if len(outline) > 2]
    if not shapely.MultiLineString([np.concatenate([one, one[:1]]) for one in outlines]).is_simple:
        raise MeshError(
            "unreadable", f"{path} has a <polyline> that crosses itself or another one, and so has no inside"
        )
    mesh = CrossSection(outlines, FillRule.EvenOdd).extrude(height).to_mesh64()
    if not len(mesh.tri_verts):
        raise MeshError(
            "unreadable", f"{path} has a <polyline> that encloses nothing: it needs three points and a height"
        )
    return Part("polyline", frozen_array(mesh.vert_properties[:, :3]), frozen_array(mesh.tri_verts, np.int32), DEFAULT)


def scaled(path: Path, scale: Array) -> Pose:
    """[4, 4] of a scale [3] of a mesh; MeshError `no_size` where it is 0."""
    if 0.0 in scale:
        raise MeshError("no_size", f"{path} scales a mesh by {scale}")
    return np.diag([*scale, 1.0])


def turned(path: Path, xyz: str, rpy: str, unit: float = 1.0) -> Pose:
    """[4, 4] of a shift, and of roll, pitch and yaw about fixed axes, each times `unit` radians (R = Rz Ry Rx)."""
    roll, pitch, yaw = unit * numbers(path, rpy, 3)
    x, y, z = np.eye(3)
    return pose(rotation_about(z, yaw) @ rotation_about(y, pitch) @ rotation_about(x, roll), numbers(path, xyz, 3))


def numbers(path: Path, text: str | None, count: int, positive: bool = False) -> Array:
    """[count] finite float64, if `positive` none below 0; MeshError `unreadable`."""
    try:
        values = np.array([float(word.removesuffix(",")) for word in (text or "").split()])  # as robots' parsers do
    except ValueError:
        values = np.array([])
    if len(values) != count or not np.isfinite(values).all() or (positive and (values < 0).any()):
        raise MeshError("unreadable", f"{path}: {text!r:.60} is not {count} {'positive ' if positive else ''}numbers")
    return values
