"""All surfaces along the rays through pixel centres, without a GPU: the nearest of each region, and every one from front to back.

Pixels are covered by the rule of the label pass (zbuffer.py), in exact integers: so a surface that bounds a body is met an even
number of times, and what is found agrees with the stored mask. Distances and points are of the faces' planes, in float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.scene import Placed
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import NEAR_M
from workers.geometry.frames import invert, transform
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.mesh import face_planes
from workers.geometry.zbuffer import Corner, covered_columns, oriented, pixel_box, to_grid

MISSED = 8.0
"""1/256 pixel: a drawn mask's pixel that no face covers has one as near as this, by a rounding."""

MOST_MISSED = 64
"""More pixels of an image are no roundings, of which there is one in 100,000 pixels: none of them is looked at."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """The faces of some things before the camera, in its frame and on its pixel grid.

    mesh: vertices [V, 3] in the camera's frame, metres, and faces [F, 3], of which what lies before the near plane is left;
    corners [V, 2] int64: vertices in 1/256 pixel from the centre of the first; planes: normals [F, 3] and offsets [F];
    region [F] uint8; closed [F] bool: whether the other side of the face is never seen; face [F]: its number in the shape that
    it is of.
    """

    mesh: Mesh
    corners: NDArray[np.int64]
    planes: tuple[Array, Array]
    region: NDArray[np.uint8]
    closed: NDArray[np.bool_]
    face: NDArray[np.int64]
    intrinsics: Intrinsics

    @property
    def k(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        k = self.intrinsics
        return k.fx, k.fy, k.cx, k.cy

    @property
    def grid(self) -> tuple[float, float, float, float]:
        """1 / fx, 1 / fy, cx, cy: what takes a pixel to its ray without a division."""
        k = self.intrinsics
        return 1.0 / k.fx, 1.0 / k.fy, k.cx, k.cy

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.intrinsics.width, self.intrinsics.height


def triangles_of(things: Sequence[Placed], camera: Camera) -> Triangles:
    """The faces of things, one or more, as this camera has them."""
    k, T_cam_world = camera.intrinsics, invert(camera.T_world_cam)
    window, meshes, corners, owners = (k.fx, k.fy, k.cx, k.cy), [], [], []
    for thing in things:
        T = T_cam_world @ thing.T_world_shape
        points = transform(T, thing.shape.vertices)
        mesh, owner = Mesh(points, thing.shape.faces), np.arange(len(thing.shape.faces))
        place, source = T.astype(np.float32), thing.shape.vertices
        if (points[:, 2] <= NEAR_M).any():
            mesh, owner = _cut_near(mesh)
            place, source = np.eye(4, dtype=np.float32), np.maximum(mesh.vertices, [-np.inf, -np.inf, NEAR_M])
        corners.append(to_grid(np.ascontiguousarray(source), place, window, k.width, k.height))
        meshes.append(mesh)
        owners.append(owner)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=False)]
    whole = Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces, dtype=np.int32))
    counts = [len(mesh.faces) for mesh in meshes]
    region = np.repeat(np.array([thing.region_id for thing in things], np.uint8), counts)
    closed = np.repeat(np.array([thing.shape.closed for thing in things]), counts)
    return Triangles(whole, np.concatenate(corners), face_planes(whole), region, closed, np.concatenate(owners), k)


def _cut_near(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """(what of a mesh lies beyond the near plane, the number of the face that each of its faces is a piece of)."""
    beyond = mesh.vertices[:, 2] > NEAR_M
    count = beyond[mesh.faces].sum(axis=1)
    whole = np.flatnonzero(count == 3)
    vertices, faces, owners = [mesh.vertices], [mesh.faces[whole]], [whole]
    free = len(mesh.vertices)
    for face in np.flatnonzero((count == 1) | (count == 2)):
        ring = mesh.vertices[mesh.faces[face]]
        piece = []
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            if a[2] > NEAR_M:
                piece.append(a)
            if (a[2] > NEAR_M) != (b[2] > NEAR_M):
                met = a + (b - a) * (NEAR_M - a[2]) / (b[2] - a[2])
                met[2] = NEAR_M
                piece.append(met)
        fan = [(free, free + n, free + n + 1) for n in range(1, len(piece) - 1)]
        vertices.append(np.array(piece))
        faces.append(np.array(fan, np.int32))
        owners.append(np.full(len(fan), face))
        free += len(piece)
    return Mesh(np.concatenate(vertices), np.concatenate(faces, dtype=np.int32)), np.concatenate(owners)


def nearest_faces(triangles: Triangles, region: NDArray[np.uint8], drawn: bool) -> tuple[NDArray[np.int32], Array]:
    """(face [H, W] int32, z [H, W] float64, metres): the nearest face of each pixel's own region [H, W], -1 and 0 without one.

    Of a mask that was drawn of these faces, a pixel whose centre none of its region covers, by a rounding of the renderer, has
    the nearest one beside it; of a photograph's it has none.
    """
    t = triangles
    return _nearest_faces(
        t.corners, t.mesh.faces, t.mesh.vertices, t.planes, (t.region, t.closed), region, t.grid, drawn
    )


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Every surface along each pixel's ray, from front to back.

    start [H * W + 1]: where the pixel's surfaces begin and end in z [N] float64, metres, and face [N] int32.
    """

    start: NDArray[np.int64]
    z: Array
    face: NDArray[np.int32]


