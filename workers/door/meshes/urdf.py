"""Edge: what is seen of a URDF, SDF or MJCF from outside as one shape; and the readers of URDF and SDF."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from os.path import relpath
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from schemas.base import Array, Pose
from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Material, Part, Shape
from workers.door.meshes.formats import load_shape, with_jpeg
from workers.door.meshes.mesh import LoadedMesh, check_coordinates, transform_shape
from workers.door.meshes.mjcf import read_mjcf
from workers.door.meshes.posed import (
    MAX_XML_BYTES,
    MOST_ABOVE,
    Model,
    Source,
    Visual,
    numbers,
    read_geometry,
    turned,
    wrap_body,
)
from workers.door.meshes.raw import DEFAULT, UNPAINTED, check_counts, check_nodes, find_inside
from workers.door.opening import as_utf8, read_bytes
from workers.geometry.frames import pose, rotation_about


def read_model(path: Path, root: Path, limits: MeshLimits) -> tuple[Source, Model]:
    """What a URDF, SDF or MJCF poses; MeshError as `Source.parse`, `no_faces` where nothing of it is seen."""
    source = Source(path, root, limits)
    model = POSED[path.suffix.lower()](source)
    check_nodes(path, len(model.visuals), "visuals", limits)
    if not model.visuals:
        raise MeshError("no_faces", f"{path} has no visual geometry")
    return source, model


def list_seen(path: Path, root: Path, limits: MeshLimits) -> tuple[list[Path], list[Path]]:
    """The meshes of all that is seen, each once, and what else is read that is there, such as pictures.

    MeshError where a mesh is not inside `root`.
    """
    source, model = read_model(path, root, limits)
    names = dict.fromkeys(visual.mesh for visual in model.visuals if visual.mesh is not None)
    pictures = dict.fromkeys(visual.texture for visual in model.visuals if visual.texture is not None)
    collide = [one.mesh for one in model.collisions() if one.mesh] if any(map(_is_gltf, model.visuals)) else []
    return list(dict.fromkeys(map(source.demand, names))), [*source.files, *source.find_all([*pictures, *collide])]


def list_named(path: Path, root: Path, limits: MeshLimits) -> list[Path]:
    """The meshes of all that is seen or collides, of those inside `root`, and the files that it includes."""
    source = Source(path, root, limits)
    return [*source.find_all(POSED[path.suffix.lower()](source).meshes), *source.files]


def load_posed(path: Path, limits: MeshLimits, root: Path) -> LoadedMesh:
    """All that is seen, joints at zero, in the frame of the first root, metres; MeshError as `load_shape`."""
    source, model = read_model(path, root, limits)
    parts, vertices, faces = list[Part](), 0, 0

    @cache
    def load(name: str) -> LoadedMesh:
        return load_shape(source.demand(name), limits, root, source.budget)

    def shown(visual: Visual) -> LoadedMesh:
        return load(visual.mesh or "") if visual.body is None else LoadedMesh(Shape((visual.body,)), ())

    for visual in _with_turned_gltf(model, shown):
        loaded = shown(visual)
        source.notes += [note for note in loaded.notes if not (visual.dresses == "all" and note.endswith(UNPAINTED))]
        shape = loaded.shape
        if visual.by_side or (visual.body is not None and visual.texture is not None):
            shape = Shape(tuple(wrap_body(part, visual.by_side) for part in shape.parts))
        for part in transform_shape(shape, visual.T).parts:
            check_coordinates(path, part.vertices)
            dressed = with_jpeg(_faded(_dressed(part, visual, source), visual.opacity), source)
            parts.append(replace(dressed, name=f"part{len(parts)}"))
            vertices, faces = vertices + len(part.vertices), faces + len(part.faces)
        check_nodes(path, len(parts), "parts", limits)
        check_counts(path, vertices, faces, limits)
    return LoadedMesh(Shape(tuple(parts)), tuple(dict.fromkeys(source.notes)))


def _is_gltf(visual: Visual) -> bool:
    return visual.mesh is not None and visual.mesh.lower().endswith((".glb", ".gltf"))


def _with_turned_gltf(model: Model, shown: Callable[[Visual], LoadedMesh]) -> Sequence[Visual]:
    """What is seen, a glTF with its axes taken to those of what poses it: y up to z, or as they are.

    Programs differ, so that is taken which brings what is seen nearer to what collides, by their boxes; where nothing else than
    glTF collides, what `Model.turns` says.
    """
    if not any(map(_is_gltf, model.visuals)):
        return model.visuals
    up = pose(rotation_about(np.array([1.0, 0.0, 0.0]), 0.5 * np.pi), np.zeros(3))
    turned = [replace(one, T=one.T @ up) if _is_gltf(one) else one for one in model.visuals]
    ways = [turned, model.visuals] if model.turns else [model.visuals, turned]

    def box(visuals: Sequence[Visual]) -> Array:
        bounds = np.array([transform_shape(shown(visual).shape, visual.T).bounds for visual in visuals])
        return np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])

    if others := [one for one in model.collisions() if not _is_gltf(one)]:
        with suppress(MeshError):
            collides = box(others)
            return min(ways, key=lambda way: float(np.abs(box(way) - collides).sum()))
    return ways[0]


def _dressed(part: Part, visual: Visual, source: Source) -> Part:
    """The part in the colour and picture that the file gives it."""
    is_plain = part.material.texture is None and part.colors is None
    replaced = {"all": True, "plain": is_plain, "bare": is_plain and part.material is DEFAULT}[visual.dresses]
    if not replaced or (visual.colour is None and visual.texture is None):
        return part
    texture = None if visual.texture is None else source.picture(visual.texture)
    if texture is not None and part.uv is None:
        source.notes.append(f"{visual.texture:.200} needs texture coordinates, which the mesh has not: {UNPAINTED}")
        texture = None
    if visual.colour is None and texture is None:
        return part
    red, green, blue, alpha = (1.0, 1.0, 1.0, 1.0) if visual.colour is None else visual.colour.tolist()
    return replace(part, material=Material((red, green, blue, alpha or 1.0), texture=texture), colors=None)


def _faded(part: Part, opacity: float) -> Part:
    """The part with its alpha times that."""
    if opacity == 1.0:
        return part
    red, green, blue, alpha = part.material.base_color
    return replace(part, material=replace(part.material, base_color=(red, green, blue, alpha * opacity)))


def read_urdf(source: Source) -> Model:
    """The visuals of all links of a URDF, joints at zero; the frame of the first root link."""
    path, robot = source.path, source.parse(source.path, ["robot"], "a URDF")
    looks = {m.get("name", ""): _look(path, m) for m in robot.iterfind("material")}
    links, visuals = _link_poses(path, robot), list[Visual]()

    def read(element: ElementTree.Element, T_root_link: Pose) -> Visual | None:
        return read_geometry(path, element, T_root_link @ _origin(path, element), ElementTree.Element.get, "filename")

    def collisions() -> list[Visual]:
        found = list[Visual]()
        for link, T_root_link in links:
            for element in link.iterfind("collision"):
                with suppress(MeshError):
                    collides = read(element, T_root_link)
                    found += [] if collides is None else [collides]
        return found

    for link, T_root_link in links:
        for visual in link.iterfind("visual"):
            material = visual.find("material")
            look = (None, None) if material is None else _look(path, material)
            if material is not None and look[0] is None and look[1] is None:
                look = looks.get(material.get("name", ""), look)
            shown = read(visual, T_root_link)
            if visual.find("geometry/*") is None:
                raise MeshError("unreadable", f"{path} has a visual without geometry")
            if shown is not None:
                visuals.append(replace(shown, colour=look[0], texture=look[1]))
    names = (mesh.get("filename", "") for mesh in robot.iterfind("link/*/geometry/mesh"))
    return Model(tuple(visuals), tuple(dict.fromkeys(names)), collisions, turns=True)


def _look(path: Path, material: ElementTree.Element) -> tuple[Array | None, str | None]:
    colour, texture = material.find("color"), material.find("texture")
    rgba = None if colour is None else np.clip(numbers(path, colour.get("rgba"), 4), 0.0, 1.0)
    return rgba, None if texture is None else texture.get("filename")


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
        for _ in range(MOST_ABOVE + 1):
            if name not in joints:
                break
            name, step = joints[name]
            T = step @ T
        else:
            above = f"{path}: the joints above link {link.get('name')!r:.80}"
            raise MeshError("unreadable", f"{above} go round in a circle, or are more than {MOST_ABOVE}")
        placed.append((link, T))
    return placed


def _origin(path: Path, element: ElementTree.Element) -> Pose:
    """[4, 4] of an <origin>."""
    origin = element.find("origin")
    return np.eye(4) if origin is None else turned(path, origin.get("xyz", "0 0 0"), origin.get("rpy", "0 0 0"))


_NOT_READ = {
    **dict.fromkeys(("world", "include"), "init its models' own files"),
    **dict.fromkeys(("visual//submesh", "visual//heightmap"), "export it as one mesh"),
}
"""What an SDF may have and is not read, by its path, with the remedy."""


def read_sdf(source: Source) -> Model:
    """The visuals of all links of an SDF's model, joints at zero."""
    path, root = source.path, source.parse(source.path, ["sdf"], "an SDF")
    for tag, remedy in _NOT_READ.items():
        if root.find(f".//{tag}") is not None:
            what = "is a world, and no object" if tag == "world" else f"has <{tag.split('/')[-1]}>, which is not read"
            raise MeshError("format", f"{path} {what}: {remedy}")
    visuals = [visual for model in root.iterfind("model") for visual in _of_model(source, model, np.eye(4), 0)]

    def collisions() -> list[Visual]:
        found = list[Visual]()
        with suppress(MeshError):
            for model in root.iterfind("model"):
                found += _of_model(source, model, np.eye(4), 0, "collision")
        return found

    names = dict.fromkeys((mesh.findtext("uri") or "").strip() for mesh in root.iterfind(".//geometry/mesh"))
    turns = any(name.startswith("package://") for name in names)  # Drake's; Gazebo has model://, and bare names
    return Model(tuple(visuals), tuple(names), collisions, turns)


