"""Shape targets: points of an asset's surface and volume, on which networks that reconstruct shapes are trained. Pure.

They are drawn from the digest of the asset's source, so that every scene and every machine has the same ones of a shape.
"""

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.views import ShapeTarget, Targets
from schemas.scene.shape import Asset, Mesh, Part, Shape
from workers.assets.mass import unite_bodies
from workers.assets.winding import winding_numbers, winding_of_closed
from workers.door.meshes.mesh import merge_points
from workers.geometry.colour import SRGB_STEPS, decode_srgb, encode_codes
from workers.geometry.distance import distance_to_mesh
from workers.geometry.mesh import face_areas, face_normals, mix, sample_texture

GROWN = 1.05
"""Size of the box that points of the volume are uniform in, in sizes of the shape's."""

NEAR = 0.01
"""Standard deviation, along each axis, of points near the surface, in diagonals of the box."""

SURE = 0.1
"""How far from 0, or from 1, 2, ..., a winding number still says clearly whether a point is inside."""

INNER_M = 1e-7
"""Points of faces farther than this from the union of closed bodies lie inside it."""


@dataclass(frozen=True, eq=False)
class Samples:
    """The arrays of an asset's file by key, as docs/dataset.md has them; none where the shape has no target.

    open_share: share of the points of the volume that are not clearly inside or outside, None without them; notes: which target
    the shape does not have, and why.
    """

    arrays: Mapping[str, NDArray]
    open_share: float | None = None
    notes: tuple[str, ...] = ()


def draw_samples(asset: Asset, targets: Targets) -> Samples:
    """The targets of a shape that the job asks for, as far as the shape has them."""
    if not face_areas(asset.shape.vertices, asset.shape.faces).any():
        return Samples({}, notes=("no samples: no face has an area",))
    arrays: dict[str, NDArray] = {}
    boundary, common_m3 = _boundary_of(asset)
    share, notes = None, [] if common_m3 is not None else [UNITED]
    if "surface" in targets.shape:
        arrays |= _draw_surface(asset.shape, boundary if common_m3 else None, targets.points, _chance(asset, "surface"))
    if "volume" in targets.shape:
        drawn, share = _draw_volume(boundary, asset.watertight, targets.points, _chance(asset, "volume"))
        if drawn["volume_occupancy"].any():
            arrays |= drawn
        else:
            share, notes = None, [*notes, "no samples of the volume: the faces enclose none"]
    if arrays:
        lower, upper = asset.shape.bounds
        arrays |= {"loc": (lower + upper) / 2.0, "scale": np.asarray((upper - lower).max())}
    return Samples(arrays, share, tuple(notes))


UNITED = "samples: too many bodies to unite; where they overlap, walls inside count as surface"


def encode_samples(arrays: Mapping[str, NDArray]) -> bytes:
    """What numpy.load reads: uncompressed, with a fixed date, so that the bytes are those of the arrays.

    Not by numpy.savez: how it marks members as large depends on the patch version of Python.
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getvalue())
    return stream.getvalue()


def _chance(asset: Asset, target: ShapeTarget) -> np.random.Generator:
    """A stream of its own for each target: asking for one does not change the other."""
    stream = ("surface", "volume").index(target)
    return np.random.default_rng(np.random.SeedSequence(int(asset.sha256, 16), spawn_key=(stream,)))


def _boundary_of(asset: Asset) -> tuple[Mesh, float | None]:
    """(the surface of the solid that closed bodies are together, of an open shape its faces; what bodies share, m^3).

    None as the volume where the bodies are too many to unite.
    """
    whole = asset.shape.mesh
    if not asset.watertight:
        return whole, 0.0
    (vertices, faces), common_m3 = unite_bodies(whole.vertices, whole.faces.astype(np.int64))
    point = merge_points(vertices)
    places = np.empty((int(point.max()) + 1, 3))
    places[point] = vertices
    return Mesh(places, point[faces].astype(np.int32)), common_m3


def _draw_surface(shape: Shape, solid: Mesh | None, count: int, rng: np.random.Generator) -> dict[str, NDArray]:
    """Points of a shape's faces, uniform by area, with normals and colours of the faces; of `solid`, on its surface alone."""
    mesh = shape.mesh
    kept: list[tuple[NDArray, ...]] = []
    while sum(len(face) for face, _, _ in kept) < count:
        drawn = draw_points(mesh, rng.random((3, count)))
        outer = slice(None) if solid is None else distance_to_mesh(drawn[2], solid)[0] <= INNER_M
        kept.append(tuple(array[outer] for array in drawn))
    face, weights, points = (np.concatenate(arrays)[:count] for arrays in zip(*kept, strict=True))
    return {
        "surface_points": points.astype(np.float32),
        "surface_normals": face_normals(mesh.vertices, mesh.faces)[face].astype(np.float32),
        "surface_colors": colors_at(shape, face, weights),
    }


