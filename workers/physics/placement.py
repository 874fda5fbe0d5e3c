"""Objects on a table: the remaining gap, the final descent onto the mesh, and the contacts that hold them up. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from schemas.base import Pose
from schemas.scene.plan import ObjectStart, Table
from schemas.scene.shape import Mesh
from workers.geometry.contact_points import find_contact_points
from workers.geometry.convexity import solid_of, weld
from workers.geometry.elevation import Terrain, prepare_terrain
from workers.geometry.frames import transform, translation
from workers.physics.equilibrium import FIXED, Contact, Weight, equilibrium_residual, support_margin_m
from workers.physics.rest_pose import CONTACT_M
from workers.physics.separation import above_ground, between, find_near, ground_gap_m

HOOKED_M = 0.03
"""Depth below the table's top from which part of the table may be above part of the object."""

FARTHEST_M = 0.01
"""Greatest height of an object over the table before it is set down: CoACD's parts stand out of a surface by less."""

NEAREST_M = 1e-6
"""Resolution of distances."""

MOST_STEPS = 16
"""Bound on the steps of the descent, each by the distance left. Few are needed, unless the object slides past."""

HELD_FROM = 0.3
"""Least z component of the normal of a contact that holds an object up."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A table, and its mesh prepared for height queries."""

    table: Table

    @cached_property
    def terrain(self) -> Terrain:
        """The mesh, prepared."""
        return prepare_terrain(self.table.mesh)


@dataclass(frozen=True)
class Support:
    """The support of an object by its contacts.

    margin_m: from the projected centre of mass to the edge of the hull of the contacts that hold it up, or minus its size
    without such contacts; residual: the share of its weight that contacts cannot balance; highest_m: world z of the
    highest contact.
    """

    margin_m: float
    residual: float
    highest_m: float


def placed_mesh(start: ObjectStart, T_world_obj: Pose) -> Mesh:
    """The object's mesh in world coordinates."""
    shape = start.asset.shape
    return Mesh(transform(T_world_obj, shape.vertices), shape.faces)


def gap_m(start: ObjectStart, T_world_obj: Pose, ground: Ground) -> float:
    """Metres between object and table, negative where they overlap; inf where neither is above the other.

    Along z for an object on the table, exact except between crossing edges. For an object that may be hooked to the table
    the least distance, or minus the least width of the intersection, where both enclose bodies.
    """
    mesh = placed_mesh(start, T_world_obj)
    if not _may_be_hooked(mesh, ground):
        return ground_gap_m(mesh, ground.terrain)
    solids = solid_of(weld(mesh)), solid_of(weld(ground.table.mesh))
    if solids[0] is not None and solids[1] is not None:
        return between(solids[0], solids[1])
    return _distance_m(mesh, ground)


def touch_down(start: ObjectStart, T_world_obj: Pose, ground: Ground) -> Pose:
    """The pose moved along z until the meshes just touch; an object that may be hooked is only lowered."""
    mesh = placed_mesh(start, T_world_obj)
    if not _may_be_hooked(mesh, ground):
        return translation(0.0, 0.0, -above_ground(mesh, ground.terrain)[0]) @ T_world_obj
    T = T_world_obj
    for _ in range(MOST_STEPS):
        distance = _distance_m(placed_mesh(start, T), ground)
        if distance <= CONTACT_M / 2 or not np.isfinite(distance):
            break
        T = translation(0.0, 0.0, -distance) @ T
    return T


def measure_supports(
    starts: Sequence[ObjectStart], poses: Sequence[Pose], table: Mesh, friction: float
) -> tuple[Support, ...]:
    """The support of every object by the table and the others; `friction` is the coefficient between two of them."""
    meshes = [placed_mesh(start, T) for start, T in zip(starts, poses, strict=True)]
    coms = [transform(T, start.asset.mass.com[None, :])[0] for start, T in zip(starts, poses, strict=True)]
    weights = [
        Weight(start.asset.mass.mass_kg, com, float(np.ptp(mesh.vertices, axis=0).max()))
        for start, com, mesh in zip(starts, coms, meshes, strict=True)
    ]
    contacts = _find_contacts(meshes, table)
    residuals = equilibrium_residual(weights, contacts, friction)
    return tuple(
        _describe_support(number, contacts, weight, float(residual))
        for number, (weight, residual) in enumerate(zip(weights, residuals, strict=True))
    )


def _find_contacts(meshes: Sequence[Mesh], table: Mesh) -> list[Contact]:
    """Contacts of every mesh with the table, and of every two whose boxes are near one another."""
    found = [Contact(k, FIXED, *find_contact_points(mesh, table, CONTACT_M)) for k, mesh in enumerate(meshes)]
    pairs = find_near(meshes, 2.0 * CONTACT_M)
    return found + [Contact(i, j, *find_contact_points(meshes[i], meshes[j], CONTACT_M)) for i, j in pairs]


def _describe_support(number: int, contacts: Sequence[Contact], weight: Weight, residual: float) -> Support:
    """The support of one of the bodies that these contacts are between."""
    own = [contact for contact in contacts if number in (contact.upper, contact.lower)]
    points = np.concatenate([contact.points for contact in own])
    up = np.concatenate([contact.normals[:, 2] * (1.0 if contact.upper == number else -1.0) for contact in own])
    held = points[up > HELD_FROM]
    margin_m = support_margin_m(held, weight.com) if len(held) else -weight.size_m
    return Support(margin_m, residual, float(points[:, 2].max(initial=-np.inf)))


def _may_be_hooked(mesh: Mesh, ground: Ground) -> bool:
    return bool(mesh.vertices[:, 2].min() < ground.table.top.height_m - HOOKED_M)


def _distance_m(mesh: Mesh, ground: Ground) -> float:
    """The least distance between two meshes, to `NEAREST_M`; inf beyond `FARTHEST_M`."""
    if len(find_contact_points(mesh, ground.table.mesh, FARTHEST_M)[0]) == 0:
        return np.inf
    low, high = 0.0, FARTHEST_M
    while high - low > NEAREST_M:
        middle = (low + high) / 2
        near = len(find_contact_points(mesh, ground.table.mesh, middle)[0]) > 0
        low, high = (low, middle) if near else (middle, high)
    return high
