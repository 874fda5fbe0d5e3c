"""Edge: the visible geometry of a URDF file from outside, parsed with the standard library."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from schemas.base import Array, Pose, frozen_array
from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Material, Part, Shape
from workers.assets.external.caps import LONGEST_NAME, Budget, check_counts, check_nodes, find_inside
from workers.assets.external.formats import load_shape
from workers.assets.external.mesh import DEFAULT, LoadedMesh, check_coordinates, transform_shape
from workers.geometry.frames import pose

_DECLARATION = re.compile(rb"^\s*<\?xml[^>]*\?>")
MAX_URDF_BYTES = 10_000_000
SEGMENTS = 48
"""Facets around a URDF's cylinders and spheres."""


MOST_JOINTS_ABOVE = 256
"""Joints between a link and its root: the pose of a link is the product of all of theirs."""


def parse_urdf(path: Path, limits: MeshLimits) -> ElementTree.Element:
    """The root element; MeshError `missing`, `too_large` or `unreadable`. Documents with a DTD or entities are refused."""
    try:
        if path.stat().st_size > MAX_URDF_BYTES:
            raise MeshError("too_large", f"{path} has {path.stat().st_size} bytes, over {MAX_URDF_BYTES}")
        data = path.read_bytes()
    except OSError as error:
        raise MeshError("missing", f"{path} cannot be read: {error.strerror}") from error
    if b"<!" in data.replace(b"<!--", b"") or b"\0" in data:
        raise MeshError("unreadable", f"{path} has a document type or entities, which are refused, or is not UTF-8")
    try:
        # pybullet's own files declare XML version 0.0, which no parser accepts.
        robot = ElementTree.fromstring(_DECLARATION.sub(b"", data, count=1))
    except ElementTree.ParseError as error:
        raise MeshError("unreadable", f"{path} is not XML: {error}") from error
    if robot.tag != "robot":
        raise MeshError("unreadable", f"{path} is not a URDF: its root is <{robot.tag:.40}>")
    for what in ("link", "joint", "link/visual"):
        check_nodes(path, len(robot.findall(what)), f"{what.rpartition('/')[2]}s", limits)
    return robot


def mesh_names(robot: ElementTree.Element, kind: str = "visual") -> list[str]:
    """The file names of the meshes of all visuals, or `*`: also of those that only collide; each once, in their order."""
    return list(dict.fromkeys(mesh.get("filename", "") for mesh in robot.iterfind(f"link/{kind}/geometry/mesh")))


def seen_meshes(urdf: Path, root: Path, limits: MeshLimits) -> list[Path]:
    """The files of the meshes of all visuals, each once; MeshError where one is not inside `root`."""
    return list(dict.fromkeys(find_mesh(name, urdf, root) for name in mesh_names(parse_urdf(urdf, limits))))


def find_mesh(name: str, urdf: Path, root: Path) -> Path:
    """The file of a mesh name inside `root`; MeshError `missing`."""
    bare = re.sub(r"^(package|file|model)://", "", name[: LONGEST_NAME + 1].strip().replace("\\", "/"))
    tail = bare.split("/", 1)[-1]
    found = find_inside(root.resolve(), urdf.parent / bare, root / bare, root / tail, urdf.parent / tail)
    if found is None:
        raise MeshError("missing", f"{urdf} names the mesh {name!r:.200}, which is not inside {root}")
    return found


def load_urdf(path: Path, limits: MeshLimits, root: Path) -> LoadedMesh:
    """All visuals of all links, joints at zero, in the frame of the first root link, metres; MeshError as load_shape."""
    robot, budget = parse_urdf(path, limits), Budget(limits)
    colors = {m.get("name", ""): _color(path, m) for m in robot.iterfind("material")}
    parts, notes, vertices, faces = list[Part](), list[str](), 0, 0

    @cache
    def load(name: str) -> LoadedMesh:
        return load_shape(find_mesh(name, path, root), limits, root, budget)

    for link, T_root_link in _link_poses(path, robot):
        for visual in link.iterfind("visual"):
            loaded = _load_visual(path, visual, load)
            notes += loaded.notes
            material = visual.find("material")
            color = None if material is None else _color(path, material) or colors.get(material.get("name", ""))
            shape = transform_shape(loaded.shape, T_root_link @ _origin(path, visual))
            for part in shape.parts:
                check_coordinates(path, part.vertices)
                parts.append(replace(_colored(part, color), name=f"part{len(parts)}"))
                vertices, faces = vertices + len(part.vertices), faces + len(part.faces)
            check_nodes(path, len(parts), "parts", limits)
            check_counts(path, vertices, faces, limits)
    if not parts:
        raise MeshError("no_faces", f"{path} has no visual geometry")
    return LoadedMesh(Shape(tuple(parts)), tuple(dict.fromkeys(notes)))


