"""A ray caster in float64 on Embree: the slow, independent reference for what a camera sees at its pixel centres.

Embree, in its watertight mode, only finds the triangle that a ray meets; the distance is computed again in float64
from that triangle's plane, so that neither Embree's float32 nor the rasteriser limits it. Each thing is cast on its own:
so ties between coplanar faces of two things are found and go to the lower region id. Both sides of every face count.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
import shapely
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.scene import Placed
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import NEAR_M, project_bounds, unproject
from workers.geometry.distance import dot
from workers.geometry.frames import invert, transform
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import face_planes


@compiled_for("i4[::1], Tuple((f8[:,::1], f8[::1])), f8[:,::1], f8[:,::1], f8")
def meet_planes(
    face: NDArray[np.int32], planes: tuple[Array, Array], origins: Array, directions: Array, grazing: float
) -> tuple[Array, Array, int]:
    """(distance, cosine, n): where rays [N, 3] meet the planes of faces [N], and how many of them a plane does not fix.

    planes: normals [F, 3] and offsets [F]. Distances, in lengths of the direction, are inf for face -1, and nan where the
    cosine of incidence is at most `grazing`.
    """
    normals, offsets = planes
    distance, cosine, open_ended = np.full(len(face), np.inf), np.zeros(len(face)), 0
    for n in range(len(face)):
        f = face[n]
        if f < 0:
            continue
        towards = dot(normals[f], directions[n])
        cosine[n] = abs(towards) / math.sqrt(dot(directions[n], directions[n]))
        if cosine[n] > grazing:
            distance[n] = (offsets[f] - dot(normals[f], origins[n])) / towards
        else:
            distance[n] = np.nan
            open_ended += 1
    return distance, cosine, open_ended


COPLANAR_M = 1e-6
"""Surfaces nearer than this along the normal count as one: ten times what float32 coordinates of a scene
a few metres across resolve, and a hundredth of the smallest gap that physics leaves."""

GRAZING = 1e-6
"""Cosine of incidence below which the plane does not fix the distance, and Embree's is used."""

RAYS_AT_ONCE = 8_192
"""Rays of one call: a megabyte of intermediate arrays, which a processor's cache holds."""

FEW_PIXELS = 16
"""Up to so many, passes over all edges for each pixel cost less than a search tree of the edges."""


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of rays.

    distance [N] float64, in lengths of each ray's direction, inf where nothing is met; region [N] uint8, 0 there;
    incidence_cos [N] float32, cosine of the angle between ray and face normal in [0, 1], 0 there.
    """

    distance: Array
    region: NDArray[np.uint8]
    incidence_cos: NDArray[np.float32]

    def keep_nearer(self, rays: NDArray[np.int64], distance: Array, cosine: Array, region_id: int) -> None:
        """Writes hits of the rays with these numbers that are nearer by more than `COPLANAR_M` along the normal, in place."""
        nearer = distance + COPLANAR_M / np.maximum(cosine, GRAZING) < self.distance[rays]
        rays = rays[nearer]
        self.distance[rays], self.incidence_cos[rays], self.region[rays] = distance[nearer], cosine[nearer], region_id


def cast_view(things: Sequence[Placed], camera: Camera) -> tuple[Array, NDArray[np.uint8], NDArray[np.float32]]:
    """The view of a camera through every pixel's centre (column + 0.5, row + 0.5).

    Returns depth_m [H, W] float64, z along the optical axis in metres, 0 where nothing is hit; region [H, W] uint8;
    incidence_cos [H, W] float32. Surfaces with z below `NEAR_M` are passed through.
    """
    k = camera.intrinsics
    best = _no_hits(k.height * k.width)
    for thing in sorted(things, key=attrgetter("region_id")):
        mesh = _in_camera(thing, camera)
        rows, columns = _pixels_in_reach(mesh, k)
        caster = Caster(mesh)
        for some in _blocks(len(rows)):
            rays = unproject(rows[some], columns[some], np.ones(len(rows[some])), k)
            distance, cosine = caster.cast(NEAR_M * rays, rays)
            best.keep_nearer(rows[some] * k.width + columns[some], distance + NEAR_M, cosine, thing.region_id)
    depth, shape = np.where(np.isinf(best.distance), 0.0, best.distance), (k.height, k.width)
    return depth.reshape(shape), best.region.reshape(shape), best.incidence_cos.reshape(shape)


def first_hit(things: Sequence[Placed], origins: Array, directions: Array) -> Hits:
    """The first surface that each ray meets; origins and directions [N, 3] float64, world, metres.

    Keep origins within some metres of the things: Embree holds coordinates in float32.
    """
    best = _no_hits(len(origins))
    everything = np.arange(len(origins))
    for thing in sorted(things, key=attrgetter("region_id")):
        caster = Caster(Mesh(transform(thing.T_world_shape, thing.shape.vertices), thing.shape.faces))
        for some in _blocks(len(origins)):
            best.keep_nearer(everything[some], *caster.cast(origins[some], directions[some]), thing.region_id)
    return best


def edge_distance_px(things: Sequence[Placed], camera: Camera, pixels: NDArray, outline_only: bool = False) -> Array:
    """Distance, pixels, from each pixel's centre to the nearest projected triangle edge of any thing; [N] float64.

    pixels [N, 2] are (row, column). Edges are cut at the near plane; inf where no edge is in front of the camera. With
    `outline_only`, only edges at which a mask can end count: those of a boundary, of a fold (more than two faces), and
    those between a front-facing and a back-facing triangle. Lines along which surfaces intersect one another are no edges.
    """
    points = np.asarray(pixels, dtype=np.float64)[:, ::-1] + 0.5
    centres = shapely.points(points)
    nearest = np.full(len(centres), np.inf)
    for thing in things:
        mesh = _in_camera(thing, camera)
        edges = np.stack(_project_edges(mesh, _edges(mesh, outline_only), camera), axis=1)
        if len(points) <= FEW_PIXELS:
            edges = edges[_may_be_nearest(edges, points)]
        (own, _), distance = shapely.STRtree(shapely.linestrings(edges)).query_nearest(
            centres, return_distance=True, all_matches=False
        )
        nearest[own] = np.minimum(nearest[own], distance)
    return nearest


def _blocks(count: int) -> Iterator[slice]:
    """So many rays, `RAYS_AT_ONCE` at a time."""
    return (slice(first, first + RAYS_AT_ONCE) for first in range(0, count, RAYS_AT_ONCE))


def _in_camera(thing: Placed, camera: Camera) -> Mesh:
    return Mesh(transform(invert(camera.T_world_cam) @ thing.T_world_shape, thing.shape.vertices), thing.shape.faces)


def _no_hits(count: int) -> Hits:
    return Hits(np.full(count, np.inf), np.zeros(count, np.uint8), np.zeros(count, np.float32))


def _pixels_in_reach(mesh: Mesh, k: Intrinsics) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(rows, columns) of the pixels whose rays can meet a mesh in the camera's frame, row by row.

    Those of the box about it in the image, a pixel wider on each side; all where a corner is not beyond the near plane, where it
    has no place in the image.
    """
    if not len(mesh.faces):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    left, top, right, bottom = np.clip(project_bounds(mesh.vertices, k, NEAR_M), -1.0, [k.width, k.height] * 2)
    rows, columns = np.arange(k.height), np.arange(k.width)
    rows, columns = (
        rows[(rows >= top - 2) & (rows <= bottom + 1)],
        columns[(columns >= left - 2) & (columns <= right + 1)],
    )
    return np.repeat(rows, len(columns)), np.tile(columns, len(rows))


