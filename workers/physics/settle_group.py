"""Several objects that fall together, onto the table and onto one another."""

import itertools
import math
from collections.abc import Collection, Sequence

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.errors import SettleError
from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart, Settled, SupportedBy, Table
from schemas.scene.shape import Mesh
from workers.geometry.elevation import prepare_terrain
from workers.geometry.frames import transform
from workers.geometry.lathe_decomposition import COARSE, TOLERANCE
from workers.physics.equilibrium import FIXED, Contact, Weight, contact_points, equilibrium_residual, support_margin_m
from workers.physics.fall import Fall, choose_pace, fall, faller_of, free_fall_m, shaped
from workers.physics.placement import HELD_FROM, LEFT_M, placed_mesh
from workers.physics.rest_pose import CONTACT_M
from workers.physics.separation import clearances, overlap_m
from workers.physics.stop_conditions import Watch, watch_edge, watch_gone

MOST_OVERLAP_M = 1e-4
"""How far objects may begin inside one another. What overlaps is pushed apart by a share of its depth in each step, which a
depth of centimetres turns into tens of metres a second."""


MANY = 4
"""So many objects fall as coarser convex parts: Bullet's time goes with the pairs of parts that come near one another."""


def settle_together(
    starts: Sequence[ObjectStart], table: Table, physics: Physics, ran: Collection[str]
) -> tuple[Settled, ...]:
    """Drop the objects at once, wait until all rest, and measure how they rest.

    What is not convex falls as its convex parts where `decomposition` ran, else as its hull. Objects that lie on one
    another are not moved after the simulation: what is measured of gaps is the simulation's. Raises SettleError
    `objects_overlap`, `not_at_rest`, `left_table` or `table_too_fine`.
    """
    _require_apart(starts)
    flat = "table_mesh" not in ran and table.top.convex
    poses = [start.T_world_obj for start in starts]
    motion = release_together(starts, poses, table, physics, ran, flat)
    if flat and motion.happened is not None:
        flat = False
        motion = release_together(starts, poses, table, physics, ran, flat)
    _require_rest(starts, table, motion)
    return _describe(starts, table, motion, physics, "flat_top" if flat else "mesh")


def _require_apart(starts: Sequence[ObjectStart]) -> None:
    meshes = [placed_mesh(start, start.T_world_obj) for start in starts]
    for i, j in itertools.combinations(range(len(starts)), 2):
        deep = overlap_m(meshes[i], meshes[j])
        if deep > MOST_OVERLAP_M:
            raise SettleError(
                "objects_overlap",
                f"regions {starts[i].region_id} and {starts[j].region_id} begin {deep * 1e3:.2f} mm inside one another: let "
                "them go apart, or one above the other",
            )


def release_together(
    starts: Sequence[ObjectStart],
    poses: Sequence[Pose],
    table: Table,
    physics: Physics,
    ran: Collection[str],
    flat: bool,
) -> Fall:
    """Let the objects go at `poses`, on the flat top or on the mesh; a watch happens where one leaves what it must not.

    The solver goes from contact to contact: what one iteration carries down a stack is one object, and by a share that
    shrinks with the ratio of the masses. So there are more for more objects; it stops where they change nothing.
    """
    starts = [shaped(start, physics) for start in starts]
    share = TOLERANCE if len(starts) < MANY else COARSE
    fallers = [faller_of(start, physics, ran, share=share) for start in starts]
    hulls = [transform(T, start.hull.vertices) for T, start in zip(poses, starts, strict=True)]
    free = min(free_fall_m(points, table, flat) for points in hulls)
    top = table.top.height_m
    pace = choose_pace(starts, physics, ran, max(float(points[:, 2].min()) for points in hulls) - top)
    reach = max(faller.reach_m for faller in fallers)
    lowest = float(table.mesh.vertices[:, 2].min())
    watch: Watch = watch_edge(table.top.outline, reach) if flat else watch_gone(lowest - reach)
    masses = [start.asset.mass.mass_kg for start in starts]
    times = len(starts) * math.ceil(math.sqrt(max(masses) / min(masses)))
    more = physics.model_copy(update={"solver_iterations": physics.solver_iterations * times})
    ground = top if flat else table.mesh
    return fall(fallers, poses, ground, more, pace, physics.max_settle_s, free, (watch,))


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


def _describe(
    starts: Sequence[ObjectStart], table: Table, motion: Fall, physics: Physics, support: SupportedBy
) -> tuple[Settled, ...]:
    """The figures of every rest pose, measured between the meshes and not taken from the simulator."""
    meshes = [placed_mesh(start, T) for start, T in zip(starts, motion.poses, strict=True)]
    coms = [transform(T, start.asset.mass.com[None, :])[0] for start, T in zip(starts, motion.poses, strict=True)]
    gaps, contacts = clearances(meshes, prepare_terrain(table.mesh)), _contacts(meshes, table)
    weights = [
        Weight(start.asset.mass.mass_kg, com, float(np.ptp(mesh.vertices, axis=0).max()))
        for start, com, mesh in zip(starts, coms, meshes, strict=True)
    ]
    residuals = equilibrium_residual(weights, contacts, physics.friction**2)
    return tuple(
        Settled(
            T_world_obj=frozen_array(motion.poses[k]),
            penetration_mm=max(0.0, -gaps[k]) * 1e3,
            hover_gap_mm=max(0.0, gaps[k]) * 1e3,
            support_margin_mm=1e3 * _margin_m(k, contacts, weights[k]),
            equilibrium_residual=float(residuals[k]),
            residual_speed_mm_s=motion.speed_m_s * 1e3,
            settle_s=motion.seconds,
            support=support,
        )
        for k in range(len(starts))
    )


def _contacts(meshes: Sequence[Mesh], table: Table) -> list[Contact]:
    """Of every mesh with the table, and of every two that come near one another."""
    found = [Contact(k, FIXED, *contact_points(mesh, table.mesh, CONTACT_M)) for k, mesh in enumerate(meshes)]
    boxes = [(mesh.vertices.min(axis=0) - CONTACT_M, mesh.vertices.max(axis=0) + CONTACT_M) for mesh in meshes]
    for i, j in itertools.combinations(range(len(meshes)), 2):
        if (boxes[i][0] <= boxes[j][1]).all() and (boxes[j][0] <= boxes[i][1]).all():
            found.append(Contact(i, j, *contact_points(meshes[i], meshes[j], CONTACT_M)))
    return found


def _margin_m(number: int, contacts: Sequence[Contact], weight: Weight) -> float:
    """How far the centre of mass projects inside the hull of the contacts that hold the object up; minus its size if none."""
    held = [np.empty((0, 3))]
    for contact in contacts:
        sign = 1.0 if contact.upper == number else -1.0 if contact.lower == number else 0.0
        held.append(contact.points[sign * contact.normals[:, 2] > HELD_FROM])
    points = np.concatenate(held)
    return support_margin_m(points, weight.com) if len(points) else -weight.size_m