def _colored(part: Part, color: tuple[float, ...] | None) -> Part:
    """The part in the URDF's colour, unless it has a material or colours of its own."""
    if color is None or part.material is not DEFAULT or part.colors is not None:
        return part
    return replace(part, material=Material(base_color=(color[0], color[1], color[2], color[3] or 1.0)))


def _color(path: Path, material: ElementTree.Element) -> tuple[float, ...] | None:
    color = material.find("color")
    return None if color is None else tuple(min(max(c, 0.0), 1.0) for c in _numbers(path, color.get("rgba"), 4))


def _link_poses(path: Path, robot: ElementTree.Element) -> list[tuple[ElementTree.Element, Pose]]:
    """Every link with its pose in the frame of its root, joints at zero; MeshError `unreadable` where joints form a loop."""
    joints: dict[str, tuple[str, Pose]] = {}
    for joint in robot.iterfind("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            joints[child.get("link", "")] = parent.get("link", ""), _origin(path, joint)
    placed = []
    for link in robot.iterfind("link"):
        name, T = link.get("name", ""), np.eye(4)
        for _ in range(MOST_JOINTS_ABOVE + 1):
            if name not in joints:
                break
            name, step = joints[name]
            T = step @ T
        else:
            above = f"{path}: the joints above link {link.get('name')!r:.80}"
            raise MeshError("unreadable", f"{above} go round in a circle, or are more than {MOST_JOINTS_ABOVE}")
        placed.append((link, T))
    return placed


def _load_visual(path: Path, visual: ElementTree.Element, load: Callable[[str], LoadedMesh]) -> LoadedMesh:
    """One visual's geometry in its own frame; `load` reads a mesh by its name."""
    for kind in visual.iterfind("geometry/*"):
        if kind.tag == "mesh":
            loaded = load(kind.get("filename", ""))
            scale = _numbers(path, kind.get("scale", "1 1 1"), 3)
            if 0.0 in scale:
                raise MeshError("no_size", f"{path} scales a mesh by {scale}")
            return replace(loaded, shape=transform_shape(loaded.shape, np.diag([*scale, 1.0])))
        return LoadedMesh(Shape((_primitive(path, kind),)), ())
    raise MeshError("unreadable", f"{path} has a visual without geometry")


def _primitive(path: Path, kind: ElementTree.Element) -> Part:
    def number(name: str) -> float:
        return float(_numbers(path, kind.get(name), 1, positive=True)[0])

    if kind.tag == "box":
        mesh = trimesh.creation.box(_numbers(path, kind.get("size"), 3, positive=True))
    elif kind.tag == "sphere":
        mesh = trimesh.creation.uv_sphere(number("radius"), count=[SEGMENTS, SEGMENTS])
    elif kind.tag == "cylinder":
        mesh = trimesh.creation.cylinder(number("radius"), number("length"), sections=SEGMENTS)
    elif kind.tag == "capsule":
        mesh = trimesh.creation.capsule(radius=number("radius"), height=number("length"))
    else:
        raise MeshError("unreadable", f"{path}: geometry <{kind.tag:.40}> is not known")
    return Part(kind.tag, frozen_array(mesh.vertices), frozen_array(mesh.faces, np.int32), DEFAULT)


def _origin(path: Path, element: ElementTree.Element) -> Pose:
    """[4, 4] of an <origin>: fixed-axis roll, pitch, yaw, then the shift (URDF: R = Rz Ry Rx)."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    roll, pitch, yaw = _numbers(path, origin.get("rpy", "0 0 0"), 3)
    return pose(_turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll), _numbers(path, origin.get("xyz", "0 0 0"), 3))


def _turn(axis: int, angle: float) -> Array:
    a, b = ((1, 2), (2, 0), (0, 1))[axis]
    R = np.eye(3)
    R[a, a] = R[b, b] = math.cos(angle)
    R[a, b], R[b, a] = -math.sin(angle), math.sin(angle)
    return R


def _numbers(path: Path, text: str | None, count: int, positive: bool = False) -> Array:
    """[count] finite float64; MeshError `unreadable`."""
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.array([])
    if len(values) != count or not np.isfinite(values).all() or (positive and (values <= 0).any()):
        raise MeshError("unreadable", f"{path}: {text!r:.60} is not {count} {'positive ' if positive else ''}numbers")
    return values
