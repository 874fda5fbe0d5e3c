"""Edge: reads OBJ files from outside and the MTL files that they name.

A reader of its own, because the library at hand (trimesh) cuts polygons as fans, darkens what states no colour, and takes one
material file of several. Faces are grouped by the form of their lines ("a/b a/b a/b"), so that each group is read as one array.
The statements are those of Wavefront's appendix B1 and of the MTL format, with what other programs add: vertex colours behind
coordinates, and `Pm`, `Pr` of the physically based extension.
"""

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import MeshError
from schemas.scene.shape import Material
from workers.door.meshes.raw import (
    COMMAS,
    DEFAULT,
    WHITE,
    FolderResolver,
    Indices,
    MeshVisual,
    RawMesh,
    check_indices,
    cut_polygons,
    index_corners,
    make_material,
    roughness_of,
)
from workers.door.opening import as_utf8

_LIBRARY = re.compile(r"^[ \t]*mtllib[ \t]+(.+?)[ \t]*$", re.MULTILINE)
_DIGITS = str.maketrans("", "", "0123456789-+")
_SPACES = str.maketrans("/|", "  ")
_LONE_SLASHES = re.compile(r"/+(?= |$)")
_OPTIONS = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}
"""Options before a picture's name with more than one value, and at most how many; others have one."""
_NOT_DRAWN = (
    "bump",
    "map_bump",
    "norm",
    "map_kn",
    "disp",
    "map_disp",
    "decal",
    "refl",
    "map_ks",
    "map_ke",
    "map_pm",
    "map_pr",
)
"""Pictures of a material that change its look a little."""


def named_by_obj(path: Path, data: bytes) -> list[str]:
    """Names of the material files that an OBJ file asks for, and of the one beside it that has its name."""
    names = [name for words in _LIBRARY.findall(_decode(data)) for name in _library_names(words)]
    return [*names, f"{path.stem}.mtl"] if names else []


def named_by_mtl(data: bytes) -> list[str]:
    """Names of the pictures of colour and opacity that a material file asks for."""
    lines = (line.split(None, 1) for line in _decode(data).split("\n"))
    wanted = ("map_kd", "map_d", "map_ka")
    return [_picture_name(words[1])[0] for words in lines if len(words) == 2 and words[0].lower() in wanted]


def count_obj(data: bytes) -> tuple[int, int]:
    """Vertices and faces of an OBJ file, found without parsing it."""
    return data.count(b"\nv "), data.count(b"\nf ")


