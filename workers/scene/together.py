"""Several objects that fall together, onto the table and onto one another."""

import math
from collections.abc import Collection, Iterable, Sequence

import manifold3d
import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.errors import SettleError
from schemas.job import Physics
from schemas.scene import ObjectStart, Settled, Table
from schemas.shape import Mesh
from workers.geometry.convexity import solid_of, triangles_of, weld
from workers.geometry.decompose import convex_parts
from workers.geometry.frames import transform
from workers.geometry.heights import Terrain, survey, vertical_gap
from workers.geometry.hull import convex_hull
from workers.geometry.inset import least_width_m
from workers.geometry.manifold import hold_to_one_thread
from workers.scene.contact import CONTACT_M
from workers.scene.equilibrium import contact_points, support_margin_m
from workers.scene.fall import Fall, Faller, Pace, fall, make_faller
from workers.scene.support import support_height
from workers.scene.watch import Watch, watch_edge, watch_gone

LEFT_M = 0.05
"""An object whose centre of mass is this far below the table's top has left it."""

NEAR_M = 0.02
"""How far from an object the next one is looked for."""

DROP_SHARE = 0.002
"""Of the height that the highest object may fall: how far a point may go in a step, if that is more than
`physics.way_mm`. What it sinks in by is then within the thousandth of the fall's energy that may come back."""

THIN_SHARE = 0.05
"""Of the thinnest object: how far a point may go in a step at most."""

FROM_BELOW = 0.3
"""A contact holds an object up where its normal's part along z is more than this."""


def settle_together(
    starts: Sequence[ObjectStart], table: Table, physics: Physics, ran: Collection[str]
) -> tuple[Settled, ...]:
    """Drop the objects at once, wait until all rest, and measure how they rest.

    What is not convex falls as its convex parts where `decomposition` ran, else as its hull. Objects that lie on one
    another are not moved after the simulation: what is measured of gaps is the simulation's. Raises SettleError
    `not_at_rest`, `left_table` or `table_too_fine`.
    """
    fallers = [_faller(start, physics, ran) for start in starts]
    flat = "table_mesh" not in ran and table.top.convex
    motion = release(fallers, [start.T_world_obj for start in starts], starts, table, physics, ran, flat)
    if flat and motion.happened is not None:
        flat = False
        motion = release(fallers, [start.T_world_obj for start in starts], starts, table, physics, ran, flat)
    _require_rest(starts, table, motion)
    return _describe(starts, table, motion, "flat_top" if flat else "mesh")


def _faller(start: ObjectStart, physics: Physics, ran: Collection[str]) -> Faller:
    cut: Sequence[Array] = ()
    if "decomposition" in ran:
        parts = convex_parts(start.asset.shape.mesh, start.asset.sha256)
        cut = parts if len(parts) > 1 else ()
    return make_faller(start, physics, "rolling_friction" in ran, cut=cut)


def release(
    fallers: Sequence[Faller],
    poses: Sequence[Pose],
    starts: Sequence[ObjectStart],
    table: Table,
    physics: Physics,
    ran: Collection[str],
    flat: bool,
) -> Fall:
    """Let the objects go at `poses`, on the flat top or on the mesh; a watch happens where one leaves what it must not.

    The solver goes from contact to contact: what one iteration carries down a stack is one object, and by a share that
    shrinks with the ratio of the masses. So there are more for more objects; it stops where they change nothing.
    """
    hulls = [transform(T, start.hull.vertices) for T, start in zip(poses, starts, strict=True)]
    free = min(_free_m(points, table, flat) for points in hulls)
    top = table.top.height_m
    drop = max(float(points[:, 2].min()) for points in hulls) - top
    thinnest = min(least_width_m(start.hull) for start in starts)
    way = max(physics.way_mm / 1e3, DROP_SHARE * drop if flat else 0.0)
    pace = Pace(physics.step_hz, min(way, THIN_SHARE * thinnest) if "fine_step" in ran else math.inf)
    reach = max(faller.reach_m for faller in fallers)
    lowest = float(table.mesh.vertices[:, 2].min())
    watch: Watch = watch_edge(table.top.outline, reach) if flat else watch_gone(lowest - reach)
    masses = [start.asset.mass.mass_kg for start in starts]
    times = len(starts) * math.ceil(math.sqrt(max(masses) / min(masses)))
    more = physics.model_copy(update={"solver_iterations": physics.solver_iterations * times})
    ground = top if flat else table.mesh
    return fall(fallers, poses, ground, more, pace, physics.max_settle_s, max(0.0, free), (watch,))


