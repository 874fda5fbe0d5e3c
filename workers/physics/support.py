"""What objects stand on: the elevation of meshes, rest poses on a level support, and the level top of a table. Pure."""

import math
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from schemas.base import Array, Pose, frozen_array
from schemas.errors import StartError
from schemas.scene.scene import Table, TableTop
from schemas.scene.shape import Asset, Hull, Mesh, Shape
from workers.geometry.frames import DOWN, pose, rotation_between, transform, translation
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import bounds_of, face_areas, face_normals, numbers_in, piece_of

EDGE_SLACK = 1e-12
"""Barycentric slack, so that a point on the edge of two triangles lies in at least one of them."""

VERTICAL_M2 = 1e-18
"""Twice the area in the plane up to which a triangle is vertical."""

SAME_HEIGHT_M = 1e-9
"""A vertex this near the highest crossing of its vertical line is the top of its mesh there."""

FIRST_BAND_M = 1e-4
"""Vertices this near the lowest one are compared with the ground first: they settle the gap of an object that stands."""


def sample_elevation(points_xy: Array, ground: Mesh, highest: bool = True) -> Array:
    """[N] float64 metres: the highest, or the lowest, crossing of the mesh with vertical lines; nan where there is none.

    points_xy [N, 2] metres. Vertical triangles are left out: their edges belong to neighbours.
    """
    return _crossings(np.ascontiguousarray(points_xy), ground.vertices, ground.faces, highest)


@compiled_for("f8[:,::1], const(f8[:,::1]), const(i4[:,::1]), b1")
def _crossings(points: Array, vertices: Array, faces: NDArray[np.int32], highest: bool) -> Array:
    """[N] the highest or the lowest height at which vertical lines cross triangles [F, 3]; nan where they miss all."""
    heights = np.full(len(points), np.nan)
    left, right, front, back = np.inf, -np.inf, np.inf, -np.inf
    for n in range(len(points)):
        left, right = min(left, points[n, 0]), max(right, points[n, 0])
        front, back = min(front, points[n, 1]), max(back, points[n, 1])
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by = vertices[a, 0], vertices[a, 1], vertices[b, 0], vertices[b, 1]
        cx, cy = vertices[c, 0], vertices[c, 1]
        if min(ax, bx, cx) > right or max(ax, bx, cx) < left or min(ay, by, cy) > back or max(ay, by, cy) < front:
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > VERTICAL_M2:
            continue
        for n in range(len(points)):
            x, y = points[n, 0] - ax, points[n, 1] - ay
            wb = (x * (cy - ay) - y * (cx - ax)) / area
            if not wb >= -EDGE_SLACK:
                continue
            wc = ((bx - ax) * y - (by - ay) * x) / area
            if wc >= -EDGE_SLACK and wb + wc <= 1.0 + EDGE_SLACK:
                az = vertices[a, 2]
                z = az + wb * (vertices[b, 2] - az) + wc * (vertices[c, 2] - az)
                if not (heights[n] >= z if highest else heights[n] <= z):
                    heights[n] = z
    return heights


def vertical_gap(upper: Mesh, lower: Mesh, band_m: float = 0.02) -> float:
    """Least vertical distance from `upper` down to `lower`, metres; negative where it reaches into it.

    Both in world coordinates, the first standing on top of the second. Vertices of each are compared with faces of the
    other; that is exact unless the nearest features are two crossing edges. Of the upper mesh only vertices within
    `band_m` of its lowest point are tried. inf where nothing is above anything.
    """
    gap = _least_gap_below(upper.vertices, lower, band_m)
    bottom, top = bounds_of(upper.vertices)
    # The gap above a vertex of the lower mesh is at least its distance to the lowest point of the upper one.
    under = lower.vertices[bottom[2] - lower.vertices[:, 2] < gap]
    under = under[((under[:, :2] >= bottom[:2]) & (under[:, :2] <= top[:2])).all(axis=1)]
    if len(under):
        under = under[under[:, 2] >= sample_elevation(under[:, :2], lower) - SAME_HEIGHT_M]
        ceiling = sample_elevation(under[:, :2], upper, highest=False)
        gap = float(np.fmin.reduce(ceiling - under[:, 2], initial=gap))
    return gap


def _least_gap_below(vertices: Array, ground: Mesh, band_m: float) -> float:
    """Least height of the lowest vertices [N, 3] above the ground; inf where there is none below any."""
    z = vertices[:, 2]
    points = vertices[z <= z.min() + band_m]
    gap = np.inf
    for part in (points[:, 2] <= z.min() + FIRST_BAND_M, points[:, 2] > z.min() + FIRST_BAND_M):
        # A vertex at least the known gap above the ground's highest point cannot lessen the gap.
        tried = points[part & (points[:, 2] - ground.vertices[:, 2].max() < gap)]
        gap = float(np.fmin.reduce(tried[:, 2] - sample_elevation(tried[:, :2], ground), initial=gap))
    return gap


SAME_PLANE_M = 1e-6
"""Vertices within this height of the lowest one lie in one level face with it."""

STEADY_M = 2e-4
"""Margin of support below which a simulator may tip the object: its edges are rounded by a margin of a tenth of it."""

SNAP_RAD = 0.02
"""Angle to a face up to which an object stands on it: the simulation leaves small ones 0.2 mm out of level."""


@dataclass(frozen=True, eq=False)
class Face:
    """A steady face of a hull, turned to be level below it by `turn` [3, 3], object to world.

    margin_m: from the projected centre of mass to the face's edge; height_m: of the centre of mass over the face.
    """

    turn: Array
    margin_m: float
    height_m: float