def read_obj(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """One mesh for each material, in the order of their first faces. Polygons are cut by ear clipping.

    What is missing or not drawn leaves a note. Raises MeshError `index_out_of_range` or `unreadable`.
    """
    lines = _Lines(path)
    lines.read(_decode(data))
    points, colors = lines.points(resolver)
    uv, normals = lines.columns("vt", 2), lines.columns("vn", 3)
    materials = _read_libraries(path, lines.libraries, resolver)
    if not lines.libraries and len(uv) and (picture := resolver.picture_beside()) is not None:
        resolver.notes.append(
            f"no material file is named: {picture} beside it was not used; write `mtllib` and an .mtl"
        )
    by_material: dict[str | None, list[_Run]] = {}
    for run in lines.runs:
        if run.faces:
            by_material.setdefault(run.material, []).append(run)
    if list(by_material) == [None] and len(materials) == 1:
        by_material = dict.fromkeys(materials, by_material[None])  # the only material, which no line uses by name
    made = []
    for name, runs in by_material.items():
        if cut := [_cut(path, points, polygons) for polygons in _polygons(path, runs)]:
            made.append(_mesh(path, np.concatenate(cut), (points, uv, normals), colors, materials.get(name or "")))
    return made


def _decode(data: bytes) -> str:
    """The text with line ends of one kind, and lines joined that end in a backslash."""
    text = data.decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
    return text.replace("\\\n", " ") if "\\\n" in text else text


@dataclass
class _Run:
    """Face lines with one material, and how many points, coordinates of pictures and normals stand before them."""

    material: str | None
    before: tuple[int, int, int]
    faces: list[str] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    """Which line of the file each is: faces keep their order."""


class _Lines:
    """The statements of a file, by kind."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.values: dict[str, list[str]] = {"v": [], "vt": [], "vn": []}
        self.libraries: list[str] = []
        self.runs = [_Run(None, (0, 0, 0))]

    def read(self, text: str) -> None:
        values, v, vt, vn = self.values, *self.values.values()
        run, material, stale = self.runs[0], None, False
        for number, line in enumerate(text.split("\n")):
            word, _, rest = line.strip().partition(" ") if "\t" not in line else _partition(line)
            if word == "f":
                if stale:
                    run = _Run(material, (len(v), len(vt), len(vn)))
                    self.runs.append(run)
                    stale = False
                run.faces.append(rest)
                run.numbers.append(number)
            elif word in values:
                values[word].append(rest)
                stale = True
            elif word == "usemtl":
                material, stale = rest.partition("#")[0].strip(), True
            elif word == "mtllib":
                self.libraries.append(rest.strip())

    def points(self, resolver: FolderResolver) -> tuple[Array, NDArray[np.uint8] | None]:
        """[V, 3], and [V, 4] uint8 sRGB colours where every vertex has one: `v x y z r g b`, in [0, 1] or up to 255."""
        table = self.columns("v", None)
        if table.shape[1] < 3:
            raise MeshError("unreadable", f"{self.path} has a vertex of {table.shape[1]} numbers")
        if any("," in line for line in self.values["v"][:1]):
            resolver.notes.append(COMMAS)
        colors = table[:, 3:6] if table.shape[1] == 6 else table[:, 4:7] if table.shape[1] == 7 else None
        if table.shape[1] == 7 and not (table[:, 3] == 1.0).all():
            colors = table[:, 3:6]  # r g b a; else x y z w r g b
        if colors is None or not np.isfinite(colors).all():
            return table[:, :3], None
        scale = 1.0 if colors.max(initial=0.0) > 1.0 else 255.0
        rgb = np.clip(np.round(scale * colors), 0, 255).astype(np.uint8)
        return table[:, :3], np.column_stack([rgb, np.full(len(rgb), 255, np.uint8)])

    def columns(self, kind: str, width: int | None) -> Array:
        """[N, width] float64 of the lines of a kind; of `width` None as many as the lines have, missing ones NaN."""
        lines = self.values[kind]
        if not lines:
            return np.zeros((0, width or 3))
        if any("#" in line for line in lines):
            lines = [line.partition("#")[0] for line in lines]
        if "," in lines[0]:
            lines = [line.replace(",", ".") for line in lines]
        counts = {len(line.split()) for line in (lines[0], lines[-1])}
        try:
            table = np.fromstring(" ".join(lines), sep=" ", dtype=np.float64)
            if len(counts) == 1 and len(table) == len(lines) * min(counts):
                table = table.reshape(len(lines), -1)
            else:
                rows = [[float(word) for word in line.split()] for line in lines]
                widest = max(map(len, rows))
                table = np.array([row + [np.nan] * (widest - len(row)) for row in rows])
        except (ValueError, DeprecationWarning) as error:
            raise MeshError(
                "unreadable", f"{self.path} has a line {kind} that is not numbers ({error!s:.80})"
            ) from error
        if width is None or table.shape[1] == width:
            return table
        short = np.zeros((len(table), width))
        short[:, : table.shape[1]] = table[:, :width]
        return short


def _partition(line: str) -> tuple[str, str, str]:
    words = line.split(None, 1)
    return (words[0] if words else "", " ", words[1].rstrip() if len(words) == 2 else "")


def _polygons(path: Path, runs: list[_Run]) -> Iterator[Indices]:
    """Faces with equally many corners: [F, n, 4] of points, coordinates of pictures, normals (-1: none), and line numbers."""
    groups: dict[str, tuple[list[str], list[int], list[tuple[int, int, int]]]] = {}
    for run in runs:
        for line, number in zip(run.faces, run.numbers, strict=True):
            if "#" in line:
                line = line.partition("#")[0]
            line = " ".join(line.split())
            if line[-1:] == "/" or "/ " in line:
                line = _LONE_SLASHES.sub("", line)
            line = line.replace("//", "|")
            form = line.translate(_DIGITS)
            texts, numbers, before = groups.setdefault(form, ([], [], []))
            texts.append(line)
            numbers.append(number)
            before.append(run.before)
    for form, (texts, numbers, before) in groups.items():
        corners = [corner.replace("|", "//").split("/") for corner in texts[0].split(" ")]
        if len(corners) < 3:
            continue  # a face of one or two corners is none
        if set(form) - set(" /|") or max(map(len, corners)) > 3:
            raise MeshError("unreadable", f"{path} has a face {texts[0]!r:.60} that is not numbers")
        read = np.fromstring(" ".join(texts).translate(_SPACES), sep=" ", dtype=np.int64)
        columns = [(k, kind) for k, corner in enumerate(corners) for kind, word in enumerate(corner) if word]
        if len(read) != len(texts) * len(columns):
            raise MeshError("unreadable", f"{path} has a face like {texts[0]!r:.60}, not {len(columns)} numbers")
        faces = np.full((len(texts), len(corners), 4), -1)
        counts = np.array(before)
        for (corner, kind), values in zip(columns, read.reshape(len(texts), -1).T, strict=True):
            if (values == 0).any():
                raise MeshError("index_out_of_range", f"{path}: a face names number 0, and numbers begin at 1")
            faces[:, corner, kind] = np.where(values > 0, values - 1, counts[:, kind] + values)
        faces[:, :, 3] = np.array(numbers)[:, None]
        yield faces


def _cut(path: Path, points: Array, faces: Indices) -> Indices:
    """[T, 3, 4]: polygons [F, n, 4] as triangles."""
    check_indices(path, faces[:, :, 0], len(points))
    triangles = cut_polygons(points[faces[:, :, 0]])
    return faces[np.arange(len(faces))[:, None, None], triangles].reshape(-1, 3, 4)


def _mesh(
    path: Path,
    corners: Indices,
    values: tuple[Array, Array, Array],
    colors: NDArray[np.uint8] | None,
    material: Material | None,
) -> RawMesh:
    """The mesh of triangles [T, 3, 4]: a vertex for each combination of point, coordinate and normal, in the file's order."""
    points, uv, normals = values
    corners = corners[np.argsort(corners[:, 0, 3], kind="stable"), :, :3]
    # Some programs number coordinates that they do not write.
    textured = bool((corners[..., 1] >= 0).all()) and len(uv) > 0
    shaded = bool((corners[..., 2] >= 0).all()) and len(normals) > 0
    for used, kind, listed in ((textured, 1, uv), (shaded, 2, normals)):
        if used and corners[..., kind].max() >= len(listed):
            raise MeshError(
                "index_out_of_range", f"{path}: a face names number {corners[..., kind].max() + 1} of {len(listed)}"
            )
    shown = [0, *([1] if textured else []), *([2] if shaded else [])]
    vertices, faces = index_corners(corners[..., shown], [len(values[k]) for k in shown])
    coordinates = uv[vertices[:, 1]] if textured else None
    if coordinates is not None and not np.isfinite(coordinates).all():
        coordinates = None
    if material is not None and coordinates is None:
        material = replace(material, texture=None)
    visual = MeshVisual(material or DEFAULT, coordinates)
    if colors is not None and visual.material.texture is None:
        visual = MeshVisual(WHITE, coordinates, colors[vertices[:, 0]])
    return RawMesh(points[vertices[:, 0]], faces, normals[vertices[:, -1]] if shaded else None, visual, np.eye(4))


# ---------------------------------------------------------------------------------------------- materials


def _library_names(words: str) -> list[str]:
    """The material files of a line: one name, which may have spaces, or several that each end in .mtl."""
    several = re.split(r"(?<=\.mtl)\s+", words, flags=re.IGNORECASE)
    return [name.strip().strip('"') for name in several if name.strip()]


def _read_libraries(path: Path, lines: Iterable[str], resolver: FolderResolver) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    for name in dict.fromkeys(name for words in lines for name in _library_names(words)):
        beside = f"{path.stem}.mtl"
        with suppress(FileNotFoundError):
            if resolver.find(name) is None and resolver.find(beside) is not None:
                resolver.notes.append(f"{name} is missing: {beside} was read in its place")
                name = beside
            data, encoding = as_utf8(resolver.read(name))
            if encoding is not None:
                resolver.notes.append(f"{name} {encoding}")
            materials = _read_mtl(_decode(data), resolver) | materials
    return materials


def _read_mtl(text: str, resolver: FolderResolver) -> dict[str, Material]:
    """The materials of a file by name; the last statement of a kind counts."""
    materials: dict[str, dict[str, str]] = {}
    statements: dict[str, str] = {}
    for line in text.split("\n"):
        word, _, rest = _partition(line)
        if word.lower() == "newmtl":
            statements = materials.setdefault(rest, {})
        elif word and not word.startswith("#"):
            statements[word.lower()] = rest
    return {name: _material(stated, resolver) for name, stated in materials.items()}


def _material(stated: dict[str, str], resolver: FolderResolver) -> Material:
    """A material of its statements. Without a colour it is the neutral grey, or its picture as it is."""
    picture = _picture(stated.get("map_kd") or stated.get("map_ka"), resolver)
    opacity = _picture(stated.get("map_d"), resolver) if picture is not None else None
    if picture is not None and opacity is not None and opacity.shape[:2] == picture.shape[:2]:
        picture = np.dstack([picture[..., :3], opacity[..., -1] if opacity.shape[2] == 4 else opacity[..., 0]])
        picture.setflags(write=False)
    emitted, given = _numbers(stated.get("ke")), _numbers(stated.get("kd"))
    rgb = given if given is not None else np.ones(3) if "map_kd" in stated else np.array(DEFAULT.base_color[:3])
    if picture is not None and rgb.min() == rgb.max() < 1.0:
        # Blender writes 0.8 and 3ds Max 0.588 beside every picture, and neither darkens the picture by it.
        resolver.notes.append(f"a grey Kd of {rgb[0]:.3g} beside a picture was not used")
        rgb = np.ones(3)
    if emitted is not None and emitted.max() > 0.0 and rgb.max() == 0.0 and picture is None:
        rgb = emitted
        resolver.notes.append("a colour of light (Ke) was drawn as a plain colour")
    alpha, metallic = _numbers(stated.get("d")), _numbers(stated.get("pm"))
    shine, rough = _numbers(stated.get("ns")), _numbers(stated.get("pr"))
    roughness = float(rough[0]) if rough is not None else roughness_of(None if shine is None else float(shine[0]))
    # `Tr` is ignored, because half of the exporters write it inverted.
    color = np.append(rgb, 1.0 if alpha is None else alpha[0])
    metal = 0.0 if metallic is None else float(metallic[0])
    left_out = [name for name in _NOT_DRAWN if name in stated]
    return make_material(color, metal, roughness, picture, resolver.notes, left_out)


def _picture(words: str | None, resolver: FolderResolver) -> NDArray[np.uint8] | None:
    """The picture that a statement names, with a note on options that are not followed; None with a note where it is not had."""
    if not words:
        return None
    name, options = _picture_name(words)
    if "<UDIM>" in name:
        resolver.note(name, "is a set of pictures (UDIM), of which none is read: bake it into one")
        return None
    if options:
        resolver.notes.append(f"{name}: ignored {' '.join(options)}")
    return resolver.picture(name)


_PLAIN_OPTIONS = {"-s": {1.0}, "-o": {0.0}, "-t": {0.0}}
"""Values of options that change nothing."""


def _picture_name(words: str) -> tuple[str, list[str]]:
    """The name in a statement such as `-s 2 2 1 -clamp on wood.png`, and the options before it that would change the look."""
    rest, options = words.strip(), []
    while rest.startswith("-") and " " in rest:
        option, _, rest = rest.partition(" ")
        values: list[str] = []
        most = _OPTIONS.get(option.lower(), 1)
        while len(values) < most and " " in rest.lstrip():
            value, _, after = rest.lstrip().partition(" ")
            if option.lower() in _OPTIONS and _numbers(value) is None:
                break
            values.append(value)
            rest = after
        numbers = {float(value) for value in values if _numbers(value) is not None}
        if option.lower() != "-clamp" and numbers != _PLAIN_OPTIONS.get(option.lower(), set()):
            options.append(" ".join([option, *values]))
        rest = rest.lstrip()
    return rest.strip().strip('"'), options


def _numbers(words: str | None) -> Array | None:
    """The numbers of a statement, three of one; None where it has none."""
    try:
        values = [float(word) for word in (words or "").partition("#")[0].split()]
    except ValueError:
        return None
    if not values:
        return None
    return np.array(values[:3] if len(values) >= 3 else [values[0]] * 3)
