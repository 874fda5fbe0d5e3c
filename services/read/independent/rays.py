"""Stored shapes, and every face of them that the rays through a view's pixel centres meet. Conventions are those of derive.py.

A ray meets a face where the pixel's centre lies on the inner side of the face's three projected edges, and there at the z of the
face's plane: in float64, of the vertices as they are stored.

**Near an edge.** A renderer moves each vertex to its grid: 1/256 pixel here and on the GPUs that we know, in either direction,
so 0.0055 pixel at most along the diagonal; its arithmetic in float32 adds less than 0.001 pixel. A centre nearer than `EDGE_PX`
to a projected edge may therefore lie on either side of it, and what the face has within `EDGE_PX` of the centre may be its own.
"""

import functools
import io
import itertools
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Row = Mapping[str, Any]
Array = NDArray[np.float64]

EDGE_PX = 1.0 / 128.0
"""Distance from a projected edge, pixels, within which a centre may lie on either side."""

GRAZING, GRAZING_PX, DRAWN_PX = 0.01, 1.0 / 2000.0, 1e-4
"""Cosine of incidence below which a face is seen edge-on; how far a renderer's float32 may move a centre along such a face, and
along others, pixels. Of 33.8 million pixels of studio scenes it is 1 / 4069 at most, and 0.00005 beyond that cosine."""

NEAR_M = 0.05
"""Nearer surfaces are not seen."""

ROUNDING_PX = 1.0 / 1024.0
"""The same of points that are on no renderer's grid: float32 moves a corner by a tenth of that at most."""

BEHIND_M = 1e-5
"""A face does not hide a point that lies no farther than this behind its plane."""

_COMPONENTS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True, eq=False)
class Faces:
    """Triangles with what their corners have, each [F, 3, ...] float64.

    points: metres; normals: of shading, unit; colors: base colour times vertex colour, linear; uv: (0, 0) is the texture's upper
    left corner. texture [F]: number in `textures` (linear [h, w, 3]), -1 without one. region [F]; closed [F]: whether the shape
    that the face is of bounds bodies. rounding_m [F]: by how much float32 may have moved a corner.
    """

    points: Array
    normals: Array
    colors: Array
    uv: Array
    texture: NDArray[np.int64]
    textures: tuple[Array, ...]
    region: NDArray[np.int64]
    closed: NDArray[np.bool_]
    rounding_m: Array

    @functools.cached_property
    def plane_normals(self) -> tuple[Array, Array]:
        """(normals [F, 3] of the faces' planes, unit; heights [F] of the triangles over their longest sides, metres)."""
        a, b, c = self.points.swapaxes(0, 1)
        normal = np.cross(b - a, c - a)
        twice_area = np.linalg.norm(normal, axis=1)
        longest = np.linalg.norm([b - a, c - b, a - c], axis=2).max(axis=0)
        return normal / np.maximum(twice_area, 1e-300)[:, None], twice_area / np.maximum(longest, 1e-300)


def bare_faces(points: Array) -> Faces:
    """Faces of these corners [F, 3, 3], metres, without a look: of region 0 and of no body, exact."""
    count = len(points)
    none, every = np.full(count, -1), np.zeros(count, int)
    colors, uv = np.full(points.shape, np.nan), np.zeros((count, 3, 2))
    return Faces(points, np.zeros(points.shape), colors, uv, none, (), every, np.zeros(count, bool), np.zeros(count))


