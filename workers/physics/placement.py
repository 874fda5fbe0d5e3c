"""Objects at poses on a table: distances and overlaps between true meshes, and how contacts hold them up. Pure."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import manifold3d
import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.errors import SettleError
from schemas.job.assets import TABLE
from schemas.job.physics import Physics
from schemas.scene.scene import ContactForce, ObjectStart, Table
from schemas.scene.shape import REGION_TABLE, Mesh
from workers.geometry.frames import DOWN, motion_between, transform
from workers.geometry.hull import convex_hull, least_width_m
from workers.geometry.mesh import bounds_of, hold_to_one_thread, mesh_of, solid_of, weld
from workers.physics.contact_surface import Surface, crop, is_closed, surface_of
from workers.physics.contacts import Contacts, contacts_within
from workers.physics.exact_rest import FALL_M, Inertia, Motion, Rested, Thing, rest, step
from workers.physics.support import support_margin

FARTHEST_M = 0.01
"""Farthest distance that is measured: convex parts stand out of a surface by less."""

NEAR_M = 1e-3
"""Distance within which others are looked for first: what rests has one."""

NO_VOLUME = 1e-15
"""Cubic metres of overlap that are rounding alone."""


class Form:
    """A mesh with what its rest is found and measured by, made when first asked for.

    `mesh` may be a part of a `whole`, which decides what is inside. `closed`: known to have an inside; `outward`: and wound so.
    """

    def __init__(self, mesh: Mesh, whole: Mesh | None = None, closed: bool = False, outward: bool = False) -> None:
        self.mesh, self._whole, self._closed, self._outward = mesh, whole or mesh, closed or outward, outward

    @cached_property
    def surface(self) -> Surface:
        """The features that may touch others."""
        return surface_of(self.mesh, self._closed or is_closed(self._whole), self._outward)

    @cached_property
    def solid(self) -> manifold3d.Manifold | None:
        """The body that the mesh encloses; None where it encloses none, as a part of one."""
        return solid_of(self.surface.welded if self._whole is self.mesh else weld(self._whole))

    @cached_property
    def body(self) -> manifold3d.Manifold:
        """The body that the mesh encloses, or else that of its hull."""
        hold_to_one_thread()
        return self.solid or manifold3d.Manifold.hull_points(np.ascontiguousarray(self.mesh.vertices))


def find_gaps_m(forms: Sequence[Form], poses: Sequence[Pose]) -> list[float]:
    """For each form, at its pose [4, 4], the metres to the nearest other; minus the depth where it overlaps.

    The distance is that of a corner from a face or of two edges that cross, and `FARTHEST_M` where nothing is nearer. The
    depth is `overlap_m` for two solids, else that of the deepest corner or edge.
    """
    # A table need not be made a solid where no object is one, as the underside of one
    some = any(form.solid is not None for form in forms[:-1])
    solid = np.array([some and form.solid is not None for form in forms])
    gaps = [FARTHEST_M] * len(forms)
    for within_m in (NEAR_M, FARTHEST_M):
        contacts = contacts_within([form.surface for form in forms], poses, within_m)
        known = np.where(solid[contacts.upper] & solid[contacts.lower], np.maximum(contacts.gaps, 0.0), contacts.gaps)
        gaps = [min(FARTHEST_M, float(known[contacts.of(k)].min(initial=np.inf))) for k in range(len(forms))]
        if max(gaps) <= within_m:
            break
    for i, j in _find_near(forms, poses) if some else ():
        a, b = forms[i].solid, forms[j].solid
        if a is not None and b is not None and (depth_m := overlap_m(_place(a, poses[i]), _place(b, poses[j]))):
            gaps[i], gaps[j] = min(gaps[i], -depth_m), min(gaps[j], -depth_m)
    return gaps


def find_overlaps_m(forms: Sequence[Form], poses: Sequence[Pose]) -> Iterator[tuple[int, int, float]]:
    """(i, j, `overlap_m`) of every two forms whose boxes overlap; what encloses no body counts as its hull."""
    for i, j in _find_near(forms, poses):
        yield i, j, overlap_m(_place(forms[i].body, poses[i]), _place(forms[j].body, poses[j]))


def overlap_m(a: manifold3d.Manifold, b: manifold3d.Manifold) -> float:
    """The thickness of the thickest piece of the intersection of two bodies, metres; 0 where they have none.

    Its least width, or 6 V / A of its volume and area where that is less, as for a piece that is bent: three times the
    thickness of a plate, and the thickness of a cone or a cube.
    """
    hold_to_one_thread()
    pieces = [piece for piece in (a ^ b).decompose() if piece.volume() > NO_VOLUME]
    return max(
        (
            min(least_width_m(convex_hull(mesh_of(piece).vertices)), 6.0 * piece.volume() / piece.surface_area())
            for piece in pieces
        ),
        default=0.0,
    )


def _find_near(forms: Sequence[Form], poses: Sequence[Pose]) -> Iterator[tuple[int, int]]:
    """The numbers i < j of every two forms whose bounding boxes overlap."""
    if len(forms) < 2:
        return
    points = [transform(T, form.mesh.vertices[form.mesh.faces.ravel()]) for form, T in zip(forms, poses, strict=True)]
    boxes = [(each.min(axis=0, initial=np.inf), each.max(axis=0, initial=-np.inf)) for each in points]
    for i, j in itertools.combinations(range(len(forms)), 2):
        if (boxes[i][0] <= boxes[j][1]).all() and (boxes[j][0] <= boxes[i][1]).all():
            yield i, j


def _place(solid: manifold3d.Manifold, T: Pose) -> manifold3d.Manifold:
    return solid.transform(np.ascontiguousarray(T[:3]))


TOUCHING_M = 1e-5
"""Distance up to which surfaces touch: the bound on overlap and hover of what rests."""

HELD_FROM = 0.3
"""Least z component of the normal of a contact that holds an object up."""

ROOM_M = 0.04
"""Distance from the objects up to which a table is looked at: rest moves them by 32 mm at most. What stands has come to rest, and
its gap is measured up to `FARTHEST_M`."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Objects and the table below them, with all that their rest is found and measured by.

    things: the objects as bodies; forms: their meshes, and last the table's; frictions [objects + 1]: likewise, their
    coefficients, of which a contact has `contact_friction`.
    """

    starts: tuple[ObjectStart, ...]
    things: tuple[Thing, ...]
    forms: tuple[Form, ...]
    frictions: Array

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """The features of the objects, and last of the table."""
        return tuple(form.surface for form in self.forms)

    def of(self, numbers: Sequence[int]) -> "Placement":
        """Some of the objects, by their numbers, with the same table."""
        starts, things = tuple(self.starts[k] for k in numbers), tuple(self.things[k] for k in numbers)
        forms = tuple(self.forms[k] for k in (*numbers, -1))
        return Placement(starts, things, forms, self.frictions[[*numbers, -1]])

    def rest(self, poses: Sequence[Pose], most_sliding: float = math.inf, spinning_m: float = 0.0) -> Rested:
        """`rest` of the objects from these `T_world_obj`."""
        return rest(self.things, poses, self.forms[-1].surface, self.frictions, most_sliding, spinning_m)


@dataclass(frozen=True)
class Support:
    """How an object rests: `gap_m` to what it touches, negative where it overlaps, and how it is held up.

    margin_m: from the projected centre of mass to the edge of the hull of what holds it up; unbalanced: share of its weight,
    or of weight times size, that contact forces cannot balance; highest_m: world z of its highest contact.
    """

    gap_m: float
    margin_m: float
    unbalanced: float
    highest_m: float
    forces: tuple[ContactForce, ...]


def forms_of(starts: Sequence[ObjectStart]) -> tuple[Form, ...]:
    """The meshes of objects, each in its own frame."""
    return tuple(Form(start.asset.shape.mesh, outward=start.asset.shape.closed) for start in starts)


ROUNDED_M = 1e-8
"""Greatest rounding of an object's coordinates: a thousandth of the bound on its overlap."""


