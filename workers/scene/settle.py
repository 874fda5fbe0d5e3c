"""From release to rest. The one file that imports PyBullet, so that it can be replaced."""

import dataclasses
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.errors import SettleError
from schemas.job import Physics
from schemas.scene import ObjectStart, Settled, Table, TableTop
from schemas.shape import MassProperties, Mesh
from workers.geometry.frames import invert, pose, rotation_from_quaternion, transform, translation
from workers.geometry.heights import heights_at, vertical_gap
from workers.scene.contact import is_stable, snap_to_face, support_margin, touching
from workers.scene.quiet import silence_c_stderr
from workers.scene.support import inside_margin

with silence_c_stderr():
    import pybullet

GRAVITY_M_S2 = 9.81
SAMPLE_STEPS = 8
"""Speeds are read every so many steps: reading costs as much as stepping."""

SLAB_HALF_M = (2.0, 2.0, 0.25)
"""Half the sides of the box that stands for a flat top: larger and thicker than any table, so that nothing sinks
through it; it stands in for the table only while the object stays over the true top."""

LEFT_M = 0.05
"""An object whose table lies this far below the top has left it."""

CALM_M_S = 0.05
"""A point of a resting object never moves faster than this, however briefly: it could not climb an eighth of a
millimetre any more."""

MOST_GROUND_VERTICES, MOST_GROUND_INDICES = 131_072, 524_288
"""PyBullet's limits on one collision mesh; it fails beyond them without a word why."""

RECHECK_S = 1.0
"""How long an object is watched when it is released again."""


@dataclass(frozen=True, eq=False)
class _Motion:
    """What a simulation ended with; `stayed` is False as soon as the object's footprint left the flat top."""

    T_world_obj: Pose
    speed_m_s: float
    seconds: float
    rested: bool
    stayed: bool


def settle(start: ObjectStart, table: Table, physics: Physics) -> Settled:
    """Drop the object, wait until it rests, and remove what the simulator's margins left of gap and tilt.

    Raises SettleError `not_at_rest`, `left_table`, `unsupported` or `table_too_fine`. The result is a function of the
    arguments alone: the world is made anew each time.
    """
    if start.placed:
        return _describe(start, table, _Motion(start.T_world_obj, 0.0, 0.0, True, True), "placed")
    if table.top.convex:
        motion = _settle_flat(start, table, physics)
        if motion is not None:
            return _describe(start, table, motion, "flat_top")
    motion = _simulate(start, table, physics, physics.max_settle_s, flat=False)
    _require_rest(start, table, motion)
    return _describe(start, table, _close_gap(start, table, motion), "mesh")


def _settle_flat(start: ObjectStart, table: Table, physics: Physics) -> _Motion | None:
    """Rest on the flat top alone; None where the footprint left it, so that the table's edges may have mattered.

    Rolling friction can hold an object within that lever arm of an edge of its hull, where in truth it would tip on.
    Such a pose has no face below the centre of mass, and is let go once more without rolling friction.
    """
    seconds = 0.0
    for friction in (physics.rolling_friction, 0.0):
        physics = physics.model_copy(update={"rolling_friction": friction})
        motion = _simulate(start, table, physics, physics.max_settle_s, flat=True)
        if not motion.stayed:
            return None
        _require_rest(start, table, motion)
        seconds += motion.seconds
        T = snap_to_face(motion.T_world_obj, start.hull, start.asset.mass.com, physics.snap_rad)
        motion = _Motion(T, motion.speed_m_s, seconds, True, True)
        if is_stable(T, start.hull, start.asset.mass.com):
            break
        start = dataclasses.replace(start, T_world_obj=T)
    return _close_gap(start, table, motion)


def recheck(start: ObjectStart, settled: Settled, table: Table, physics: Physics) -> float:
    """How far the object's farthest point moves, in millimetres, when it is released again where it rests."""
    again = dataclasses.replace(start, T_world_obj=settled.T_world_obj, placed=False)
    motion = _simulate(again, table, physics, RECHECK_S, flat=settled.support != "mesh")
    before = transform(settled.T_world_obj, start.hull.vertices)
    after = transform(motion.T_world_obj, start.hull.vertices)
    return float(np.linalg.norm(after - before, axis=1).max() * 1e3)