def read_shape(data: bytes) -> Faces:
    """The faces of a binary glTF file of one node, object frame, region 0. Raises ValueError or KeyError where it is another."""
    length, kind = struct.unpack_from("<I4s", data, 12)
    if data[:4] != b"glTF" or kind != b"JSON":
        raise ValueError("it is no binary glTF")
    tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def view(number: int) -> bytes:
        place = tree["bufferViews"][number]
        return binary[place.get("byteOffset", 0) :][: place["byteLength"]]

    def array(number: int) -> NDArray:
        accessor = tree["accessors"][number]
        values = np.frombuffer(view(accessor["bufferView"]), _COMPONENTS[accessor["componentType"]])
        return values.reshape(accessor["count"], _WIDTHS[accessor["type"]])

    textures = [_linear_texture(view(image["bufferView"])) for image in tree.get("images", [])]
    sources = [texture["source"] for texture in tree.get("textures", [])]
    parts = []
    for primitive in tree["meshes"][0]["primitives"]:
        has, look = primitive["attributes"], tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
        corners = array(primitive["indices"]).reshape(-1, 3).astype(np.int64)
        points = array(has["POSITION"]).astype(np.float64)[corners]
        flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])

        def corners_of(name: str, default: Array, has: dict = has, corners: NDArray = corners) -> Array:
            return array(has[name])[corners].astype(np.float64) if name in has else default

        normals = corners_of("NORMAL", np.repeat(flat[:, None], 3, axis=1))
        colors = corners_of("COLOR_0", np.ones(points.shape))[..., :3]
        uv = corners_of("TEXCOORD_0", np.zeros((*corners.shape, 2)))
        textured = "baseColorTexture" in look and "TEXCOORD_0" in has
        number = sources[look["baseColorTexture"]["index"]] if textured else -1
        base = look.get("baseColorFactor", [1.0] * 4)[:3]
        parts.append((points, normals, colors * np.array(base), uv, np.full(len(corners), number)))
    points, normals, colors, uv, texture = (np.concatenate(each) for each in zip(*parts, strict=True))
    count = len(points)
    rounding_m = np.full(count, np.spacing(np.abs(points).max().astype(np.float32)) * 0.5 * np.sqrt(3.0), np.float64)
    closed = np.full(count, _is_closed(points))
    return Faces(points, normals, colors, uv, texture, tuple(textures), np.zeros(count, int), closed, rounding_m)


def _linear_texture(data: bytes) -> Array:
    """[H, W, 3] of an image as it stands in the file, whatever orientation it tells of. Raises OSError."""
    with Image.open(io.BytesIO(data)) as image:
        share = np.asarray(image.convert("RGB")) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _is_closed(points: Array) -> bool:
    """Whether every edge is run through as often in one direction as in the other, corners [F, 3, 3] at one place being one."""
    _, corner = np.unique(points.reshape(-1, 3), axis=0, return_inverse=True)
    faces = corner.reshape(-1, 3)
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, edge = np.unique(low * (corner.max() + 1) + high, return_inverse=True)
    return not np.bincount(edge.reshape(-1), np.sign(edges[:, 1] - edges[:, 0])).any()


def place_shapes(shapes: Sequence[tuple[int, Faces, Array]]) -> Faces:
    """The faces of shapes, (region, shape, pose [4, 4]) each, in one frame."""
    placed, textures = [], list[Array]()
    for region, shape, T in shapes:
        placed.append(
            replace(
                shape,
                points=shape.points @ T[:3, :3].T + T[:3, 3],
                normals=shape.normals @ T[:3, :3].T,
                texture=np.where(shape.texture >= 0, shape.texture + len(textures), -1),
                region=np.full(len(shape.points), region),
            )
        )
        textures += shape.textures
    names = (name for name in Faces.__dataclass_fields__ if name != "textures")
    return Faces(
        **{name: np.concatenate([getattr(shape, name) for shape in placed]) for name in names}, textures=tuple(textures)
    )


@dataclass(frozen=True, eq=False)
class Hits:
    """Faces at pixel centres, each [N], in order of pixel and z.

    pixel: flat number; face: number in `Faces`. z: metres, of the face's plane; low, high: within these it is right, with the
    stored shape's rounding, and of a face near whose edge the centre lies, of what it has within `EDGE_PX` and of its plane, as
    renderers have it. covers: whether the centre is within the face; sure: whether it is so by more than `EDGE_PX`.
    """

    pixel: NDArray[np.int64]
    face: NDArray[np.int64]
    z: Array
    low: Array
    high: Array
    covers: NDArray[np.bool_]
    sure: NDArray[np.bool_]

    def where(self, some: NDArray | slice) -> "Hits":
        """Some of them, by a mask, by numbers or by a range."""
        return Hits(*(getattr(self, name)[some] for name in self.__dataclass_fields__))


