"""The level top of a table and its outline."""

import math
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.base import Array, Pose, frozen_array
from schemas.errors import StartError
from schemas.scene.plan import Table, TableTop
from schemas.scene.shape import Asset, Mesh, Shape
from workers.geometry.bounds import bounds_of
from workers.geometry.convexity import face_areas, face_normals, numbers_in, piece_of
from workers.geometry.elevation import sample_elevation
from workers.geometry.frames import transform, translation
from workers.geometry.jit import compiled

LEVEL = 0.999
"""Cosine to the vertical of a face that counts as level: 2.6 degrees."""

SAME_LEVEL_M = 1e-4
"""Greatest difference in height of faces of one level."""

TOP_SHARE = 0.5
"""The top is the highest level with at least this share of the largest level's area, which excludes shelves and rims."""

FILLED_SHARE = 0.999
"""A top that fills this share of its convex hull is convex and without holes."""


def find_table_top(shape: Shape) -> TableTop:
    """The level top of a table mesh. Raises StartError where no face is level."""
    vertices, faces = shape.vertices, shape.faces
    # Both sides count: external tables may be wound inside out. Height selects the upper side of a slab.
    level = faces[np.abs(face_normals(np.ascontiguousarray(vertices), faces)[:, 2]) > LEVEL]
    if not len(level):
        raise StartError("no_table_top", "the table's mesh has no level face within 2.6 degrees: leave this table out")
    _, inverse = np.unique(np.round(vertices[:, 2][level].sum(axis=1) / (3 * SAME_LEVEL_M)), return_inverse=True)
    area = np.bincount(inverse, weights=face_areas(np.ascontiguousarray(vertices), level))
    top = int(np.flatnonzero(area >= TOP_SHARE * area.max()).max())
    points = vertices[numbers_in(level[inverse == top], len(vertices))]
    return _describe(points, float(area[top]), float(vertices[:, 2].max()))


def _describe(points: Array, area_m2: float, highest_m: float) -> TableTop:
    height = float(points[:, 2].max())
    try:
        hull = ConvexHull(points[:, :2])
    except QhullError as error:
        raise StartError("no_table_top", "the table's level faces have no area: leave this table out") from error
    # A face that leans within `LEVEL` is not flat: a level plane at its highest point would not stand for it.
    even = height - float(points[:, 2].min()) <= SAME_LEVEL_M
    convex = even and area_m2 >= FILLED_SHARE * hull.volume and highest_m <= height + SAME_LEVEL_M
    middle = bounds_of(points[:, :2]).sum(axis=0) / 2
    return TableTop(height, frozen_array(middle), frozen_array(points[hull.vertices, :2]), bool(convex))


def place_table(asset: Asset) -> Table:
    """The table on the floor, the centre of its top over the origin. Raises StartError where it has no level top.

    Found once for each asset, and kept as long as that is.
    """
    if (placed := _placed.get(asset)) is None:
        placed = _placed[asset] = _place(asset)
    return Table(asset, *placed)


_placed: WeakKeyDictionary[Asset, tuple[Pose, Mesh, TableTop]] = WeakKeyDictionary()


def _place(asset: Asset) -> tuple[Pose, Mesh, TableTop]:
    top = find_table_top(asset.shape)
    lowest = float(asset.shape.bounds[0, 2])
    T = translation(-top.centre[0], -top.centre[1], -lowest)
    mesh = Mesh(frozen_array(transform(T, asset.shape.vertices)), asset.shape.faces)
    outline, centre = frozen_array(top.outline - top.centre), frozen_array([0.0, 0.0])
    return frozen_array(T), mesh, TableTop(top.height_m - lowest, centre, outline, top.convex)


def inside_margin(points_xy: Array, outline: Array) -> Array:
    """[N] float64 metres: depth of each point inside a convex polygon [M, 2], counter-clockwise; negative outside.

    The least signed distance to the polygon's edge lines.
    """
    return _least_distances(np.ascontiguousarray(points_xy), outline)


@compiled
def _least_distances(points: Array, outline: Array) -> Array:
    """The least signed distance [N] of points to the lines through the edges of a polygon, those without length left out."""
    least = np.full(len(points), np.inf)
    for m in range(len(outline)):
        start, end = outline[m], outline[(m + 1) % len(outline)]
        x, y = end[0] - start[0], end[1] - start[1]
        length = math.sqrt(x * x + y * y)
        if length > 0.0:
            for n in range(len(points)):
                depth = (x * (points[n, 1] - start[1]) - y * (points[n, 0] - start[0])) / length
                least[n] = min(least[n], depth)
    return least


def support_height(points_xy: Array, table: Mesh) -> float:
    """Height of the table's highest point below, or within the bounding box of, points [N, 2]; -inf off the table."""
    (left, front), (right, back) = bounds_of(points_xy)
    x, y, z = table.vertices.T
    inside = (x >= left) & (x <= right) & (y >= front) & (y <= back)
    highest = np.fmax.reduce(sample_elevation(points_xy, table), initial=-np.inf)
    return float(np.max(z[inside], initial=highest))


def split_by_side(mesh: Mesh) -> tuple[Mesh, ...]:
    """The faces of a mesh by the axis, of six, that their normals are nearest to; those without area are left out.

    Bullet keeps four contacts of two bodies. Of a body that stands in a corner, a wall would take those that the floor needs.
    """
    normal = face_normals(np.ascontiguousarray(mesh.vertices), mesh.faces)
    axis = np.abs(normal).argmax(axis=1)
    along = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0]
    side = np.where(along == 0.0, -1, 2 * axis + (along < 0.0))
    return tuple(piece_of(mesh, mesh.faces[side == number]) for number in range(6) if (side == number).any())