def _free_m(points: Array, table: Table, flat: bool) -> float:
    below = table.top.height_m if flat else support_height(points[:, :2], table.mesh)
    return float(points[:, 2].min()) - below if math.isfinite(below) else 0.0


def _require_rest(starts: Sequence[ObjectStart], table: Table, motion: Fall) -> None:
    for start, T in zip(starts, motion.poses, strict=True):
        com = transform(T, start.asset.mass.com[None, :])[0]
        if com[2] < table.top.height_m - LEFT_M:
            raise SettleError(
                "left_table",
                f"after {motion.seconds:.2f} s the centre of mass of region {start.region_id} was at "
                f"({com[0]:.3f}, {com[1]:.3f}, {com[2]:.3f}) m, off the table's top: fewer objects_per_scene, a narrower "
                "start.offset_m or larger tables",
            )
    if not motion.rested:
        raise SettleError(
            "not_at_rest",
            f"something still moves at {motion.speed_m_s * 1e3:.2f} mm/s after {motion.seconds:.1f} s: raise "
            "physics.max_settle_s or physics.rolling_friction",
        )


def _describe(starts: Sequence[ObjectStart], table: Table, motion: Fall, support: str) -> tuple[Settled, ...]:
    """The figures of every rest pose, measured between the meshes and not taken from the simulator."""
    meshes = [
        Mesh(transform(T, start.asset.shape.vertices), start.asset.shape.faces)
        for start, T in zip(starts, motion.poses, strict=True)
    ]
    ground = survey(table.mesh)
    gaps = clearances(meshes, ground)
    settled = []
    for k, (start, T) in enumerate(zip(starts, motion.poses, strict=True)):
        com = transform(T, start.asset.mass.com[None, :])[0]
        settled.append(
            Settled(
                T_world_obj=frozen_array(T),
                penetration_mm=max(0.0, -gaps[k][0]) * 1e3,
                hover_gap_mm=max(0.0, gaps[k][0]) * 1e3,
                support_margin_mm=1e3 * _margin_m(k, meshes, ground, com),
                residual_speed_mm_s=motion.speed_m_s * 1e3,
                settle_s=motion.seconds,
                support=support,  # type: ignore[arg-type]
            )
        )
    return tuple(settled)


def clearances(meshes: Sequence[Mesh], ground: Terrain) -> list[tuple[float, int]]:
    """Of each mesh (world coordinates): metres to what is nearest, negative where they overlap, and what that is.

    The number of another mesh, or -1 for the ground. Overlaps count before gaps. Between two meshes the least distance,
    or minus the least width of what they share; a mesh that encloses no body stands there as its hull.
    """
    hold_to_one_thread()
    solids = [_solid(mesh) for mesh in meshes]
    boxes = [(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) for mesh in meshes]
    found = [(vertical_gap(mesh, ground), -1) for mesh in meshes]
    for i, j in _pairs(len(meshes)):
        if (boxes[i][0] > boxes[j][1] + NEAR_M).any() or (boxes[j][0] > boxes[i][1] + NEAR_M).any():
            continue
        gap = _between(solids[i], solids[j])
        for a, b in ((i, j), (j, i)):
            found[a] = min(found[a], (gap, b))
    return found


def _pairs(count: int) -> Iterable[tuple[int, int]]:
    return ((i, j) for i in range(count) for j in range(i + 1, count))


def _solid(mesh: Mesh) -> manifold3d.Manifold:
    solid = solid_of(weld(mesh))
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(mesh.vertices)) if solid is None else solid


def _between(a: manifold3d.Manifold, b: manifold3d.Manifold) -> float:
    shared = a ^ b
    if shared.is_empty() or shared.volume() <= 0.0:
        return float(a.min_gap(b, NEAR_M))
    return -max(least_width_m(convex_hull(triangles_of(piece).vertices)) for piece in shared.decompose())


def _margin_m(number: int, meshes: Sequence[Mesh], ground: Terrain, com: Array) -> float:
    """How far the centre of mass projects inside the hull of the contacts that hold the object up; minus its reach if none."""
    mesh = meshes[number]
    low, high = mesh.vertices.min(axis=0) - CONTACT_M, mesh.vertices.max(axis=0) + CONTACT_M
    points = [contact_points(mesh, ground, CONTACT_M)]
    for k, other in enumerate(meshes):
        if k != number and (other.vertices.max(axis=0) >= low).all() and (other.vertices.min(axis=0) <= high).all():
            points.append(contact_points(mesh, other, CONTACT_M))
    held = np.concatenate([at[normals[:, 2] > FROM_BELOW] for at, normals in points])
    return support_margin_m(held, com) if len(held) else -float(np.linalg.norm(mesh.vertices - com, axis=1).max())
