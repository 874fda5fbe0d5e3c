"""Edge: reads COLLADA files (.dae) of versions 1.4 and 1.5 from outside.

A reader of its own, because none of the libraries fits: pycollada drops a shape whose picture or material is missing, holes in
polygons and what repeats a picture, and trimesh on top of it leaves out the unit, the binding of coordinates to pictures, and
controllers, without a word. Whatever a file states is obeyed or named: a primitive in `_corners`, a transform in
`_TRANSFORMS`, a property of a surface in `_Effect`. Axes stay those of the file: in a URDF they are meant so, as RViz has it,
and `find_up` tells which one is up.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import reduce
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.errors import MeshError
from schemas.job.assets import UpAxis
from schemas.scene.shape import Material
from workers.door.meshes.posed import MOST_ABOVE, parse_tree
from workers.door.meshes.raw import (
    COMMAS,
    DEFAULT,
    WHITE,
    FolderResolver,
    Indices,
    MeshVisual,
    RawMesh,
    check_counts,
    check_indices,
    check_nodes,
    cut_faces,
    cut_strip,
    index_corners,
    make_material,
    roughness_of,
)
from workers.geometry.frames import pose, rotation_about

_COMMA_UNIT, _COMMA = re.compile(rb"<unit[^>]*\smeter\s*=\s*[\"']\d*,\d"), re.compile(rb"(?<=\d),(?=\d)")
"""Of programs that write numbers as their country does."""
_UP = re.compile(rb"<up_axis>\s*([XYZ])_UP")
_AXES: Mapping[bytes, UpAxis] = {b"X": "x", b"Y": "y", b"Z": "z"}
_READ = ("POSITION", "TEXCOORD", "NORMAL", "COLOR")
_NO_FACES = ("lines", "linestrips")
_NOT_SHAPE = ("instance_camera", "instance_light", "asset", "evaluate_scene", "extra")


def find_up(head: bytes) -> UpAxis:
    """The axis that is up in a file that begins so; y where it states none, as the format has it."""
    stated = _UP.search(head)
    return _AXES[stated[1]] if stated else "y"


def named_by_dae(path: Path, data: bytes) -> list[str]:
    """Names of the pictures in a COLLADA file; MeshError `unreadable`."""
    images = parse_tree(path, data, ["COLLADA"], "a COLLADA file").iter("image")
    return list(dict.fromkeys(filter(None, map(_image_name, images))))


def read_dae(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """Every mesh of the file's scene at the pose of each of its nodes, metres, in the file's own axes.

    What is missing or not drawn leaves a note. MeshError `format` where something changes the shape and is not read,
    `index_out_of_range`, `too_large` or `unreadable`.
    """
    if _COMMA_UNIT.search(data):
        data = _COMMA.sub(b".", data)
        resolver.notes.append(COMMAS)
    return list(_File(path, parse_tree(path, data, ["COLLADA"], "a COLLADA file"), resolver).meshes())


class _File:
    """A file: its elements by id, and what was made of its effects."""

    def __init__(self, path: Path, root: Element, resolver: FolderResolver) -> None:
        self.path, self.root, self.resolver = path, root, resolver
        self.ids = _by_id(root)
        self.looks: dict[str, tuple[Material, str]] = {}
        self.copies = 0

    def meshes(self) -> Iterator[RawMesh]:
        """What the nodes of the scene show, in their order."""
        unit = self.root.find("asset/unit")
        metres = pose(np.eye(3) * (1.0 if unit is None else float(unit.get("meter", "1"))), np.zeros(3))
        shown = self.root.find("scene/instance_visual_scene")
        scene = self.root.find("library_visual_scenes/visual_scene") if shown is None else self.find(shown.get("url"))
        if scene is None:
            raise MeshError("no_faces", f"{self.path} has no scene")
        parts = vertices = faces = 0
        for instance, above in self._instances(scene, ()):
            matrix = reduce(np.matmul, (self._transform(step) for step in above), metres)
            for mesh in self._geometry(instance, matrix):
                parts, vertices, faces = parts + 1, vertices + len(mesh.vertices), faces + len(mesh.faces)
                check_nodes(self.path, parts, "parts", self.resolver.limits)
                check_counts(self.path, vertices, faces, self.resolver.limits)
                yield mesh

    def find(self, url: str | None) -> Element:
        """The element of a reference; MeshError `format` where it is in another file or is missing."""
        if not (url or "").startswith("#") or (url or "")[1:] not in self.ids:
            raise MeshError("format", f"{self.path} refers to {url!r:.80}, which is not in it: export it as one file")
        return self.ids[(url or "")[1:]]

    def _instances(self, node: Element, above: tuple[Element, ...]) -> Iterator[tuple[Element, tuple[Element, ...]]]:
        """The instances of geometry in a node and below it, each with the transforms above it."""
        if len(above) > MOST_ABOVE:
            raise MeshError("unreadable", f"{self.path} has more than {MOST_ABOVE} transforms above one shape")
        within = (*above, *(child for child in node if child.tag not in ("node", *_NOT_SHAPE) and not _refers(child)))
        for child in node:
            if child.tag == "node":
                yield from self._instances(child, within)
            elif child.tag == "instance_node":
                self.copies += 1
                check_nodes(self.path, self.copies, "instances of nodes", self.resolver.limits)
                yield from self._instances(self.find(child.get("url")), within)
            elif _refers(child) and child.tag not in _NOT_SHAPE:
                yield child, within

    def _transform(self, step: Element) -> Pose:
        if step.tag not in _TRANSFORMS:
            raise MeshError("format", f"{self.path} has <{step.tag:.40}> above a shape, which is not read")
        count, made = _TRANSFORMS[step.tag]
        return made(_floats(step.text).reshape(count))

    def _geometry(self, instance: Element, matrix: Pose) -> Iterator[RawMesh]:
        """The primitives of an instance, each with the material that it binds to the primitive's symbol."""
        if instance.tag != "instance_geometry":
            what = "is a skin or morphs" if instance.tag == "instance_controller" else f"has <{instance.tag:.40}>"
            raise MeshError(
                "format", f"{self.path} {what}, which is not read: apply its modifiers, and export it again"
            )
        geometry = self.find(instance.get("url"))
        self.ids |= _by_id(geometry)  # some programs give the same ids to the arrays of several shapes
        mesh = geometry.find("mesh")
        if mesh is None:
            raise MeshError("format", f"{self.path} has a shape that is no mesh: export it as triangles")
        bound = {
            material.get("symbol"): material
            for material in instance.iterfind("bind_material/technique_common/instance_material")
        }
        for primitive in mesh:
            filled = primitive.find("p") is not None or primitive.find("ph") is not None
            if filled and primitive.tag not in _NO_FACES:
                yield from self._mesh(primitive, bound, matrix)

    def _mesh(self, primitive: Element, bound: Mapping[str | None, Element], matrix: Pose) -> Iterator[RawMesh]:
        inputs = self._inputs(primitive)
        width = 1 + max(offset for _, _, offset, _ in inputs)
        given = {kind: (at, values) for kind, _, at, values in reversed(inputs)}
        offset, points = given["POSITION"]
        given["POSITION"] = offset, points[:, :3]
        corners = _corners(self.path, primitive, width, *given["POSITION"])
        if not len(corners):
            return
        symbol = primitive.get("material")
        binding = bound.get(symbol)
        material, coordinates = self._look(f"#{symbol or ''}" if binding is None else str(binding.get("target")))
        at = None if binding is None else binding.find(f"bind_vertex_input[@semantic='{coordinates}']")
        sets = {number: (at, values) for kind, number, at, values in inputs if kind == "TEXCOORD"}
        wanted = int("0" if at is None else at.get("input_set", "0"))
        if wanted in sets:
            given["TEXCOORD"] = sets[wanted]
        kinds = [kind for kind in _READ if kind in given]
        columns = corners[:, :, [given[kind][0] for kind in kinds]]
        for k, kind in enumerate(kinds):
            check_indices(self.path, columns[..., k], len(given[kind][1]))
        vertices, faces = index_corners(columns, [len(given[kind][1]) for kind in kinds])
        rows = {kind: given[kind][1][vertices[:, k]] for k, kind in enumerate(kinds)}
        flat = rows["TEXCOORD"][:, :2] if "TEXCOORD" in rows else None
        flat = flat if flat is not None and np.isfinite(flat).all() else None
        if flat is None:
            material = replace(material, texture=None)
        visual = MeshVisual(material, flat)
        if "COLOR" in rows and material.texture is None:
            visual = MeshVisual(replace(WHITE, roughness=material.roughness), flat, _bytes(rows["COLOR"]))
        shaded = rows["NORMAL"][:, :3] if "NORMAL" in rows else None
        yield RawMesh(rows["POSITION"], faces, shaded, visual, matrix)

    def _inputs(self, primitive: Element) -> list[tuple[str, int, int, Array]]:
        """(what, number of its set, place in a corner, values [N, stride]) of each array that a primitive reads."""
        inputs = []
        for item in primitive.iterfind("input"):
            offset, number, source = (
                int(item.get("offset", "0")),
                int(item.get("set", "0")),
                self.find(item.get("source")),
            )
            if offset < 0:
                raise ValueError(f"an input at {offset}")
            if source.tag == "vertices":
                inputs += [(str(inner.get("semantic")), number, offset, inner) for inner in source.iterfind("input")]
            else:
                inputs.append((str(item.get("semantic")), number, offset, item))
        return [(kind, number, at, self._values(item)) for kind, number, at, item in inputs if kind in _READ]

    def _values(self, given: Element) -> Array:
        source = self.find(given.get("source"))
        accessor = source.find("technique_common/accessor")
        values = _floats(self.find(None if accessor is None else accessor.get("source")).text)
        assert accessor is not None
        stride, first = int(accessor.get("stride", "1")), int(accessor.get("offset", "0"))
        if stride < (2 if given.get("semantic") == "TEXCOORD" else 3) or first < 0:
            raise ValueError(f"an accessor with a stride of {stride}")
        return values[first : first + (len(values) - first) // stride * stride].reshape(-1, stride)

    def _look(self, target: str) -> tuple[Material, str]:
        """The material of a reference, and the name of its picture's coordinates; the neutral grey where it is missing."""
        if target not in self.looks:
            self.looks[target] = DEFAULT, ""
            effect = self.ids.get(target[1:])
            instance = None if effect is None else effect.find("instance_effect")
            profile = None if instance is None else self.ids.get(str(instance.get("url"))[1:])
            common = None if profile is None else profile.find("profile_COMMON")
            if common is not None:
                self.looks[target] = _Effect(common, self).look()
            elif target != "#":
                self.resolver.note(f"the material {target:.80}", "is missing, or has no profile_COMMON")
        return self.looks[target]


class _Effect:
    """An effect of profile_COMMON: what it says of a surface."""

    def __init__(self, common: Element, file: _File) -> None:
        self.common, self.file = common, file
        technique = common.find("technique")
        kinds = ("phong", "blinn", "lambert", "constant")
        shader = next((one for one in (technique if technique is not None else ()) if one.tag in kinds), None)
        self.given = {} if shader is None else {one.tag: one for one in shader}
        self.params = {one.get("sid"): one for one in common.iter("newparam")}

    def look(self) -> tuple[Material, str]:
        """The material, and the name of its picture's coordinates."""
        notes, diffuse = self.file.resolver.notes, self.given.get("diffuse")
        emission = self.color("emission")
        emits = self.has_picture("emission") or (emission is not None and emission[:3].max() > 0.0)
        picture, coordinates = self.picture("diffuse")
        color = np.ones(4) if picture is not None else self.color("diffuse")
        if picture is None and (color is None or color[:3].max() == 0.0) and emits:
            picture, coordinates = self.picture("emission")
            color = np.ones(4) if picture is not None or emission is None else emission
            notes.append("emission is drawn as a plain colour")
            emits = False
        if color is None:
            color = np.ones(4) if diffuse is not None else np.array(DEFAULT.base_color)
        alpha, picture = self.opacity(picture)
        shine = self.number("shininess")
        left_out = ["emission"] if emits else []
        left_out += [name for name in ("specular", "reflective") if self.has_picture(name)]
        left_out += ["bump"] if self.common.find(".//bump") is not None else []
        color = np.append(color[:3], alpha)
        return make_material(color, 0.0, roughness_of(shine), picture, notes, left_out), coordinates

    def opacity(self, picture: NDArray[np.uint8] | None) -> tuple[float, NDArray[np.uint8] | None]:
        """Alpha, and the picture with what `transparent` says of it: its own alpha means nothing otherwise."""
        given, share = self.given.get("transparent"), self.number("transparency")
        mode = "A_ONE" if given is None else given.get("opaque", "A_ONE")
        share = 1.0 if share is None else share
        mask, _ = self.picture("transparent")
        if mask is not None and picture is not None and mask.shape[:2] == picture.shape[:2]:
            rgb = mask[..., :3] @ _LUMINANCE
            seen = (mask[..., 3] if mask.shape[2] == 4 else np.full(rgb.shape, 255.0)) if mode[0] == "A" else rgb
            seen = share * seen if mode.endswith("ONE") else 255.0 - share * seen
            picture = np.dstack([picture[..., :3], np.clip(np.round(seen), 0, 255).astype(np.uint8)])
        elif picture is not None and picture.shape[2] == 4:
            picture = np.ascontiguousarray(picture[..., :3])
        if picture is not None:
            picture.setflags(write=False)
        color = self.color("transparent") if mask is None else None
        if color is None:
            return (share if given is None and "transparency" in self.given else 1.0), picture
        through = float(color[3] if mode[0] == "A" else color[:3] @ _LUMINANCE) * share
        return (through if mode.endswith("ONE") else 1.0 - through), picture

    def color(self, name: str) -> Array | None:
        """A property's colour [4]."""
        value = self._value(name, "color", "float3", "float4")
        return None if value is None else np.append(_floats(value.text)[:4], np.ones(4))[:4]

    def number(self, name: str) -> float | None:
        """A property's number."""
        value = self._value(name, "float")
        return None if value is None else float(value.text or "")

    def has_picture(self, name: str) -> bool:
        """Whether a property has a picture."""
        given = self.given.get(name)
        return given is not None and given.find("texture") is not None

    def picture(self, name: str) -> tuple[NDArray[np.uint8] | None, str]:
        """The picture of a property, None with a note where it cannot be had, and the name of its coordinates."""
        given = self.given.get(name)
        texture = None if given is None else given.find("texture")
        if texture is None:
            return None, ""
        word, image = str(texture.get("texture")), None
        for _ in range(3):  # sampler, surface, image; some exporters name the image at once
            param = self.params.get(word)
            if param is None:
                break
            inner = next((one for one in param.iter() if one.tag in ("source", "init_from", "instance_image")), None)
            word = "" if inner is None else (inner.get("url", "")[1:] or (inner.text or "").strip())
            wrap = next((one.text for one in param.iter() if one.tag in ("wrap_s", "wrap_t")), "WRAP")
            if wrap != "WRAP":
                self.file.resolver.notes.append(f"a picture that does not repeat ({wrap}) was repeated")
        image = self.file.ids.get(word)
        file_name = None if image is None or image.tag != "image" else _image_name(image)
        if file_name is None:
            self.file.resolver.note(f"the picture {word:.80}", "is not defined")
            return None, ""
        return self.file.resolver.picture(file_name), str(texture.get("texcoord"))

    def _value(self, name: str, *kinds: str) -> Element | None:
        """The element with a property's value, its own or that of the parameter that it names."""
        given = self.given.get(name)
        param = None if given is None else given.find("param")
        holder = given if param is None else self.params.get(param.get("ref"))
        return None if holder is None else next((one for one in holder if one.tag in kinds), None)


_LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
"""Of `RGB_ZERO` and `RGB_ONE` (COLLADA 1.4.1, "Determining Transparency")."""

_TRANSFORMS: Mapping[str, tuple[int, Callable[[Array], Pose]]] = {
    "matrix": (16, lambda m: m.reshape(4, 4)),
    "translate": (3, lambda t: pose(np.eye(3), t)),
    "scale": (3, lambda s: pose(np.diag(s), np.zeros(3))),
    "rotate": (
        4,
        lambda r: pose(rotation_about(r[:3] / (np.linalg.norm(r[:3]) or 1.0), np.radians(r[3])), np.zeros(3)),
    ),
}
"""How many numbers a transform has, and what they make."""


def _by_id(root: Element) -> dict[str, Element]:
    return {str(element.get("id")): element for element in root.iter() if element.get("id")}


def _refers(child: Element) -> bool:
    return child.tag.startswith("instance_")


def _floats(text: str | None) -> Array:
    return np.array((text or "").split(), dtype=np.float64)


def _bytes(colors: Array) -> NDArray[np.uint8]:
    """[V, 4] uint8 sRGB of colours [V, 3 or 4] in [0, 1]."""
    table = np.ones((len(colors), 4))
    table[:, : min(colors.shape[1], 4)] = colors[:, :4]
    return np.round(255.0 * np.clip(np.nan_to_num(table), 0.0, 1.0)).astype(np.uint8)


def _image_name(image: Element) -> str | None:
    """The name of a picture's file: of version 1.4 the text, of 1.5 the element in it."""
    named = next((e for e in image.iter() if e.tag in ("init_from", "ref") and (e.text or "").strip()), None)
    if named is None:
        return None
    return unquote(re.sub(r"^file:/*(?=\w:|/)", "", (named.text or "").strip()).removeprefix("file:"))


def _corners(path: Path, primitive: Element, width: int, offset: int, points: Array) -> Indices:
    """[T, 3, width]: the triangles of a primitive, each corner the numbers of its inputs."""
    if primitive.find("ph") is not None:
        raise MeshError("format", f"{path} has polygons with holes, which are not read: export it as triangles")
    runs = [np.array((p.text or "").split(), dtype=np.int64).reshape(-1, width) for p in primitive.iterfind("p")]
    if primitive.tag == "tristrips":
        return np.concatenate([run[cut_strip(np.arange(len(run)))] for run in runs if len(run) > 2])
    if primitive.tag == "trifans":
        fans = [(run, np.arange(1, len(run) - 1)) for run in runs if len(run) > 2]
        return np.concatenate([run[np.column_stack([0 * k, k, k + 1])] for run, k in fans])
    if primitive.tag == "triangles":
        whole = np.concatenate(runs)
        return whole[: len(whole) // 3 * 3].reshape(-1, 3, width)
    counts = np.array([len(run) for run in runs])
    if primitive.tag == "polylist":
        counts = np.array((primitive.findtext("vcount") or "").split(), dtype=np.int64)
    elif primitive.tag != "polygons":
        raise MeshError("format", f"{path} has <{primitive.tag:.40}>, which is not read: export it as triangles")
    whole = np.concatenate(runs)
    if counts.min(initial=0) < 0 or counts.sum() > len(whole):
        raise ValueError(f"polygons of {counts.sum()} corners among {len(whole)}")
    return whole[cut_faces(path, whole[:, offset], counts, points)[0]]