class Caster:
    """A mesh in Embree's tree, for rays in the mesh's own frame."""

    def __init__(self, mesh: Mesh) -> None:
        self._empty = not len(mesh.faces)  # Embree does not take empty scenes
        if self._empty:
            return
        self._scene = EmbreeScene(robust=True)
        faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
        self._geometry = TriangleMesh(self._scene, mesh.vertices.astype(np.float32), faces)
        self._planes = face_planes(mesh)

    def cast(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """(distance, incidence_cos), each [N] float64: distance inf and cosine 0 where the ray meets nothing."""
        if self._empty or not len(origins):
            return np.full(len(origins), np.inf), np.zeros(len(origins))
        rays = origins.astype(np.float32), directions.astype(np.float32)
        face = self._scene.run(*rays)  # without distances: embreex takes long to hand them over
        distance, cosine, grazing = meet_planes(face, self._planes, origins, directions, GRAZING)
        if grazing:
            these = np.flatnonzero(np.isnan(distance))
            distance[these] = self._scene.run(rays[0][these], rays[1][these], query="DISTANCE")
        return distance, cosine


def _edges(mesh: Mesh, outline_only: bool) -> NDArray[np.int64]:
    """[E, 2]: the vertex pairs of all edges; or of those without exactly two faces, or whose faces show different sides.

    Vertices at one place count as one, because seams of texture and shading split them.
    """
    _, first, welded = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    faces = welded.reshape(-1)[mesh.faces].astype(np.int64)
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs = np.sort(directed, axis=1)
    key, group, count = np.unique(pairs[:, 0] * len(first) + pairs[:, 1], return_inverse=True, return_counts=True)
    if outline_only:
        front = np.repeat(face_planes(mesh)[1] < 0.0, 3)
        side = np.where(front == (directed[:, 0] <= directed[:, 1]), 1, -1)
        key = key[(count != 2) | (np.bincount(group.reshape(-1), weights=side, minlength=len(key)) != 0)]
    return first[np.stack(np.divmod(key, len(first)), axis=1)]


def _project_edges(mesh: Mesh, edges: NDArray[np.int64], camera: Camera) -> tuple[Array, Array]:
    """(starts, ends), each [E', 2] float64: image coordinates of the parts of edges in front of the near plane."""
    a, b = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]]
    seen = (a[:, 2] > NEAR_M) | (b[:, 2] > NEAR_M)
    a, b = a[seen], b[seen]
    k, ends = camera.intrinsics, []
    for near, far in ((a, b), (b, a)):
        gap = np.where(far[:, 2] == near[:, 2], 1.0, far[:, 2] - near[:, 2])
        share = np.where(near[:, 2] < NEAR_M, (NEAR_M - near[:, 2]) / gap, 0.0)[:, None]
        cut = near + share * (far - near)
        z = np.maximum(cut[:, 2], NEAR_M)
        ends.append(np.stack([k.fx * cut[:, 0] / z + k.cx, k.fy * cut[:, 1] / z + k.cy], axis=1))
    return ends[0], ends[1]


def _may_be_nearest(edges: Array, points: Array) -> NDArray[np.bool_]:
    """[E]: whether the box of an edge [E, 2, 2] is as near to one of the points [N, 2] as the nearest start of an edge."""
    low, high, near = edges.min(axis=1), edges.max(axis=1), np.zeros(len(edges), dtype=np.bool_)
    for point in points:
        outside = np.maximum(np.maximum(low - point, point - high), 0.0)
        to_start = np.hypot(*(edges[:, 0] - point).T).min(initial=np.inf)
        near |= np.hypot(*outside.T) <= to_start + 1e-6  # what rounding may add
    return near
