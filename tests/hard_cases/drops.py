"""What a case lets fall: an object, where it starts, and the table below it; and tables that are hard to stand on."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh

from schemas.base import Array, frozen_array
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import Asset
from tests.kit.shapes import box, shape_of
from tests.kit.shapes import table as plain_table
from workers.geometry.frames import pose, rotation_about, transform, translation
from workers.geometry.hull import convex_hull
from workers.physics.support import place_table, support_height

EDGE_M = 0.7
"""Where every table here ends, along x."""

X, Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class Drop:
    """An object at release, and its table."""

    start: ObjectStart
    table: Table

    @property
    def starts(self) -> tuple[ObjectStart, ...]:
        """The object, as one of several would be."""
        return (self.start,)


def turn(axis: Array, degrees: float) -> Array:
    """[3, 3]: a right-handed turn about a unit axis."""
    return rotation_about(axis, math.radians(degrees))


def drop(
    asset: Asset, table: Table, clearance_m: float = 0.005, R: Array | None = None, xy: tuple[float, float] = (0.0, 0.0)
) -> Drop:
    """The centre of mass over `xy`, the lowest point `clearance_m` above what is below, as `plan.set_down` has it."""
    hull, R = convex_hull(asset.shape.vertices), np.eye(3) if R is None else R
    com = R @ asset.mass.com
    T = pose(R, np.array([xy[0] - com[0], xy[1] - com[1], 0.0]))
    points = transform(T, hull.vertices)
    below = support_height(points[:, :2], table.mesh)
    below = below if math.isfinite(below) else table.top.height_m  # over a hole there is nothing
    T = frozen_array(translation(0.0, 0.0, clearance_m + below - points[:, 2].min()) @ T)
    return Drop(ObjectStart(asset, hull, 3, T, 0, False), table)


def lowered(case: Drop, by_m: float) -> Drop:
    """The same, starting lower."""
    T = frozen_array(translation(0.0, 0.0, -by_m) @ case.start.T_world_obj)
    return Drop(dataclasses.replace(case.start, T_world_obj=T), case.table)


# ---------------------------------------------------------------------------------------------- tables


def level(thick_m: float = 0.03) -> Table:
    """1.4 m square, on four legs."""
    return place_table(plain_table(thick_m=thick_m))


def table_of(*meshes: trimesh.Trimesh) -> Table:
    """A table of any meshes; tables are not weighed."""
    return place_table(dataclasses.replace(plain_table(), shape=shape_of(*meshes)))


def slope(degrees: float) -> Table:
    """A slab 1.4 m square that falls towards +x."""
    slab = box(1.4, 1.4, 0.03, (0, 0, 0.7))
    slab.apply_transform(pose(turn(Y, degrees), np.zeros(3)))
    return table_of(slab)


def ring(thick_m: float = 0.03) -> Table:
    """A disc 1.4 m across with a hole of 0.4 m."""
    return table_of(trimesh.creation.annulus(r_min=0.2, r_max=EDGE_M, height=thick_m, sections=64))


def with_raised_ring() -> Table:
    """A level table that carries a ring of 100 mm across, 5 mm high."""
    hoop = trimesh.creation.annulus(r_min=0.046, r_max=0.05, height=0.005, sections=48)
    hoop.apply_translation((0, 0, 0.7025))
    return table_of(box(1.4, 1.4, 0.03, (0, 0, 0.685)), hoop)


def with_hole(side_m: float) -> Table:
    """A slab with a square hole in its middle."""
    outer, hole = shapely.box(-EDGE_M, -EDGE_M, EDGE_M, EDGE_M), shapely.box(*(s * side_m / 2 for s in (-1, -1, 1, 1)))
    return table_of(trimesh.creation.extrude_polygon(outer.difference(hole), 0.03))


def sheet() -> Table:
    """A square without thickness."""
    corners = [(x * EDGE_M, y * EDGE_M, 0.7) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return table_of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))


def with_peg() -> Table:
    """A slab with a tongue 8 mm wide, 5 mm thick and 100 mm long that goes on from its edge, level with its top."""
    plan = shapely.union(shapely.box(-EDGE_M, -EDGE_M, EDGE_M, EDGE_M), shapely.box(0.6, -0.004, 0.8, 0.004))
    whole = trimesh.creation.extrude_polygon(plan, 0.005)
    table = table_of(whole)
    # Tables are centred on their outline; the peg makes this one's lopsided, and the edge belongs at EDGE_M.
    assert math.isclose(float(table.mesh.vertices[:, 0].max()), 0.75)
    return table