def all_surfaces(triangles: Triangles) -> Surfaces:
    """Every face that a pixel's ray meets, either side up."""
    t = triangles
    return Surfaces(*_all_surfaces(t.corners, t.mesh.faces, t.mesh.vertices, t.planes, t.grid, t.size))


@compiled
def _depth(
    face: int,
    column: int,
    row: int,
    grid: tuple[float, float, float, float],
    planes: tuple[Array, Array],
    span: tuple[float, float],
) -> float:
    """z at which a pixel's ray meets a face's plane; within `span`, that of the face, also where it is seen edge-on."""
    normal = planes[0][face]
    along = normal[0] * ((column + 0.5 - grid[2]) * grid[0]) + normal[1] * ((row + 0.5 - grid[3]) * grid[1]) + normal[2]
    z = planes[1][face] / along if along != 0.0 else span[0]
    return min(max(z, span[0]), span[1])


@compiled
def _span(points: Array, faces: NDArray[np.int32], face: int) -> tuple[float, float]:
    """The least and the greatest z of a face's corners."""
    a, b, c = points[faces[face, 0], 2], points[faces[face, 1], 2], points[faces[face, 2], 2]
    return min(a, b, c), max(a, b, c)


@compiled_for(
    "i8[:,::1], i4[:,::1], f8[:,::1], Tuple((f8[:,::1], f8[::1])), Tuple((u1[::1], b1[::1])), const(u1[:,::1]), UniTuple(f8,4),b1"
)
def _nearest_faces(
    corners: NDArray[np.int64],
    faces: NDArray[np.int32],
    points: Array,
    planes: tuple[Array, Array],
    kinds: tuple[NDArray[np.uint8], NDArray[np.bool_]],
    region: NDArray[np.uint8],
    grid: tuple[float, float, float, float],
    drawn: bool,
) -> tuple[NDArray[np.int32], Array]:
    height, width = region.shape
    best, depth = np.full((height, width), -1, np.int32), np.zeros((height, width))
    for face in range(len(faces)):
        area, a, b, c = oriented(corners, faces, face)
        if area == 0 or (area > 0 and kinds[1][face]):
            continue
        kind, span = kinds[0][face], _span(points, faces, face)
        first, last, upper, lower = pixel_box(a, b, c, width, height)
        for row in range(upper, lower + 1):
            left, right = covered_columns(a, b, c, row, first, last)
            for column in range(left, right + 1):
                if region[row, column] != kind:
                    continue
                z = _depth(face, column, row, grid, planes, span)
                if best[row, column] < 0 or z < depth[row, column]:
                    best[row, column], depth[row, column] = face, z
    if drawn:
        _fill_missed(best, depth, corners, kinds, region, points, faces, planes, grid)
    return best, depth


