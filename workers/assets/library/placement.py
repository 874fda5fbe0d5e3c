"""Pure but for a file's head: what a person asks about a mesh: its sizes, its unit, which axis points up (`find_upright`)."""

import json
import math
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.base import Array
from schemas.job.assets import UpAxis
from schemas.scene.shape import MassProperties, Mesh, Shape
from workers.assets.library.table import PLAIN
from workers.assets.samples import colors_at, draw_points
from workers.door.meshes.dae import find_up
from workers.door.meshes.raw import DEFAULT
from workers.door.opening import as_utf8
from workers.geometry.mesh import face_areas

FLAT_SHARE, ROUGH_SHARE = 0.004, 0.016
"""Shares of the diagonal within which points count as touching the ground: of smooth bottoms, and of scanned ones, which
are rumpled. A round side touches in a strip that is twice as wide in the second as in the first; a rumpled one in all."""

STANDS, ROLLS = (0.35, 0.65), (0.28, 0.58)
"""A shape stands where the centre of mass lies at least this share of the shape's half width inside its foot, for one of the
two; it rolls where both shares are smaller. What lies between is not decided."""

TIPS_DEG = 3.0
"""A shape that needs less of a lean to tip over does not stand."""

FLAT = 0.02
"""Least extent, by its diagonal, below which a shape is flat: how it stands tells nothing, because it lies."""

LIKELY_DEG = 10.0
"""A shape is likely to be upright where it stands by this much firmer than upside down, and so on no other axis."""

Verdict = Literal["stands", "rolls", "undecided"]
Confidence = Literal["sure", "likely"]

AXES: tuple[UpAxis, ...] = ("x", "y", "z")
DIRECTIONS = (*AXES, "-x", "-y", "-z")


@dataclass(frozen=True)
class Upright:
    """An axis that points up, and how far that is to be believed."""

    axis: UpAxis
    confidence: Confidence


@dataclass(frozen=True)
class Stand:
    """How a shape stands with one direction up.

    smooth, rough: of its half width, how far the centre of mass lies inside its foot, which is what lies within `FLAT_SHARE`
    or `ROUGH_SHARE` of the ground; smooth_deg, rough_deg: the lean at which it tips over the edge of that foot.
    """

    smooth: float
    rough: float
    smooth_deg: float
    rough_deg: float

    @property
    def verdict(self) -> Verdict:
        """Whether the shape stands so."""
        if self.rough_deg < TIPS_DEG or (self.smooth < ROLLS[0] and self.rough < ROLLS[1]):
            return "rolls"
        return "stands" if self.smooth >= STANDS[0] or self.rough >= STANDS[1] else "undecided"


def find_upright(hull_vertices: Array, com: Array) -> Upright | None:
    """Which axis is up; None where nothing tells.

    hull_vertices [H, 3] of the convex hull and com [3], any units, in the frame whose axes are asked about. `sure`: with
    this axis up or down the shape stands, and on both sides of the two others it rolls or tips. `likely`: it stands on
    several, and with this one up by `LIKELY_DEG` firmer than upside down, which no other is. Of an axis, the positive side
    is meant. Of what is flat (`FLAT`) nothing is told.
    """
    if measure_thinness(hull_vertices) < FLAT:
        return None
    stands = {name: measure_stand(hull_vertices, com, name) for name in DIRECTIONS}
    for axis in AXES:
        others = [stand.verdict for name, stand in stands.items() if axis not in name]
        if others == ["rolls"] * 4 and "stands" in (stands[axis].verdict, stands[f"-{axis}"].verdict):
            return Upright(axis, "sure")
    firmer = {a: stands[a].smooth_deg - stands[f"-{a}"].smooth_deg for a in AXES if stands[a].verdict != "rolls"}
    order = sorted(firmer, key=lambda axis: -firmer[axis])
    if not order or firmer[order[0]] - max((firmer[axis] for axis in order[1:]), default=0.0) < LIKELY_DEG:
        return None
    return Upright(order[0], "likely")