def cast(faces: Faces, view: Row) -> Hits:
    """Every face of `faces`, in the camera's frame, that covers a pixel's centre or comes within `EDGE_PX` of it."""
    edges, planes = _projected(faces, view)
    face, column, row = _reach(faces, edges, view)
    at = np.stack([column + 0.5, row + 0.5, np.ones(len(face))], axis=1)
    inside = np.einsum("nij,nj->ni", edges[face], at).min(axis=1)
    near = inside >= -EDGE_PX
    face, at, inside, pixel = face[near], at[near], inside[near], (row * view["width"] + column)[near]
    z = np.maximum(faces.points[..., 2], NEAR_M)
    least, most = 1.0 / z.max(axis=1)[face], 1.0 / z.min(axis=1)[face]
    with np.errstate(invalid="ignore", over="ignore"):
        plane = np.nan_to_num((planes[face] * at).sum(axis=1), nan=0.0)
        inverse = np.clip(plane, least, most)
        per_px = np.nan_to_num(np.hypot(*planes[face, :2].T), nan=np.inf)
    normals, _ = faces.plane_normals
    rays = (at - [view["cx"], view["cy"], 0.0]) / [view["fx"], view["fy"], 1.0]
    slope = np.abs((normals[face] * rays).sum(axis=1))
    sure, edge_on = inside > EDGE_PX, slope < GRAZING * np.linalg.norm(rays, axis=1)
    reach = per_px * np.where(sure, np.where(edge_on, GRAZING_PX, DRAWN_PX), EDGE_PX)
    stored = np.where(sure | (plane <= 0.0), inverse, plane)
    low = 1.0 / np.maximum(np.clip(inverse + reach, least, most), stored)
    high = 1.0 / np.minimum(np.clip(inverse - reach, least, most), stored)
    slack = np.minimum(faces.rounding_m[face] / np.maximum(slope, 1e-300), 1.0 / least - 1.0 / most + 1e-6)
    hits = Hits(pixel, face, 1.0 / inverse, low - slack, high + slack, inside >= 0.0, sure)
    beyond = hits.where(hits.z > NEAR_M)
    return beyond.where(np.lexsort((beyond.z, beyond.pixel)))


def _projected(faces: Faces, view: Row) -> tuple[Array, Array]:
    """(edges [F, 3, 3], planes [F, 3]): edge (u, v, 1) is a pixel's distance within an edge, plane (u, v, 1) is 1 / z.

    With d the ray through (u, v), v_j x v_k . d = 0 on the projected edge from corner j to corner k.
    """
    corners, lens = faces.points, np.array([view["fx"], view["fy"], 1.0])

    def in_pixels(lines: Array) -> Array:
        lines = lines / lens
        return np.concatenate(
            [lines[..., :2], lines[..., 2:] - lines[..., :2] @ np.array([[view["cx"]], [view["cy"]]])], axis=-1
        )

    lines = np.cross(np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1))
    volume = (corners[:, 0] * lines[:, 0]).sum(axis=1)
    edges = in_pixels(lines * np.where(volume < 0.0, -1.0, 1.0)[:, None, None])
    edges /= np.maximum(np.hypot(edges[..., 0], edges[..., 1]), 1e-300)[..., None]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        return edges, in_pixels(normal) / volume[:, None]


def choices(faces: Faces, hits: Hits) -> Iterator[NDArray[np.int64]]:
    """Numbers of the hits of one pixel that may be met together: the sure ones, and of others what closed bodies allow."""
    region, closed = faces.region[hits.face], faces.closed[hits.face]
    unsure = np.flatnonzero(~hits.sure)
    for taken in itertools.product((False, True), repeat=len(unsure)):
        there = hits.sure.copy()
        there[unsure] = taken
        if not (np.bincount(region[there & closed]) % 2).any():
            yield np.flatnonzero(there)


def on_edges(points: Array, corners: Array) -> Array:
    """[N, 3]: the weights of the corners [N, 3, 3] of faces with which they add up to the edges' nearest points to `points`."""
    along = np.roll(corners, -1, axis=1) - corners
    apart = points[:, None] - corners
    share = np.clip((apart * along).sum(axis=2) / np.maximum((along * along).sum(axis=2), 1e-300), 0.0, 1.0)
    side = np.linalg.norm(apart - share[..., None] * along, axis=2).argmin(axis=1)
    weights, every = np.zeros((len(points), 3)), np.arange(len(points))
    weights[every, (side + 1) % 3] = share[every, side]
    weights[every, side] = 1.0 - share[every, side]
    return weights