@compiled
def _fill_missed(
    best: NDArray[np.int32],
    depth: Array,
    corners: NDArray[np.int64],
    kinds: tuple[NDArray[np.uint8], NDArray[np.bool_]],
    region: NDArray[np.uint8],
    points: Array,
    faces: NDArray[np.int32],
    planes: tuple[Array, Array],
    grid: tuple[float, float, float, float],
) -> None:
    """Gives a pixel of a region that none of its faces covers the one whose edge is nearest to the pixel's centre."""
    some = False
    for row in range(region.shape[0]):  # a quick look, by vectors
        here, there = best[row], region[row]
        for column in range(len(here)):
            some |= (here[column] < 0) & (there[column] > 0)
    if not some:
        return
    has_faces = np.zeros(256, np.bool_)
    for face in range(len(faces)):
        has_faces[kinds[0][face]] = True
    missed = 0
    for row in range(region.shape[0]):
        for column in range(region.shape[1]):
            missed += best[row, column] < 0 and has_faces[region[row, column]]
    if missed > MOST_MISSED:
        return
    for row in range(region.shape[0]):
        for column in range(region.shape[1]):
            if best[row, column] >= 0 or not has_faces[region[row, column]]:
                continue
            nearest = MISSED**2
            for face in range(len(faces)):
                area, a, b, c = oriented(corners, faces, face)
                if kinds[0][face] != region[row, column] or area == 0 or (area > 0 and kinds[1][face]):
                    continue
                centre = (256 * column, 256 * row)
                away = min(_square_away(a, b, centre), _square_away(b, c, centre), _square_away(c, a, centre))
                z = _depth(face, column, row, grid, planes, _span(points, faces, face))
                if away < nearest or (away == nearest and z < depth[row, column]):
                    nearest, best[row, column], depth[row, column] = away, face, z


@compiled
def _square_away(a: Corner, b: Corner, point: Corner) -> float:
    """Square of the distance of a point from an edge."""
    dx, dy, x, y = b[0] - a[0], b[1] - a[1], point[0] - a[0], point[1] - a[1]
    square = dx * dx + dy * dy
    share = min(max((x * dx + y * dy) / square, 0.0), 1.0) if square > 0 else 0.0
    return (x - share * dx) ** 2 + (y - share * dy) ** 2


@compiled_for("i8[:,::1], i4[:,::1], f8[:,::1], Tuple((f8[:,::1], f8[::1])), UniTuple(f8, 4), UniTuple(i8, 2)")
def _all_surfaces(
    corners: NDArray[np.int64],
    faces: NDArray[np.int32],
    points: Array,
    planes: tuple[Array, Array],
    grid: tuple[float, float, float, float],
    size: tuple[int, int],
) -> tuple[NDArray[np.int64], Array, NDArray[np.int32]]:
    width, height = size
    start = np.zeros(width * height + 1, np.int64)
    for face in range(len(faces)):
        area, a, b, c = oriented(corners, faces, face)
        if area != 0:
            first, last, upper, lower = pixel_box(a, b, c, width, height)
            for row in range(upper, lower + 1):
                left, right = covered_columns(a, b, c, row, first, last)
                for column in range(left, right + 1):
                    start[row * width + column + 1] += 1
    for pixel in range(width * height):
        start[pixel + 1] += start[pixel]
    z, owner, filled = np.empty(start[-1]), np.empty(start[-1], np.int32), np.zeros(width * height, np.int32)
    for face in range(len(faces)):
        area, a, b, c = oriented(corners, faces, face)
        if area == 0:
            continue
        span = _span(points, faces, face)
        first, last, upper, lower = pixel_box(a, b, c, width, height)
        for row in range(upper, lower + 1):
            left, right = covered_columns(a, b, c, row, first, last)
            for column in range(left, right + 1):
                pixel = row * width + column
                depth, place = _depth(face, column, row, grid, planes, span), start[pixel] + filled[pixel]
                filled[pixel] += 1
                while place > start[pixel] and z[place - 1] > depth:
                    z[place], owner[place] = z[place - 1], owner[place - 1]
                    place -= 1
                z[place], owner[place] = depth, face
    return start, z, owner