def find_face(T_world_obj: Pose, hull: Hull, com: Array) -> Face | None:
    """The nearest steady face of an object's hull, at most `SNAP_RAD` from level; None where none is near."""
    R = T_world_obj[:3, :3]
    tilt = np.arccos(np.clip(hull.normals @ (R.T @ DOWN), -1.0, 1.0))
    near = np.flatnonzero(tilt <= SNAP_RAD)
    for index in near[np.argsort(tilt[near], kind="stable")]:
        turn = rotation_between(R @ hull.normals[index], DOWN) @ R
        points = hull.vertices @ turn.T
        lowest_m = points[:, 2].min()
        face = points[points[:, 2] <= lowest_m + SAME_PLANE_M]
        margin_m = support_margin(face[:, :2], (turn @ com)[:2])
        if margin_m > STEADY_M:
            return Face(turn, margin_m, float((turn @ com)[2] - lowest_m))
    return None


def snap_to_face(T_world_obj: Pose, hull: Hull, com: Array, known: Face | None = None) -> Pose | None:
    """Turn the object about its centre of mass, by at most `SNAP_RAD`, onto the nearest steady face of its hull.

    A simulator stops with the lowest vertices some tenths of a millimetre apart, because its collision shapes have margins.
    None where no steady face is near. The caller sets the height. known: the face, if it is already found.
    """
    face = known or find_face(T_world_obj, hull, com)
    if face is None:
        return None
    return pose(face.turn, T_world_obj[:3, :3] @ com + T_world_obj[:3, 3] - face.turn @ com)


def stands_on_face(vertices: Array, down: Array) -> bool:
    """Whether at least three vertices [N, 3] are lowest in the unit direction `down` [3]."""
    depth = vertices @ down
    return bool(np.count_nonzero(depth >= depth.max() - SAME_PLANE_M) >= 3)


def support_margin(contacts_xy: Array, com_xy: Array) -> float:
    """Metres from the projected centre of mass [2] to the edge of the hull of contact points [N, 2]; negative outside.

    For contacts on a line or a point: minus the distance to it. -inf without contacts.
    """
    if len(contacts_xy) == 0:
        return -np.inf
    outline, at = shapely.convex_hull(shapely.multipoints(contacts_xy)), shapely.points(com_xy)
    if outline.geom_type == "Polygon" and outline.contains(at):
        return float(outline.exterior.distance(at))
    return -float(outline.distance(at))


APART_M = 0.001
"""Columns nearer to each other than this count as touching."""

_ANGLES = math.pi * np.arange(90) / 90
AXES = frozen_array(np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1))
"""[90, 2] the horizontal axes that are tried for a separating plane. None is further than 1 degree from the best one, so
that two footprints of 0.2 m that are more than 4 mm apart are found to be so."""


def columns_apart(points: Array, others: Array) -> bool:
    """Whether a vertical plane separates two clouds [N, 3] by at least `APART_M` of air.

    Two bodies that fall straight down then do not meet. The theorem of the separating axis, applied to `AXES` alone:
    clouds that almost touch may count as touching.
    """
    mine, theirs = points[:, :2] @ AXES.T, others[:, :2] @ AXES.T
    gap = np.maximum(theirs.min(axis=0) - mine.max(axis=0), mine.min(axis=0) - theirs.max(axis=0))
    return bool(gap.max() >= APART_M)


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
    area = np.bincount(inverse, weights=face_areas(vertices, level))
    top = int(np.flatnonzero(area >= TOP_SHARE * area.max()).max())
    points = vertices[numbers_in(level[inverse == top], len(vertices))]
    height = float(points[:, 2].max())
    try:
        hull = ConvexHull(points[:, :2])
    except QhullError as error:
        raise StartError("no_table_top", "the table's level faces have no area: leave this table out") from error
    # A face that leans within `LEVEL` is not flat: a level plane at its highest point would not stand for it.
    even = height - float(points[:, 2].min()) <= SAME_LEVEL_M and vertices[:, 2].max() <= height + SAME_LEVEL_M
    convex = bool(even and area[top] >= FILLED_SHARE * hull.volume)
    middle = bounds_of(points[:, :2]).sum(axis=0) / 2
    return TableTop(height, frozen_array(middle), frozen_array(points[hull.vertices, :2]), convex)


def place_table(asset: Asset) -> Table:
    """The table on the floor, the centre of its top over the origin. Raises StartError where it has no level top.

    Found once for each asset, and kept as long as that is.
    """
    if asset not in _placed:
        top, lowest = find_table_top(asset.shape), float(asset.shape.bounds[0, 2])
        T = translation(-top.centre[0], -top.centre[1], -lowest)
        mesh = Mesh(frozen_array(transform(T, asset.shape.vertices)), asset.shape.faces)
        outline, centre = frozen_array(top.outline - top.centre), frozen_array([0.0, 0.0])
        _placed[asset] = frozen_array(T), mesh, TableTop(top.height_m - lowest, centre, outline, top.convex)
    return Table(asset, *_placed[asset])


_placed: WeakKeyDictionary[Asset, tuple[Pose, Mesh, TableTop]] = WeakKeyDictionary()


def inside_margin(points_xy: Array, outline: Array) -> Array:
    """[N] float64 metres: depth of each point inside a convex polygon [M, 2], counter-clockwise; negative outside.

    The least signed distance to the polygon's edge lines.
    """
    x, y = (np.roll(outline, -1, axis=0) - outline).T
    length = np.sqrt(x * x + y * y)
    right, up = (points_xy[:, axis, None] - outline[:, axis] for axis in (0, 1))
    with np.errstate(invalid="ignore"):
        depth = (x * up - y * right) / length
    least: Array = depth[:, length > 0.0].min(axis=1, initial=np.inf)
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