def colors_at(shape: Shape, face: NDArray[np.int64], weights: Array) -> NDArray[np.uint8]:
    """[N, 3] sRGB of base colours, vertex colours and textures at points of faces [N], by weights [N, 3] of their corners."""
    colors, start = np.empty((len(face), 3), np.uint8), 0
    for part in shape.parts:
        mine = np.flatnonzero((face >= start) & (face < start + len(part.faces)))
        corners = np.ascontiguousarray(part.faces[face[mine] - start])
        colors[mine] = encode_codes(_base_light(part, corners, np.ascontiguousarray(weights[mine])))
        start += len(part.faces)
    return colors


def _base_light(part: Part, corners: NDArray[np.int32], weights: Array) -> Array:
    """[N, 3], or [1, 3] where it is the same everywhere: linear light of a part's base colour, vertex colours and texture.

    At the points that weights [N, 3] of corners [N, 3], vertices of the part, add up to; 1 is white.
    """
    light = decode_srgb(np.array([part.material.base_color[:3]]))
    if part.colors is not None:
        light = light * mix(SRGB_STEPS[part.colors[:, :3]], corners, weights)
    if part.material.texture is not None and part.uv is not None:
        light = light * sample_texture(part.material.texture, mix(part.uv, corners, weights), SRGB_STEPS)
    return light


def _draw_volume(
    boundary: Mesh, closed: bool, count: int, rng: np.random.Generator
) -> tuple[dict[str, NDArray], float]:
    """(points of space with their signed distances and whether they are inside, the share that is not clear).

    The first half is uniform in the grown box, the second half lies about points of the surface. Distances are of the points
    as they are stored.
    """
    lower, upper = boundary.vertices.min(axis=0), boundary.vertices.max(axis=0)
    near = count // 2
    spread = (lower + upper) / 2.0 + (rng.random((count - near, 3)) - 0.5) * GROWN * (upper - lower)
    away = NEAR * float(np.linalg.norm(upper - lower)) * rng.standard_normal((near, 3))
    stored = np.concatenate([spread, draw_points(boundary, rng.random((3, near)))[2] + away]).astype(np.float32)
    points = stored.astype(np.float64)
    distance = distance_to_mesh(points, boundary)[0]
    number = winding_of_closed(points, boundary) if closed else winding_numbers(points, boundary)
    inside, unclear = number > 0.5, np.abs(number - np.maximum(np.rint(number), 0.0)) > SURE
    return {
        "volume_points": stored,
        "volume_distance": np.where(inside, -distance, distance).astype(np.float32),
        "volume_occupancy": inside.astype(np.uint8),
    }, float(unclear.mean())


def draw_points(mesh: Mesh, chance: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """(faces [N], weights of their corners [N, 3], points [N, 3]) of a mesh, uniform by area (Osada et al. 2002, 4.1).

    chance [3, N]: numbers in [0, 1).
    """
    areas = face_areas(mesh.vertices, mesh.faces)
    ends = np.cumsum(areas)
    face = np.searchsorted(ends, chance[0] * ends[-1], side="right").clip(max=np.flatnonzero(areas)[-1])
    root, along = np.sqrt(chance[1]), chance[2]
    weights = np.stack([1.0 - root, root * (1.0 - along), root * along], axis=1)
    a, b, c = (mesh.vertices[mesh.faces[face, k]] * weights[:, k, None] for k in range(3))
    return face, weights, a + b + c
