"""Shapes packed for the GPU: pure functions from parts to interleaved vertices and indices.

Depth is computed from each face's plane (gbuffer.py), but GPUs take attributes from vertices. So each face owns one vertex,
the last of its three, which provides flat attributes. A mesh has about half as many vertices as faces: about half of the
faces own one of them, the others get a copy.

Fragments compute their own depth, so hidden ones are shaded before they are tested. What lies below a convex top, as legs do
below a table's top, and is seen through the inside of the top by all its corners, is hidden whole and need not be drawn.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh, Part, Shape
from workers.geometry.colour import SRGB_STEPS, decode_srgb
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import face_planes

BELOW_M = 1e-3
"""What a top hides is at least so far below it: ten times as far as the heights of its points differ."""

INSIDE = 2e-3
"""What a top hides is seen this share of its distance inside of its outline: a rasteriser moves edges by 1/256 pixel."""

OUT_OF_LINE_M = 1e-6
"""Corners may lie so far outside of an edge of the outline: float32 has this for a metre."""

LEAST_SINE = 0.1
"""Least sine of the elevation from which a top is taken to hide anything."""

MERGED = 24
"""Hidden triangles between two that are seen, up to this number, are drawn too: a draw call costs more."""


@dataclass(frozen=True, eq=False)
class Cover:
    """A convex, level top without holes, in its thing's frame.

    `level_m`: its height. sides [E, 3]: unit (a, b), and c, where a x + b y + c < 0 inside, metres.
    """

    level_m: float
    sides: Array


def find_cover(triangles: NDArray[np.float32]) -> Cover | None:
    """The cover that triangles [F, 3, 3] on one level, counter-clockwise from above, make together; None where they make none.

    Edges that no other triangle has in the opposite direction are the outline. Where every corner lies to the left of all of
    them, they are a convex polygon, and the triangles fill it.
    """
    if not len(triangles):
        return None
    corners = [[tuple(corner) for corner in triangle] for triangle in triangles[:, :, :2].tolist()]
    edges = {(a, b) for p, q, r in corners for a, b in ((p, q), (q, r), (r, p)) if a != b}
    outline = np.array([edge for edge in edges if edge[::-1] not in edges]).reshape(-1, 2, 2)
    along = outline[:, 1] - outline[:, 0]
    length = np.hypot(along[:, 0], along[:, 1])
    outwards = np.column_stack([along[:, 1], -along[:, 0]]) / length[:, None]
    sides = np.column_stack([outwards, -(outwards * outline[:, 0]).sum(axis=1)])
    points = np.array([corner for triangle in corners for corner in triangle])
    if not len(sides) or (points @ sides[:, :2].T + sides[:, 2]).max() > OUT_OF_LINE_M:
        return None
    return Cover(float(triangles[..., 2].max()), sides)


def seen_ranges(
    positions: NDArray[np.float32], faces: NDArray[np.uint32], cover: Cover, eye: Array
) -> list[tuple[int, int]]:
    """(first, count) of the runs of faces [F, 3] that a cover may not hide from an eye [3]; positions [V, 3]; its frame."""
    starts = np.empty((len(faces) + 1, 2), np.int64)
    count = _seen_ranges(positions, faces, cover.level_m, cover.sides, eye, starts)
    return [(first, end - first) for first, end in starts[:count].tolist()]


@compiled_for("f4[:,::1], u4[:,::1], f8, f8[:,::1], f8[::1], i8[:,::1]")
def _seen_ranges(
    positions: NDArray[np.float32],
    faces: NDArray[np.uint32],
    level_m: float,
    sides: Array,
    eye: Array,
    ranges: NDArray[np.int64],
) -> int:
    """Fills ranges [F, 2] with the first face and the end of each run, and returns their number."""
    hidden = np.zeros(len(positions), np.bool_)
    above = eye[2] - level_m
    for n in range(len(positions)):
        below = level_m - positions[n, 2]
        if above <= 0.0 or below < BELOW_M:
            continue
        share = above / (above + below)  # of the way from the eye, where the top's level is met
        dx, dy = share * (positions[n, 0] - eye[0]), share * (positions[n, 1] - eye[1])
        away_m = np.sqrt(dx * dx + dy * dy + above * above)
        inside = above >= LEAST_SINE * away_m
        for side in range(len(sides)):
            if not inside:
                break
            out = sides[side, 0] * (eye[0] + dx) + sides[side, 1] * (eye[1] + dy) + sides[side, 2]
            inside = out < -INSIDE * away_m
        hidden[n] = inside
    count = 0
    for face in range(len(faces)):
        if hidden[faces[face, 0]] and hidden[faces[face, 1]] and hidden[faces[face, 2]]:
            continue
        if count and face - ranges[count - 1, 1] <= MERGED:
            ranges[count - 1, 1] = face + 1
        else:
            ranges[count, 0], ranges[count, 1] = face, face + 1
            count += 1
    return count


COLUMNS = {"position": 3, "normal_metallic": 4, "albedo_roughness": 4, "uv": 2, "face_plane": 4}
"""Floats of each attribute, in the order of the shader's locations."""