def require_near_origin(start: ObjectStart) -> None:
    """Raises SettleError where a mesh is so far from its own origin that its coordinates are rounded to what contacts leave."""
    far_m = float(np.abs(start.hull.vertices).max())
    if far_m * np.finfo(np.float64).eps > ROUNDED_M:
        raise SettleError(
            "unsupported",
            f"the mesh of region {start.region_id} ({start.asset.category}) lies {far_m:.3g} m from its origin, where "
            f"coordinates are rounded to {far_m * np.finfo(np.float64).eps:.1g} m: move the mesh to its origin",
        )


def place_on_top(start: ObjectStart, T_world_obj: Pose, table: Table, physics: Physics) -> Placement:
    """A single object over the table's flat top, with its underside alone, which is all that can touch there."""
    world, shape = placed_mesh(start, T_world_obj), start.asset.shape
    top = np.array([np.inf, np.inf, world.vertices[:, 2].min() + NEAR_M])
    under = Mesh(shape.vertices, crop(world, np.full(3, -np.inf), top).faces)
    form = Form(under, closed=shape.closed or is_closed(shape.mesh))
    return place((start,), (T_world_obj,), [form], table, physics, FARTHEST_M)


def place(
    starts: Sequence[ObjectStart],
    poses: Sequence[Pose],
    forms: Sequence[Form],
    table: Table,
    physics: Physics,
    room_m: float = ROOM_M,
) -> Placement:
    """The objects, as these forms, with the part of the table within `room_m` of these poses, and the settings' friction."""
    points = np.concatenate([transform(T, start.hull.vertices) for start, T in zip(starts, poses, strict=True)])
    near = crop(table.mesh, *np.add(bounds_of(points), [[-room_m], [room_m]]))
    things = tuple(Thing(form.surface, start.asset.mass) for form, start in zip(forms, starts, strict=True))
    frictions = np.array([physics.friction_of(name) for name in (*(start.asset.category for start in starts), TABLE)])
    below = Form(near, table.mesh, outward=table.asset.shape.closed)
    return Placement(tuple(starts), things, (*forms, below), frictions)