def seen_by(view: Row, faces: Faces, points: Array, face: NDArray[np.int64], other: Array) -> NDArray[np.int64]:
    """[N]: 1 where a camera sees points [N, 3] of these faces [N] in its image, from the side of `other` [3]; 0 where not.

    All in the camera's frame, metres. -1 where that is not sure: another answer holds for a point moved by `ROUNDING_PX` in the
    image, for half or twice `BEHIND_M`, or for a face turned by its rounding.
    """
    edges, planes = _projected(faces, view)
    normals, heights = faces.plane_normals
    here, there = (((origin - points) * normals[face]).sum(axis=1) for origin in (np.zeros(3), other))
    slack = np.linalg.norm(points, axis=1) * 2.0 * faces.rounding_m[face] / np.maximum(heights[face], 1e-300)
    at = points / points[:, 2:] * [view["fx"], view["fy"], 1.0] + [view["cx"], view["cy"], 0.0]
    margin = np.minimum(at[:, :2], [view["width"], view["height"]] - at[:, :2]).min(axis=1)
    answers = np.where((margin < 0.0) | (here * there < 0.0) | (points[:, 2] < NEAR_M), 0, 1)
    answers[(np.abs(margin) < ROUNDING_PX) | (np.abs(here) < slack)] = -1
    for n in np.flatnonzero(answers == 1):
        inside = (edges @ at[n]).min(axis=1)
        near = np.flatnonzero(inside > -ROUNDING_PX)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = 1.0 / (planes[near] @ at[n])
        behind_m = np.abs(((points[n] - faces.points[near, 0]) * normals[near]).sum(axis=1))
        before = (z > NEAR_M) & (z < points[n, 2])
        if (before & (inside[near] > ROUNDING_PX) & (behind_m > 2.0 * BEHIND_M)).any():
            answers[n] = 0
        elif (before & (behind_m > 0.5 * BEHIND_M)).any():
            answers[n] = -1
    return answers


def _reach(faces: Faces, edges: Array, view: Row) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """(face, column, row), each [N]: pixels in a face's box and within `EDGE_PX` of its inside, row by row."""
    z = faces.points[..., 2]
    whole = z.min(axis=1) > NEAR_M
    safe = np.where(whole[:, None], z, 1.0)
    u = view["fx"] * faces.points[..., 0] / safe + view["cx"]
    v = view["fy"] * faces.points[..., 1] / safe + view["cy"]
    # A face that reaches nearer has no box: its pixels may be anywhere.
    left, top = (np.where(whole, at.min(axis=1), -np.inf) for at in (u, v))
    right, bottom = (np.where(whole, at.max(axis=1), np.inf) for at in (u, v))
    seen = z.max(axis=1) > NEAR_M
    first, last = _centres(top, bottom, view["height"])
    face, row = _ranges(first, np.where(seen, last, first - 1))
    a, b, c = np.moveaxis(edges[face], 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = b * (row[:, None] + 0.5) + c + EDGE_PX
        limit = -rest / a
    low = np.where(a > 0.0, limit, np.where((a == 0.0) & (rest < 0.0), np.inf, -np.inf)).max(axis=1)
    high = np.where(a < 0.0, limit, np.inf).min(axis=1)
    number, column = _ranges(*_centres(np.maximum(low, left[face]), np.minimum(high, right[face]), view["width"]))
    return face[number], column, row[number]


def _centres(low: Array, high: Array, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(first, last) of `size` pixels whose centres lie from `low` to `high`, or so near that an edge may have moved there."""
    reach = EDGE_PX + 1e-9
    first, last = np.ceil(low - 0.5 - reach), np.floor(high - 0.5 + reach)
    return np.clip(first, 0, size).astype(np.int64), np.clip(last, -1, size - 1).astype(np.int64)


def _ranges(first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(number of the range, value): every whole number from `first` to `last` of each range."""
    count = np.maximum(last - first + 1, 0)
    number = np.repeat(np.arange(len(first)), count)
    return number, np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count) + first[number]