MATTE_ROUGHNESS = 0.8
"""Surfaces at least this rough are drawn without highlights."""

SAME_LEVEL_M = 1e-4

SHADED_UPRIGHT = 1.0 - 1e-6
"""Least cosine with the vertical of normals that are shaded as upright."""

_PLANE_Z = -2
"""The column with the z of a face's normal."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Triangles with one texture, drawn together.

    vertices [V, 17] float32 in the columns of `COLUMNS`: a normal of 0 stands for the face's own; the plane of a face is
    (n, n . p) in the shape's frame, n of unit length or 0 where the face has no area. indices [F, 3] uint32, whose last
    column never repeats. texture [h, w, 3 or 4] uint8 sRGB, row 0 at the top, or None.
    """

    vertices: NDArray[np.float32]
    indices: NDArray[np.uint32]
    texture: NDArray[np.uint8] | None
    planar: bool
    """Whether no part has normals or colours of its own: each face has the normal of its plane and one material."""
    matte: bool
    """Whether it is planar, and no part is metal or smoother than `MATTE_ROUGHNESS`."""
    top_faces: int = 0
    """The first so many faces are horizontal, face up, and lie within `SAME_LEVEL_M` of the shape's highest point."""
    planar_top: bool = False
    """Whether these have the normals of their planes, and each has one colour."""


def pack_shape(shape: Shape) -> tuple[Batch, ...]:
    """One batch for each texture, and one for all parts without."""
    by_texture: dict[int, list[Part]] = {}
    for part in shape.parts:
        by_texture.setdefault(id(texture_of(part)), []).append(part)
    highest = max(float(part.vertices[:, 2].max()) for part in shape.parts)
    return tuple(_pack(parts, highest) for parts in by_texture.values())