def _of_model(
    source: Source, model: ElementTree.Element, T_above: Pose, depth: int, kind: str = "visual"
) -> Iterator[Visual]:
    path = source.path
    if depth > MOST_ABOVE:
        raise MeshError("unreadable", f"{path} has more than {MOST_ABOVE} models inside one another")
    T = T_above @ _sdf_pose(path, model)
    for link in model.iterfind("link"):
        for visual in link.iterfind(kind):
            T_visual = T @ _sdf_pose(path, link) @ _sdf_pose(path, visual)
            shown = read_geometry(path, visual, T_visual, ElementTree.Element.findtext, "uri")
            if shown is not None and (worn := _worn(source, visual, shown)).opacity > 0.0:
                yield worn
    for inner in model.iterfind("model"):
        yield from _of_model(source, inner, T, depth + 1, kind)


def _worn(source: Source, visual: ElementTree.Element, shown: Visual) -> Visual:
    """What a visual shows in the look that it states, as Gazebo has it: a script's, and over its colour the one of `diffuse`."""
    colour = _colour(source.path, visual.findtext("material/diffuse"))
    albedo = visual.findtext("material/pbr/metal/albedo_map")
    script, look = visual.find("material/script"), None
    if script is not None and (look := _read_script(source, script)) is None and colour is None:
        name = (script.findtext("name") or "").strip()
        source.notes.append(f"the material script {name:.80} is not had, or has no colour: {UNPAINTED}")
    scripted, picture = look or (None, None)
    hidden = float(numbers(source.path, visual.findtext("transparency") or "0", 1)[0])
    return replace(
        shown,
        colour=scripted if colour is None else colour,
        texture=picture or (albedo and albedo.strip()),
        dresses="all" if look or albedo else "plain",
        opacity=1.0 - min(max(hidden, 0.0), 1.0),
    )