def measure_thinness(points: Array) -> float:
    """The least extent of points [N, 3], along their principal axes or those of their frame, by the longest diagonal."""
    centred = points - points.mean(axis=0)
    along = np.concatenate([centred, centred @ np.linalg.eigh(centred.T @ centred)[1]], axis=1)
    extents = np.ptp(along, axis=0)
    return float(extents.min() / max(np.linalg.norm(extents[:3]), np.finfo(np.float64).tiny))


def measure_stand(hull_vertices: Array, com: Array, up: str) -> Stand:
    """How the shape stands with the direction `up` upwards."""
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    height = sign * hull_vertices[:, axis]
    ground = float(height.min())
    diagonal = float(np.linalg.norm(hull_vertices.max(axis=0) - hull_vertices.min(axis=0)))
    flat = np.delete(hull_vertices, axis, axis=1)
    middle = np.delete(com, axis)
    half_width = _depth_inside(flat, middle)
    if half_width <= 0.0:
        return Stand(0.0, 0.0, 0.0, 0.0)
    inside = [
        max(_depth_inside(flat[height <= ground + share * diagonal], middle), 0.0)
        for share in (FLAT_SHARE, ROUGH_SHARE)
    ]
    leans = [math.degrees(math.atan2(depth, sign * float(com[axis]) - ground)) for depth in inside]
    return Stand(inside[0] / half_width, inside[1] / half_width, leans[0], leans[1])


LEAN_DEG, RISES = 20.0, 0.08
"""A shape rests where every lean by this much lifts its centre of mass by this share of what it would lift that of a wide box. A
can on its side rises by -0.02 to 0.01, a remote control on its rounded back by 0.25, an open laptop on its feet by 0.12."""


def rests(hull_vertices: Array, com: Array, up: UpAxis) -> bool:
    """Whether the shape, with that axis up, neither tips over nor rolls away: its centre of mass lies lowest so, all about."""
    axis = "xyz".index(up)
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    lean = math.radians(LEAN_DEG)
    directions = np.roll(
        np.stack([np.cos(around), np.sin(around), np.full(24, 1.0 / math.tan(lean))], axis=1), axis - 2, axis=1
    )
    below = com - hull_vertices
    rise = (directions @ below.T).max(axis=1).min() * math.sin(lean) - below[:, axis].max()
    half_width = _depth_inside(np.delete(hull_vertices, axis, axis=1), np.delete(com, axis))
    return bool(rise > RISES * half_width * math.sin(lean))


def _depth_inside(points: Array, point: Array) -> float:
    """How far a point [2] lies inside the convex hull of points [N, 2]; 0 where that has no area, negative outside."""
    if len(points) < 3:
        return 0.0
    try:
        sides = ConvexHull(points).equations
    except (QhullError, ValueError):
        return 0.0
    return float(-(sides[:, :2] @ point + sides[:, 2]).max())


PLACEHOLDER_PX = 2
"""Side of the grey picture that trimesh gives a mesh whose material is missing."""

SAME_GREY = 0.02
"""Red, green and blue of a grey differ by less."""


@dataclass(frozen=True)
class Measured:
    """One file: sizes along its own axes, in units of its source's `scale`; what was mended, left out or is missing.

    area, volume: of its surface, and between the surface and the middle of its bounding box, in the same units; handed: as
    `measure_handed`; textures: how many pictures its parts have; look: its colours by place, as `sample_look`, None where it has
    none; unit_m, stated_up: its unit in metres and the axis that is up, where the file says so; up, confidence: what its shape
    tells about the axis that is up, or None; rests_on_z: as `rests` of z.
    """

    extents: tuple[float, float, float]
    faces: int
    watertight: bool
    textures: int
    notes: tuple[str, ...]
    up: UpAxis | None = None
    confidence: Confidence | None = None
    area: float = 0.0
    volume: float = 0.0
    handed: float = 0.0
    look: tuple[float, ...] | None = None
    unit_m: float | None = None
    stated_up: UpAxis | None = None
    rests_on_z: bool = False

    def sure_of(self, kept: UpAxis | None) -> UpAxis | None:
        """The axis that the shape is sure of; None where it is not, or rests with z up and that is the one that is `kept`.

        An open laptop rests so, though on small feet, and stands on its side too; a remote control lies on its rounded back.
        """
        if self.confidence != "sure" or (kept == "z" and self.up != "z" and self.rests_on_z):
            return None
        return self.up


