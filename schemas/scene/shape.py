"""What is in a scene: region ids, shapes with materials and mass, lights and background. Arrays are read-only."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose

REGION_NOTHING = 0
REGION_FLOOR = 1
"""The floor, and the walls of a room."""
REGION_TABLE = 2
REGION_FIRST_OBJECT = 3
REGION_FIRST_CLUTTER = 200
"""Objects without rows; a scene has at most 50 of either."""

RegionIds = TypeVar("RegionIds", int, NDArray[np.uint8])


def is_object(region: RegionIds) -> Any:
    """Whether region ids, one or an array, are of objects that have rows."""
    return (region >= REGION_FIRST_OBJECT) & (region < REGION_FIRST_CLUTTER)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices [V, 3] float64 metres, faces [F, 3] int32."""

    vertices: Array
    faces: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull: its vertices [V, 3] float64, and the unit outward normals [F, 3] of its triangles."""

    vertices: Array
    normals: Array


@dataclass(frozen=True, eq=False)
class Material:
    """A surface in the terms of glTF's metallic-roughness model.

    `base_color` is sRGB with straight alpha, each in [0, 1]; it multiplies the texture and the vertex colours.
    `texture` is [h, w, 3 or 4] uint8 sRGB, row 0 at the top; uv (0, 0) is its lower left corner (OpenGL, trimesh).
    `transmission` is the share of light not mirrored that crosses the surface as through glass, in the path-traced tier
    alone; `transmission_map` [h, w] uint8 multiplies it, and `ior` is the index of refraction. A transmitting surface is a
    thin sheet; an `ior` of 1 lets all light pass, for the second side of a wall whose first side stands for both.
    `emission` is light that the surface sends, its colour times this, where white in full light sends 1; tiers without paths draw
    a surface that mirrors so much more of what arrives. The path tracer makes a lamp of it, which must be the pane of a window.
    `jpeg` is the file that the texture was read from, if it was a JPEG of the same pixels: a copy as PNG has five times its size.
    """

    base_color: tuple[float, float, float, float] = (0.7, 0.7, 0.7, 1.0)
    metallic: float = 0.0
    roughness: float = 0.6
    texture: NDArray[np.uint8] | None = None
    transmission: float = 0.0
    transmission_map: NDArray[np.uint8] | None = None
    ior: float = 1.5
    emission: float = 0.0
    jpeg: bytes | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """One triangle mesh with one material.

    vertices [V, 3] float64 metres; faces [F, 3] int32, counter-clockwise seen from outside; normals [V, 3] float64 unit
    shading normals or None (flat); uv [V, 2] float64 or None; colors [V, 4] uint8 sRGB or None.
    """

    name: str
    vertices: Array
    faces: NDArray[np.int32]
    material: Material = Material()
    normals: Array | None = None
    uv: Array | None = None
    colors: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Shape:
    """The parts of one rigid body, all in one frame.

    `closed`: together they bound closed bodies, wound outwards: no back of a face is visible from outside. What follows from
    the parts is computed once, when it is first asked for.
    """

    parts: tuple[Part, ...]
    closed: bool = False

    @cached_property
    def vertices(self) -> Array:
        """[V, 3] float64: the vertices of every part, in order."""
        return _read_only(np.concatenate([part.vertices for part in self.parts]))

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """[F, 3] int32 into `vertices`."""
        faces, start = [], 0
        for part in self.parts:
            faces.append(part.faces + np.int32(start))
            start += len(part.vertices)
        return _read_only(np.concatenate(faces, dtype=np.int32, casting="same_kind"))

    @cached_property
    def mesh(self) -> Mesh:
        """All parts as one mesh, without their materials."""
        return Mesh(self.vertices, self.faces)

    @cached_property
    def bounds(self) -> Array:
        """[2, 3] float64: lower and upper corner of the axis-aligned bounding box."""
        # Along rows: numpy takes ten times as long to find the least of each of three columns.
        rows = np.ascontiguousarray(self.vertices.T)
        return _read_only(np.stack([rows.min(axis=1), rows.max(axis=1)]))


def _read_only(array: NDArray) -> NDArray:
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Loft:
    """A body of stacked rings, whose convex parts follow from them (`workers.geometry.lathe_decomposition`).

    rings [L, n, 3] metres, each convex and counter-clockwise seen from the end; ends [2, 3]: apexes of the fans that close
    it. profiles [K, L + 2, 2]: radius and height of the first end, every ring and the last end, where all rings are level
    on one axis; a profile may turn inwards and back. K profiles of the most unlike columns where columns differ. None
    where rings are askew, each beyond the one before. The volume of `cutters` is excluded.
    """

    rings: Array
    ends: Array
    profiles: Array | None = None
    cutters: tuple["Loft", ...] = ()

    def mapped(self, axes: Array, origin: Array) -> "Loft":
        """The loft with x, y, z along the rows of `axes` [3, 3] (any length, no mirror) and its origin at `origin`."""
        rings, ends = (
            p[..., 0:1] * axes[0] + p[..., 1:2] * axes[1] + p[..., 2:3] * axes[2] + origin
            for p in (self.rings, self.ends)
        )
        lengths = np.sqrt((axes * axes).sum(axis=1))[[0, 2]]
        profiles = None if self.profiles is None else self.profiles * lengths
        return Loft(rings, ends, profiles, tuple(cutter.mapped(axes, origin) for cutter in self.cutters))


@dataclass(frozen=True, eq=False)
class Lofted:
    """A body that is a union of lofts, and the map from their frame to its own, as `Loft.mapped` takes it.

    Few bodies are asked for their lofts, so they are mapped when they are first asked for.
    """

    unmapped: tuple[Loft, ...]
    axes: Array
    origin: Array

    @cached_property
    def lofts(self) -> tuple[Loft, ...]:
        """The lofts in the body's own frame."""
        return tuple(loft.mapped(self.axes, self.origin) for loft in self.unmapped)


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass properties of the true mesh, not of its collision shape.

    com [3] metres, object frame; inertia [3, 3] kg m^2 about the centre of mass, object axes; `solid`: watertight, else
    treated as a thin shell.
    """

    mass_kg: float
    com: Array
    inertia: Array
    solid: bool


@dataclass(frozen=True, eq=False)
class Asset:
    """A shape ready for a scene: cleaned, metric, in the object frame (dataset.md section 1).

    `source`: `procedural` or `library`; `path`: the file within that source or None; `sha256`: digest of the
    source file, or of the generated arrays. `T_source_to_object` takes the source's coordinates, multiplied by `scale`, to
    the object frame. `shareable`: whether the cleaned mesh may be written into the dataset. `volume_m3` is None where the
    mesh is not watertight. `notes`: what was repaired or left out. `lofted`: the lofts that the shape is the union of, where
    they are known.
    """

    instance_id: str
    category: str
    source: str
    licence: str
    path: str | None
    sha256: str
    shape: Shape
    mass: MassProperties
    T_source_to_object: Pose
    scale: float
    watertight: bool
    volume_m3: float | None
    shareable: bool
    notes: tuple[str, ...] = ()
    lofted: Lofted | None = None

    @property
    def extents_m(self) -> Array:
        """[3] float64: size of the bounding box along the object axes."""
        lower, upper = self.shape.bounds
        return upper - lower


@dataclass(frozen=True, eq=False)
class Light:
    """A distant light: `direction` [3] unit, from the surface towards the light, world; `color` linear RGB radiance.

    A white surface that faces it has the radiance `color`.
    """

    direction: Array
    color: tuple[float, float, float]
    size_rad: float | None = None
    """Angle across its disc. None: the key light's is `LAMP_RAD`, others are soft."""
    of_surround: bool = False
    """Whether it stands, in tier raster, for a part of the surround, which has it anyway."""