def _colour(path: Path, text: str | None) -> Array | None:
    """[4] of three numbers or four, the last alpha, in [0, 1]; None of no text. MeshError `unreadable`."""
    return None if text is None else np.clip([*numbers(path, text, len(text.split())), 1.0][:4], 0.0, 1.0)


_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_DIFFUSE = re.compile(r"(?:^|{)\s*diffuse((?:\s+(?:\d+\.?\d*|\.\d+)){3,4})\s*(?:}|$)", re.MULTILINE)
_TEXTURE = re.compile(r"(?:^|{)\s*texture\s+(\S+)", re.MULTILINE)


_GAZEBO: Mapping[str, tuple[float, float, float]] = {
    "Grey": (0.7, 0.7, 0.7),
    "DarkGrey": (0.175, 0.175, 0.175),
    "White": (1.0, 1.0, 1.0),
    "FlatBlack": (0.1, 0.1, 0.1),
    "Black": (0.0, 0.0, 0.0),
    "Red": (1.0, 0.0, 0.0),
    "RedBright": (0.87, 0.26, 0.07),
    "Green": (0.0, 1.0, 0.0),
    "Blue": (0.0, 0.0, 1.0),
    "SkyBlue": (0.13, 0.44, 0.7),
    "Yellow": (1.0, 1.0, 0.0),
    "ZincYellow": (0.9725, 0.9529, 0.2078),
    "Purple": (1.0, 0.0, 1.0),
    "Turquoise": (0.0, 1.0, 1.0),
    "Orange": (1.0, 0.5088, 0.0468),
    "Gold": (0.8, 0.64869, 0.120759),
}
"""Colours of the materials that come with Gazebo, which models name and do not bring along: diffuse, and of SkyBlue ambient."""