def _require_rest(start: ObjectStart, table: Table, motion: _Motion) -> None:
    com = transform(motion.T_world_obj, start.asset.mass.com[None, :])[0]
    ground = heights_at(com[None, :2], table.mesh)[0]
    if not ground >= table.top.height_m - LEFT_M:  # nan too
        raise SettleError(
            "left_table",
            f"after {motion.seconds:.2f} s the centre of mass was at ({com[0]:.3f}, {com[1]:.3f}, {com[2]:.3f}) m, off the "
            "table's top: narrow start.offset_m or use larger tables",
        )
    if not motion.rested:
        raise SettleError(
            "not_at_rest",
            f"still moving at {motion.speed_m_s * 1e3:.2f} mm/s after {motion.seconds:.1f} s: raise physics.max_settle_s "
            "or physics.rolling_friction",
        )


def _close_gap(start: ObjectStart, table: Table, motion: _Motion) -> _Motion:
    """Move along z until the meshes just touch."""
    lift = translation(0.0, 0.0, -_gap_m(start, motion.T_world_obj, table))
    return dataclasses.replace(motion, T_world_obj=lift @ motion.T_world_obj)


def _gap_m(start: ObjectStart, T_world_obj: Pose, table: Table) -> float:
    shape = start.asset.shape.mesh
    return vertical_gap(Mesh(transform(T_world_obj, shape.vertices), shape.faces), table.mesh)


def _describe(start: ObjectStart, table: Table, motion: _Motion, support: str) -> Settled:
    """The figures of a rest pose, measured between the meshes and not taken from the simulator."""
    T = motion.T_world_obj
    gap_mm = _gap_m(start, T, table) * 1e3
    com = transform(T, start.asset.mass.com[None, :])[0]
    margin = support_margin(touching(start.hull, T, table.mesh), com[:2])
    if support != "mesh" and not margin > 0.0:
        raise SettleError(
            "unsupported",
            f"it came to rest with its centre of mass {-margin * 1e3:.2f} mm outside the hull of its contacts: "
            "raise physics.snap_rad or lower physics.rest.speed_mm_s",
        )
    return Settled(
        T_world_obj=frozen_array(T),
        penetration_mm=max(0.0, -gap_mm),
        hover_gap_mm=max(0.0, gap_mm),
        support_margin_mm=margin * 1e3,
        residual_speed_mm_s=motion.speed_m_s * 1e3,
        settle_s=motion.seconds,
        support=support,  # type: ignore[arg-type]
    )


def _simulate(start: ObjectStart, table: Table, physics: Physics, seconds: float, flat: bool) -> _Motion:
    T_obj_body, principal = _body_frame(start.asset.mass)
    vertices = transform(invert(T_obj_body), start.hull.vertices)
    reach = float(np.linalg.norm(vertices, axis=1).max())
    with _world(physics) as client:
        ground = _flat_ground(client, table.top.height_m) if flat else _mesh_ground(client, table.mesh)
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=vertices.tolist(), physicsClientId=client)
        body = pybullet.createMultiBody(start.asset.mass.mass_kg, shape, physicsClientId=client)
        pybullet.changeDynamics(body, -1, localInertiaDiagonal=principal.tolist(), physicsClientId=client)
        for thing in (ground, body):
            _set_surface(client, thing, physics)
        _place(client, body, start.T_world_obj @ T_obj_body)
        motion = _run(client, body, physics, seconds, (reach, table.top if flat else None))
    return _Motion(
        motion.T_world_obj @ invert(T_obj_body), motion.speed_m_s, motion.seconds, motion.rested, motion.stayed
    )


def _run(client: int, body: int, physics: Physics, seconds: float, watch: tuple[float, TableTop | None]) -> _Motion:
    """Step until the object rests, the time is over, or the flat top is left.

    It rests when, for the whole window, no point has gone further than the rest speed would take it, nor turned further
    than the rest spin would, and nothing moved faster than `CALM_M_S`. Displacement counts and not speed, because
    Bullet's contact points flicker between the many vertices of a round rim, and an object that stands still for all
    purposes may rattle by micrometres at some millimetres a second for ever.

    The returned pose is the body frame's (centre of mass, principal axes).
    """
    reach, top = watch
    steps, window = round(seconds * physics.step_hz), round(physics.rest.window_s * physics.step_hz)
    drift_m = physics.rest.speed_mm_s / 1e3 * physics.rest.window_s
    turn_rad = physics.rest.spin_rad_s * physics.rest.window_s
    anchor, since, moved = _read_pose(client, body), 0, 0.0
    for step in range(SAMPLE_STEPS, steps + SAMPLE_STEPS, SAMPLE_STEPS):
        for _ in range(SAMPLE_STEPS):
            pybullet.stepSimulation(physicsClientId=client)
        v, w = (math.hypot(*x) for x in pybullet.getBaseVelocity(body, physicsClientId=client))
        speed, now = v + w * reach, _read_pose(client, body)
        if top is not None and inside_margin(now[0][None, :2], top.outline)[0] < reach:
            return _Motion(_pose(*now), speed, step / physics.step_hz, False, False)
        turned = _angle(anchor[1], now[1])
        moved = float(np.linalg.norm(now[0] - anchor[0])) + turned * reach
        if speed > CALM_M_S or moved > drift_m or turned > turn_rad:
            anchor, since = now, step
        elif step - since >= window:
            return _Motion(_pose(*now), moved * physics.step_hz / (step - since), step / physics.step_hz, True, True)
    return _Motion(_pose(*now), speed, step / physics.step_hz, False, True)