def measure_shape(
    shape: Shape, mass: MassProperties, hull_vertices: Array, notes: tuple[str, ...], path: Path
) -> Measured:
    """The measures of a shape in the frame and the units of its file at `path`; hull_vertices [H, 3] of its convex hull."""
    lower, upper = shape.bounds
    x, y, z = (float(extent) for extent in upper - lower)
    textures = [part.material.texture for part in shape.parts if part.material.texture is not None]
    fits = find_upright(hull_vertices, mass.com)
    a, b, c = (shape.vertices[shape.faces[:, k]] - 0.5 * (lower + upper) for k in range(3))
    return Measured(
        extents=(x, y, z),
        faces=len(shape.faces),
        watertight=mass.solid,
        textures=len({id(texture) for texture in textures if max(texture.shape[:2]) > PLACEHOLDER_PX}),
        notes=(*notes, PLAIN) if is_plain(shape) else notes,
        up=None if fits is None else fits.axis,
        confidence=None if fits is None else fits.confidence,
        area=float(face_areas(shape.vertices, shape.faces).sum()),
        volume=abs(float((a * np.cross(b, c)).sum())) / 6.0,
        handed=measure_handed(shape),
        look=sample_look(shape),
        unit_m=find_unit(path, math.dist(lower, upper)),
        stated_up=find_up(_head(path)) if path.suffix.lower() == ".dae" else None,
        rests_on_z=rests(hull_vertices, mass.com, "z"),
    )


def measure_handed(shape: Shape | Mesh) -> float:
    """How far a surface is from its mirror image, which has the same of the other sign.

    The mean of x y z over the surface, along principal axes that form a right-handed frame, each by its standard deviation:
    turning two of the axes round leaves it as it is. 0 of what is its own mirror image, or flat. Exact, by four points of each
    triangle (the rule of degree 3 of Strang and Fix, 1973).
    """
    inside = np.full((4, 3), 0.2) + 0.4 * np.eye(4, 3, -1)
    inside[0] = 1.0 / 3.0
    points = np.einsum("pk,fkx->pfx", inside, shape.vertices[shape.faces]).reshape(-1, 3)
    weights = np.outer((-27.0, 25.0, 25.0, 25.0), face_areas(shape.vertices, shape.faces)).ravel()
    weights = weights / max(weights.sum(), np.finfo(np.float64).tiny)
    centred = points - weights @ points
    squares, axes = np.linalg.eigh((centred * weights[:, None]).T @ centred)
    if squares[0] <= 1e-9 * squares[2]:
        return 0.0
    along = centred @ (axes * np.sign(np.linalg.det(axes))) / np.sqrt(squares)
    return float(weights @ along.prod(axis=1))


def read_measured(tree: dict[str, Any]) -> Measured:
    """The measures of `asdict`'s tree from JSON. Raises TypeError or KeyError where it is none."""
    look = None if tree["look"] is None else tuple(tree["look"])
    return Measured(**{**tree, "extents": tuple(tree["extents"]), "notes": tuple(tree["notes"]), "look": look})


def is_plain(shape: Shape) -> bool:
    """Whether all of a shape has one grey: its files give it no picture and no colour, or what a program writes by default."""
    greys = {part.material.base_color[:3] for part in shape.parts}
    pictures = (part.material.texture for part in shape.parts if part.material.texture is not None)
    bare = all(part.colors is None for part in shape.parts) and all(
        max(p.shape[:2]) <= PLACEHOLDER_PX for p in pictures
    )
    return bare and len(greys) == 1 and float(np.ptp(next(iter(greys)))) < SAME_GREY


