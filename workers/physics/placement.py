"""How an object lies on a table: the gap that is closed at last, its contacts, and whether they hold it. Pure geometry."""

from dataclasses import dataclass

import numpy as np

from schemas.base import Pose
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import Mesh
from workers.geometry.convexity import solid_of, weld
from workers.geometry.elevation import Terrain, prepare_terrain
from workers.geometry.frames import transform, translation
from workers.physics.equilibrium import FIXED, Contact, Weight, contact_points, equilibrium_residual, support_margin_m
from workers.physics.rest_pose import CONTACT_M
from workers.physics.separation import above_ground, between, ground_gap_m

LEFT_M = 0.05
"""An object whose table, or whose centre of mass, lies this far below the table's top has left it."""

HOOKED_M = 0.03
"""An object that reaches this far below the table's top may have part of the table above part of it."""

FARTHEST_M = 0.01
"""How far convex parts by CoACD stand out of a surface at most, and so how far an object hovers before it is set down."""

NEAREST_M = 1e-6
"""To what a distance is told."""

MOST_STEPS = 16
"""Lowered by its distance each time, an object comes to touch in a few steps, unless it slides past."""

HELD_FROM = 0.3
"""A contact holds an object up where its normal's part along z is more than this."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A table, and its mesh made ready for heights."""

    table: Table
    terrain: Terrain


@dataclass(frozen=True)
class Support:
    """What holds an object up.

    margin_m: how far its centre of mass projects inside the hull of the contacts from below; residual: the share of its
    weight that they cannot balance; highest_m: world z of the highest of them.
    """

    margin_m: float
    residual: float
    highest_m: float


def ground_of(table: Table) -> Ground:
    """The table made ready."""
    return Ground(table, prepare_terrain(table.mesh))


def placed_mesh(start: ObjectStart, T_world_obj: Pose) -> Mesh:
    """The object's mesh in world coordinates."""
    shape = start.asset.shape
    return Mesh(transform(T_world_obj, shape.vertices), shape.faces)


def gap_m(start: ObjectStart, T_world_obj: Pose, ground: Ground) -> float:
    """Metres between object and table, negative where they overlap; inf where neither is above the other.

    Along z for what stands on the table, where that is exact but for edges that cross. For what may be hooked to it the
    least distance, or minus the least width of what both share, where both enclose bodies.
    """
    mesh = placed_mesh(start, T_world_obj)
    if not _hooked(mesh, ground):
        return ground_gap_m(mesh, ground.terrain)
    solids = solid_of(weld(mesh)), solid_of(weld(ground.table.mesh))
    if solids[0] is not None and solids[1] is not None:
        return between(solids[0], solids[1])
    return _distance_m(mesh, ground)


def touch_down(start: ObjectStart, T_world_obj: Pose, ground: Ground) -> Pose:
    """The pose moved along z until the meshes just touch.

    What may be hooked to the table is only lowered.
    """
    mesh = placed_mesh(start, T_world_obj)
    if not _hooked(mesh, ground):
        return translation(0.0, 0.0, -above_ground(mesh, ground.terrain)[0]) @ T_world_obj
    T = T_world_obj
    for _ in range(MOST_STEPS):
        distance = _distance_m(placed_mesh(start, T), ground)
        if distance <= CONTACT_M / 2 or not np.isfinite(distance):
            break
        T = translation(0.0, 0.0, -distance) @ T
    return T


def support_of(start: ObjectStart, T_world_obj: Pose, ground: Ground, friction: float) -> Support:
    """How the table holds the object up, at contacts between their meshes; `friction` is the coefficient between them."""
    mesh = placed_mesh(start, T_world_obj)
    com = transform(T_world_obj, start.asset.mass.com[None, :])[0]
    points, normals = contact_points(mesh, ground.table.mesh, CONTACT_M)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    weight = Weight(start.asset.mass.mass_kg, com, size)
    residual = float(equilibrium_residual([weight], [Contact(0, FIXED, points, normals)], friction)[0])
    held = points[normals[:, 2] > HELD_FROM]
    margin = support_margin_m(held, com) if len(held) else -size
    return Support(margin, residual, float(points[:, 2].max(initial=-np.inf)))


def _hooked(mesh: Mesh, ground: Ground) -> bool:
    return bool(mesh.vertices[:, 2].min() < ground.table.top.height_m - HOOKED_M)


def _distance_m(mesh: Mesh, ground: Ground) -> float:
    """The least distance between two meshes, to `NEAREST_M`; inf where it is more than `FARTHEST_M`."""
    if len(contact_points(mesh, ground.table.mesh, FARTHEST_M)[0]) == 0:
        return np.inf
    low, high = 0.0, FARTHEST_M
    while high - low > NEAREST_M:
        middle = (low + high) / 2
        near = len(contact_points(mesh, ground.table.mesh, middle)[0]) > 0
        low, high = (low, middle) if near else (middle, high)
    return high