def own_vertices(faces: NDArray, vertex_count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(faces [F, 3] int64, source [V'] int64): each face rotated so that its last vertex is no other face's last.

    `source` names the vertex that each new vertex is a copy of; the first `vertex_count` are the vertices themselves.
    """
    turned, source = np.empty(faces.shape, np.int64), np.empty(vertex_count + len(faces), np.int64)
    count = _own_vertices(np.ascontiguousarray(faces), vertex_count, turned, source)
    return turned, source[:count]


@compiled_for("const(i4[:,::1]), i8, i8[:,::1], i8[::1]")
def _own_vertices(
    faces: NDArray[np.integer], vertex_count: int, turned: NDArray[np.int64], source: NDArray[np.int64]
) -> int:
    """Fills `turned` and the first so many of `source`, whose number it returns.

    In three rounds each face asks for one of its corners that is nobody's yet; of those that ask for the same, the last
    face gets it. Who got none in any round has a copy of its last corner.
    """
    owner, given = np.full(vertex_count, -1), np.full(vertex_count, -1)
    owns = np.zeros(len(faces), np.bool_)
    for turn in range(3):
        last = (turn + 2) % 3
        for face in range(len(faces)):
            wanted = faces[face, last]
            if not owns[face] and (owner[wanted] < 0 or given[wanted] == turn):
                owner[wanted], given[wanted] = face, turn
        for face in range(len(faces)):
            if not owns[face] and owner[faces[face, last]] == face:
                owns[face] = True
                for corner in range(3):
                    turned[face, corner] = faces[face, (last + 1 + corner) % 3]
    for vertex in range(vertex_count):
        source[vertex] = vertex
    count = vertex_count
    for face in range(len(faces)):
        if not owns[face]:
            turned[face, 0], turned[face, 1], turned[face, 2] = faces[face, 0], faces[face, 1], count
            source[count] = faces[face, 2]
            count += 1
    return count


def texture_of(part: Part) -> NDArray[np.uint8] | None:
    """The part's texture, if it has coordinates for one."""
    return part.material.texture if part.uv is not None else None


def is_matte(part: Part) -> bool:
    """Whether each face of a part has the normal of its plane and the part's colour, and none has highlights."""
    dull = part.material.metallic == 0.0 and part.material.roughness >= MATTE_ROUGHNESS
    return dull and _is_faceted(part)


def _is_faceted(part: Part) -> bool:
    return part.normals is None and part.colors is None


def _pack(parts: list[Part], highest_m: float) -> Batch:
    packed, indices, start = [], [], 0
    albedos = decode_srgb(np.array([part.material.base_color[:3] for part in parts]))
    albedos = albedos * np.array([[1.0 + part.material.emission] for part in parts])
    for part, albedo in zip(parts, albedos, strict=True):
        faces, source = own_vertices(part.faces, len(part.vertices))
        vertices = _vertex_columns(part, albedo, source)
        _write_planes(vertices, faces, *face_planes(Mesh(part.vertices, part.faces)))
        packed.append(vertices)
        indices.append(faces + start)
        start += len(vertices)
    planar = all(map(_is_faceted, parts))
    vertices = np.concatenate(packed)
    corners, top_faces = _tops_first(vertices, np.concatenate(indices), np.float32(highest_m - SAME_LEVEL_M), _PLANE_Z)
    planar_top = planar or _is_planar(vertices, corners[:top_faces], SHADED_UPRIGHT)
    return Batch(vertices, corners, texture_of(parts[0]), planar, all(map(is_matte, parts)), top_faces, planar_top)


@compiled_for("f4[:,::1], i8[:,::1], f4, i8")
def _tops_first(
    vertices: NDArray[np.float32], faces: NDArray[np.int64], lowest_m: np.float32, plane_z: int
) -> tuple[NDArray[np.uint32], int]:
    """(faces [F, 3], those that face up and lie above `lowest_m` before the others; the number of them)."""
    top, count = np.empty(len(faces), np.bool_), 0
    for face in range(len(faces)):
        top[face] = vertices[faces[face, 2], plane_z] > np.float32(0.0)
        for corner in range(3):
            top[face] &= vertices[faces[face, corner], 2] > lowest_m
        count += top[face]
    ordered, first, other = np.empty((len(faces), 3), np.uint32), 0, count
    for face in range(len(faces)):
        row = first if top[face] else other
        for corner in range(3):
            ordered[row, corner] = faces[face, corner]
        first, other = first + top[face], other + (not top[face])
    return ordered, count


@compiled_for("f4[:,::1], u4[:,::1], f8")
def _is_planar(vertices: NDArray[np.float32], faces: NDArray[np.uint32], upright: float) -> bool:
    """Whether horizontal faces [F, 3] have no normals but upright ones, and each has one colour."""
    for face in range(len(faces)):
        last = vertices[faces[face, 2]]
        for corner in range(3):
            vertex = vertices[faces[face, corner]]
            x, y, z = vertex[3], vertex[4], vertex[5]
            if x * x + y * y + z * z > 0.01 and z < upright * np.sqrt(x * x + y * y + z * z):
                return False
            for column in range(7, 10):
                if vertex[column] != last[column]:
                    return False
    return True


@compiled_for("f4[:,::1], i8[:,::1], f8[:,::1], f8[::1]")
def _write_planes(vertices: NDArray[np.float32], faces: NDArray[np.int64], normals: Array, offsets: Array) -> None:
    """Writes each face's plane, normals [F, 3] and offsets [F], into the last columns of its last vertex."""
    for face in range(len(faces)):
        row = vertices[faces[face, 2], -4:]
        row[0], row[1], row[2], row[3] = normals[face, 0], normals[face, 1], normals[face, 2], offsets[face]


def _vertex_columns(part: Part, albedo: Array, source: NDArray[np.int64]) -> NDArray[np.float32]:
    """[V', 17] float32 in the columns of `COLUMNS`, of the vertices `source` [V']; missing attributes, and the plane, are 0.

    albedo [3]: the part's colour in linear light.
    """
    row = np.zeros(sum(COLUMNS.values()), np.float32)
    row[6], row[7:10], row[10] = part.material.metallic, albedo, part.material.roughness
    columns = np.tile(row, (len(source), 1))
    _gather_rows(np.ascontiguousarray(part.vertices), source, columns[:, 0:3])
    if part.normals is not None:
        _gather_rows(np.ascontiguousarray(part.normals), source, columns[:, 3:6])
    if part.colors is not None:
        _gather_rows(albedo * SRGB_STEPS[part.colors[:, :3]], source, columns[:, 7:10])
    if part.uv is not None:
        _gather_rows(np.ascontiguousarray(part.uv), source, columns[:, 11:13])
    return columns


@compiled_for("f8[:,::1], i8[::1], f4[:,:]", "const(f8[:,::1]), i8[::1], f4[:,:]")
def _gather_rows(values: Array, source: NDArray[np.int64], rows: NDArray[np.float32]) -> None:
    """Writes values [V, C] at `source` [N] into rows [N, C]."""
    for n in range(len(source)):
        for column in range(values.shape[1]):
            rows[n, column] = values[source[n], column]