def farthest_m(starts: Sequence[ObjectStart], poses: Sequence[Pose], others: Sequence[Pose]) -> float:
    """The farthest that any point of the objects moves between two `T_world_obj`, metres."""
    each = zip(starts, poses, others, strict=True)
    return max(motion_between(start.hull.vertices, T, other)[0] for start, T, other in each)


def placed_mesh(start: ObjectStart, T_world_obj: Pose) -> Mesh:
    """The object's mesh in world coordinates."""
    return Mesh(transform(T_world_obj, start.asset.shape.vertices), start.asset.shape.faces)


def measure_supports(placement: Placement, poses: Sequence[Pose]) -> tuple[Support, ...]:
    """How every object rests at these `T_world_obj`, by contacts of at most `TOUCHING_M`."""
    gaps_m = find_gaps_m(placement.forms, (*poses, np.eye(4)))
    touching = contacts_within(placement.surfaces, (*poses, np.eye(4)), TOUCHING_M)
    contacts = replace(touching, gaps=np.zeros_like(touching.gaps))
    inertias = [thing.inertia(T) for T, thing in zip(poses, placement.things, strict=True)]
    motion = step(inertias, placement.frictions, contacts, FALL_M * DOWN)
    return tuple(
        _describe(placement, number, inertia, contacts, motion, gap)
        for number, (inertia, gap) in enumerate(zip(inertias, gaps_m, strict=False))
    )


def _describe(
    placement: Placement, number: int, body: Inertia, contacts: Contacts, motion: Motion, gap_m: float
) -> Support:
    """The support of one of the bodies that these contacts are between, whose forces lead to this motion."""
    start = placement.starts[number]
    own, upper = contacts.of(number), contacts.upper == number
    sign = np.where(upper[own], 1.0, -1.0)[:, None]
    points, normals, forces = contacts.points[own], sign * contacts.normals[own], sign * motion.forces[own]
    others = np.where(upper, contacts.lower, contacts.upper)[own]
    regions = [*(one.region_id for one in placement.starts), REGION_TABLE]
    size_m = float(np.ptp(start.hull.vertices, axis=0).max())
    moment = body.tensor @ motion.turns[number] / (body.mass_kg * size_m)
    held = points[normals[:, 2] > HELD_FROM]
    return Support(
        gap_m,
        support_margin(held[:, :2], body.com[:2]) if len(held) else -size_m,
        float(max(np.linalg.norm(motion.moves[number]), np.linalg.norm(moment))) / FALL_M,
        float(points[:, 2].max(initial=-np.inf)),
        tuple(
            ContactForce(regions[others[k]], frozen_array(points[k]), frozen_array(normals[k]), frozen_array(forces[k]))
            for k in np.flatnonzero(forces.any(axis=1))
        ),
    )