LOOK_SIDE, LOOK_SAMPLES = 4, 1 << 15
"""Nodes along each side of the box that colours are told by, and points of the surface that are looked at: with so
many, two ways to cut a face with a fine pattern into triangles differ by about 1 of 255."""


def sample_look(shape: Shape) -> tuple[float, ...] | None:
    """[LOOK_SIDE^3 * 3]: by place in the bounding box, colour where faces lie, of 255; None for no material, or no area.

    Each node of a grid has the mean of its neighbourhood times its share of the surface (trilinear, so that rounding moves
    little): all sum to the mean colour. The points are the R2 sequence (Roberts 2018) over faces in their order, by area.
    """
    bare = all(part.material is DEFAULT and part.colors is None for part in shape.parts)
    if bare or not face_areas(shape.vertices, shape.faces).any():
        return None
    k = np.arange(LOOK_SAMPLES)
    face, weights, points = draw_points(
        shape.mesh, np.stack([(k + 0.5) / len(k), k * 0.7548776662466927 % 1.0, k * 0.5698402909980532 % 1.0])
    )
    lower, upper = shape.bounds
    at = (LOOK_SIDE - 1) * (points - lower) / np.where(upper > lower, upper - lower, 1.0)
    near = np.maximum(0.0, 1.0 - np.abs(at[:, :, None] - np.arange(LOOK_SIDE)))
    sums = np.einsum("ni,nj,nk,nc->ijkc", *near.transpose(1, 0, 2), colors_at(shape, face, weights), optimize=True)
    return tuple(np.round(sums.ravel() / len(k), 3).tolist())


HEAD_BYTES = 65_536
"""Bytes of a file that are looked at for a remark on its unit."""

_UNIT = re.compile(rb"^#[^\n]*\bunits?\b[\s=:]*(?:(?:is|are|in)\b)?[\s=:]*([a-z]+)", re.IGNORECASE | re.MULTILINE)
"""A remark in an OBJ file, as SketchUp's `# File units = inches`."""
_UNITS = {"m": 1.0, "meter": 1.0, "metre": 1.0, "cm": 0.01, "centimeter": 0.01, "centimetre": 0.01, "mm": 0.001}
_UNITS |= {"millimeter": 0.001, "millimetre": 0.001, "inch": 0.0254, "inche": 0.0254, "in": 0.0254}
_UNITS |= {"foot": 0.3048, "feet": 0.3048, "ft": 0.3048}

INFO_FILE = "models_info.json"
_INFO = re.compile(r"obj_0*(\d+)")
INFO_SLACK = 0.02
"""By how much a mesh may differ from the size that BOP tells of it, and still be in that unit."""


def find_unit(path: Path, diagonal: float) -> float | None:
    """Metres in a unit of a file of a diagonal, in its units; None where nothing says it.

    An OBJ file may state its unit in a remark at its start; BOP's `models_info.json` tells the size of `obj_000001` in mm.
    """
    match, info = _INFO.fullmatch(path.stem), path.with_name(INFO_FILE)
    if match is not None and info.is_file():
        with suppress(OSError, ValueError, LookupError, TypeError, ArithmeticError):
            sizes = json.loads(as_utf8(info.read_bytes())[0])[match[1]]
            unit = 0.001 * math.hypot(*(float(sizes[f"size_{axis}"]) for axis in "xyz")) / diagonal
            return next((known for known in _UNITS.values() if abs(unit / known - 1.0) < INFO_SLACK), None)
    remark = _UNIT.search(_head(path)) if path.suffix.lower() == ".obj" else None
    word = remark[1].decode().lower() if remark else ""
    return _UNITS.get(word, _UNITS.get(word.removesuffix("s")))


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return as_utf8(stream.read(HEAD_BYTES))[0]