LAMP_RAD = 0.06
"""Angle across a key light without a size, seen from the scene: a softbox of 12 cm at 2 m."""


@dataclass(frozen=True)
class MapSource:
    """A map of the light from all directions: the name of a built-in one, or of a file with its place and SHA-256, hex."""

    name: str
    path: Path | None = None
    sha256: str | None = None


@dataclass(frozen=True, eq=False)
class Surround:
    """Light from all directions, as a picture has it.

    radiance [H, 2 H, 3] float32, linear RGB: rows from the zenith to the nadir; the middle column is the world's +x where
    `turn_rad`, counter-clockwise from above, is 0, and columns to its right are clockwise. `scale` multiplies it.
    terms [18, 3]: the radiance of a white surface by its normal, world, without what `Appearance.lights` give
    (workers.geometry.irradiance).
    """

    radiance: NDArray[np.float32]
    terms: Array
    turn_rad: float
    scale: float
    shown: bool
    """Whether the picture is seen where no surface is."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """Lights and background; linear RGB radiance. The floor's surface is part of its shape.

    `ambient` comes from all directions in the flat tier; in the raster tier it comes from above, and `below` from below.
    The first light is the key light: it casts shadows in the raster tier.
    """

    ambient: tuple[float, float, float]
    lights: tuple[Light, ...]
    background: tuple[float, float, float]
    """Linear RGB where nothing is hit."""
    below: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sheen: float = 1.0
    """Share of what Fresnel's term mirrors at grazing angles that is drawn, in the raster tier: light that comes from everywhere
    alike would draw a pale line along every outline."""
    surround: Surround | None = None
    """In the place of `ambient` and `below`."""
    backdrop: NDArray[np.uint8] | None = None
    """A picture [h, w, 3] uint8 sRGB in place of the background, which fills every view from edge to edge."""