def _read_pose(client: int, body: int) -> tuple[Array, Array]:
    """Position [3] and quaternion [4], (x, y, z, w), of the body frame."""
    position, quaternion = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    return np.array(position), np.array(quaternion)


def _angle(a: Array, b: Array) -> float:
    """Angle, radians, of the turn between two unit quaternions; for small turns the chord is half the angle."""
    return 4.0 * math.asin(min(1.0, 0.5 * min(float(np.linalg.norm(a - b)), float(np.linalg.norm(a + b)))))


@contextmanager
def _world(physics: Physics) -> Iterator[int]:
    """An empty world, emptied again when the block ends. Bit-identical runs need deterministicOverlappingPairs.

    One connection serves the whole process: a new one costs as much as a simulation, a reset a twentieth of that, and
    both give the same bits, whatever was simulated before. Blocks do not nest.
    """
    client = _connection()
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / physics.step_hz,
        numSolverIterations=physics.solver_iterations,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    pybullet.setGravity(0.0, 0.0, -GRAVITY_M_S2, physicsClientId=client)
    try:
        yield client
    finally:
        pybullet.resetSimulation(physicsClientId=client)


@cache
def _connection() -> int:
    client: int = pybullet.connect(pybullet.DIRECT)
    return client


def _flat_ground(client: int, height_m: float) -> int:
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=SLAB_HALF_M, physicsClientId=client)
    return pybullet.createMultiBody(0, shape, basePosition=[0, 0, height_m - SLAB_HALF_M[2]], physicsClientId=client)


def _mesh_ground(client: int, mesh: Mesh) -> int:
    if len(mesh.vertices) > MOST_GROUND_VERTICES or 3 * len(mesh.faces) > MOST_GROUND_INDICES:
        raise SettleError(
            "table_too_fine",
            f"the table has {len(mesh.vertices)} vertices and {len(mesh.faces)} faces, and PyBullet takes "
            f"{MOST_GROUND_VERTICES} and {MOST_GROUND_INDICES // 3}: use a coarser table, or lower assets.limits",
        )
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH,
        vertices=mesh.vertices.tolist(),
        indices=mesh.faces.ravel().tolist(),
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        physicsClientId=client,
    )
    return pybullet.createMultiBody(0, shape, physicsClientId=client)


def _set_surface(client: int, body: int, physics: Physics) -> None:
    pybullet.changeDynamics(
        body,
        -1,
        lateralFriction=physics.friction,
        rollingFriction=physics.rolling_friction,
        spinningFriction=physics.spinning_friction,
        restitution=physics.restitution,
        collisionMargin=physics.margin_mm / 1e3,
        linearDamping=0.0,
        angularDamping=0.0,
        physicsClientId=client,
    )


def _place(client: int, body: int, T: Pose) -> None:
    quaternion = _quaternion(T[:3, :3])
    pybullet.resetBasePositionAndOrientation(body, T[:3, 3].tolist(), quaternion.tolist(), physicsClientId=client)


def _body_frame(mass: MassProperties) -> tuple[Pose, Array]:
    """Centre of mass and principal axes: `T_obj_body` [4, 4], and the principal moments [3] kg m^2."""
    moments, axes = np.linalg.eigh(mass.inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return pose(axes, mass.com), moments


def _pose(position: Array, quaternion: Array) -> Pose:
    return pose(rotation_from_quaternion(quaternion), position)


def _quaternion(R: Array) -> Array:
    """(x, y, z, w) of a rotation [3, 3], by the largest of the four components (Shepperd 1978)."""
    trace = float(np.trace(R))
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    k = int(np.argmax(squares))
    q = np.empty(4)
    if k == 3:
        q[:] = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace]
    else:
        i, j, m = k, (k + 1) % 3, (k + 2) % 3
        q[i] = 1.0 + 2.0 * R[i, i] - trace
        q[j], q[m], q[3] = R[i, j] + R[j, i], R[i, m] + R[m, i], R[m, j] - R[j, m]
    return q / np.linalg.norm(q)