def _read_script(source: Source, script: ElementTree.Element) -> tuple[Array | None, str | None] | None:
    """Colour and picture of the Ogre material that a visual names, first pass first; None where it is not had.

    After the manual of Ogre 1.9, "Material Scripts"; what a material has of another (`:`) is not read.
    """
    name = (script.findtext("name") or "").strip()
    places = [place for uri in script.iterfind("uri") for place in source.places(uri.text or "")]
    listed = [file for place in places for file in (sorted(place.glob("*.material")) if place.is_dir() else [place])]
    for file in dict.fromkeys(path for place in listed if (path := find_inside(source.root, place)) is not None):
        text = _COMMENT.sub("", as_utf8(read_bytes(file, MAX_XML_BYTES, MeshError))[0].decode("utf-8", "replace"))
        head = re.search(
            rf"^\s*material\s+\"?{re.escape(name)}\"?\s*(?::[^{{]*)?{{(?P<rest>.*)", text, re.MULTILINE | re.DOTALL
        )
        if head is None:
            continue
        source.files[file] = None
        inside = re.split(r"^\s*material\s", head["rest"], maxsplit=1, flags=re.MULTILINE)[0]
        diffuse, picture = _DIFFUSE.search(inside), _TEXTURE.search(inside)
        if diffuse is not None or picture is not None:
            colour = _colour(file, diffuse and diffuse[1])
            if picture is None:
                return colour, None
            near = [folder / picture[1] for folder in (*places, file.parent, file.parent.with_name("textures"))]
            there = find_inside(source.root, *near)
            return colour, picture[1] if there is None else relpath(there, source.path.parent)
    if name.startswith("Gazebo/") and (known := _GAZEBO.get(name.removeprefix("Gazebo/"))):
        return np.array([*known, 1.0]), None
    return None


def _sdf_pose(path: Path, element: ElementTree.Element) -> Pose:
    """[4, 4] of a <pose>: a shift, then roll, pitch and yaw about fixed axes."""
    stated = element.find("pose")
    if stated is None or not (stated.text or "").strip():
        return np.eye(4)
    if (
        stated.get("relative_to", "__model__") not in ("", "__model__")
        or stated.get("rotation_format", "euler_rpy") != "euler_rpy"
    ):
        raise MeshError("format", f"{path} has poses relative to other frames, or as quaternions, which are not read")
    values = (stated.text or "").split()
    return turned(
        path, " ".join(values[:3]), " ".join(values[3:]), np.pi / 180 if stated.get("degrees") == "true" else 1.0
    )


POSED: Mapping[str, Callable[[Source], Model]] = {".urdf": read_urdf, ".xml": read_mjcf, ".sdf": read_sdf}
"""The formats of files that pose meshes, by suffix."""
