"""From release to rest: when an object rests, and what is made of the pose that the simulator stopped at."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.errors import SettleError
from schemas.job import Physics
from schemas.scene import ObjectStart, Settled, Table
from schemas.shape import MassProperties, Mesh
from workers.geometry.frames import invert, pose, rotation_from_quaternion, transform, translation
from workers.geometry.heights import Terrain, heights_at, survey, vertical_gap
from workers.scene.bullet import Body, World, drop
from workers.scene.contact import snap_to_face, support_margin, tip_onto_face, touching
from workers.scene.watch import Motion, Watch, can_touch, stands_on_face, watch_edge, watch_tilt

SAMPLE_STEPS = 8
"""Speeds are read every so many steps: reading costs as much as stepping."""

LEFT_M = 0.05
"""An object whose table lies this far below the top has left it."""

CALM_M_S = 0.05
"""A point of a resting object never moves faster than this, however briefly: it could not climb an eighth of a
millimetre any more."""

LESS_ROLLING_FRICTION = (1.0, 0.1, 0.01, 0.0)
"""Shares of the rolling friction that an object is dropped with, each where the one before left it on an edge."""

RECHECK_S = 1.0
"""How long an object is watched when it is released again."""


@dataclass(frozen=True, eq=False)
class _Motion:
    """What a simulation ended with; `stayed` is False as soon as its ground was no longer the right one."""

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
    ground = survey(table.mesh)
    if start.placed:
        return _describe(start, ground, _Motion(start.T_world_obj, 0.0, 0.0, True, True), "placed")
    if table.top.convex:
        motion = _settle_flat(start, table, ground, physics)
        if motion is not None:
            return _describe(start, ground, motion, "flat_top")
    motion = _simulate(start, table, physics, physics.max_settle_s, flat=False)
    _require_rest(start, table, ground, motion)
    return _describe(start, ground, _close_gap(start, ground, motion), "mesh")


def _settle_flat(start: ObjectStart, table: Table, ground: Terrain, physics: Physics) -> _Motion | None:
    """Rest on the flat top alone; None where the footprint left it, so that the table's edges may have mattered.

    Rolling friction can hold an object within that lever arm of an edge of its hull, where in truth it would tip on.
    Such a pose has no face below the centre of mass. It is tipped on by geometry, because thin rods that are let go on
    an edge gain speed in Bullet; where the next face is far, it is let go once more with less rolling friction. With none
    at all a bottle on its side may roll for ever: what little Bullet adds in energy at each edge, nothing takes away.
    """
    seconds = 0.0
    for share in LESS_ROLLING_FRICTION:
        less = physics.model_copy(update={"rolling_friction": share * physics.rolling_friction})
        motion = _simulate(start, table, less, physics.max_settle_s, flat=True)
        if not motion.stayed:
            return None
        _require_rest(start, table, ground, motion)
        seconds += motion.seconds
        T = snap_to_face(motion.T_world_obj, start.hull, start.asset.mass.com, physics.snap_rad)
        snapped = T is not motion.T_world_obj  # onto a face with the centre of mass above it
        tipped = T if snapped else tip_onto_face(T, start.hull, start.asset.mass.com)
        motion = _Motion(T if tipped is None else tipped, motion.speed_m_s, seconds, True, True)
        if tipped is not None:
            break
        start = dataclasses.replace(start, T_world_obj=T)
    return _close_gap(start, ground, motion)


def recheck(start: ObjectStart, settled: Settled, table: Table, physics: Physics) -> float:
    """How far the object's farthest point moves, in millimetres, when it is released again where it rests."""
    again = dataclasses.replace(start, T_world_obj=settled.T_world_obj, placed=False)
    motion = _simulate(again, table, physics, RECHECK_S, flat=settled.support != "mesh")
    before = transform(settled.T_world_obj, start.hull.vertices)
    after = transform(motion.T_world_obj, start.hull.vertices)
    return float(np.linalg.norm(after - before, axis=1).max() * 1e3)


def _require_rest(start: ObjectStart, table: Table, ground: Terrain, motion: _Motion) -> None:
    com = transform(motion.T_world_obj, start.asset.mass.com[None, :])[0]
    over_top = heights_at(com[None, :2], ground)[0] >= table.top.height_m - LEFT_M  # nan compares false
    if not over_top and not (motion.rested and _bridges(start, table, ground, motion)):
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


def _bridges(start: ObjectStart, table: Table, ground: Terrain, motion: _Motion) -> bool:
    """Whether it rests on the top on all sides of a hole that its centre of mass is over."""
    if not np.isfinite(_gap_m(start, motion.T_world_obj, ground)):
        return False
    T = _close_gap(start, ground, motion).T_world_obj
    com = transform(T, start.asset.mass.com[None, :])[0]
    high = com[2] >= table.top.height_m - LEFT_M
    return bool(high and support_margin(touching(start.hull, T, ground), com[:2]) > 0.0)


def _close_gap(start: ObjectStart, ground: Terrain, motion: _Motion) -> _Motion:
    """Move along z until the meshes just touch."""
    lift = translation(0.0, 0.0, -_gap_m(start, motion.T_world_obj, ground))
    return dataclasses.replace(motion, T_world_obj=lift @ motion.T_world_obj)


def _gap_m(start: ObjectStart, T_world_obj: Pose, ground: Terrain) -> float:
    shape = start.asset.shape.mesh
    return vertical_gap(Mesh(transform(T_world_obj, shape.vertices), shape.faces), ground)


def _describe(start: ObjectStart, ground: Terrain, motion: _Motion, support: str) -> Settled:
    """The figures of a rest pose, measured between the meshes and not taken from the simulator."""
    T = motion.T_world_obj
    gap_mm = _gap_m(start, T, ground) * 1e3
    com = transform(T, start.asset.mass.com[None, :])[0]
    margin = support_margin(touching(start.hull, T, ground), com[:2])
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
    """Drop the object onto the flat top or the mesh; `stayed` is False where its footprint left the flat top.

    What stands on a level plane touches it with few of its vertices as long as it does not tip, and Bullet's time goes
    with their number. So it falls with these alone, and falls again with all of them should it tip.
    """
    T_obj_body, moments = _body_frame(start.asset.mass)
    vertices = transform(invert(T_obj_body), start.hull.vertices)
    reach = float(np.linalg.norm(vertices, axis=1).max())
    T_world_body = start.T_world_obj @ T_obj_body

    def fall(vertices: Array, watches: tuple[Watch, ...]) -> _Motion:
        ground = table.top.height_m if flat else table.mesh
        body = Body(start.asset.mass.mass_kg, moments, vertices)
        with drop(body, T_world_body, ground, physics, SAMPLE_STEPS) as world:
            motion = _run(world, physics, seconds, reach, watches)
        return dataclasses.replace(motion, T_world_obj=motion.T_world_obj @ invert(T_obj_body))

    if not flat:
        return fall(vertices, ())
    leaves = watch_edge(table.top.outline, reach)
    down = -T_world_body[2, :3]
    if stands_on_face(vertices, down):
        motion = fall(vertices[can_touch(vertices, down)], (leaves, watch_tilt(T_world_body)))
        if motion.stayed:
            return motion
    return fall(vertices, (leaves,))


def _run(world: World, physics: Physics, seconds: float, reach: float, watches: tuple[Watch, ...]) -> _Motion:
    """Step until the object rests, the time is over, or something that was watched for happens.

    It rests when, for the whole window, no point has gone further than the rest speed would take it, nor turned further
    than the rest spin would, and nothing moved faster than `CALM_M_S`. Displacement counts and not speed, because
    Bullet's contact points flicker between the many vertices of a round rim, and an object that stands still for all
    purposes may rattle by micrometres at some millimetres a second for ever.

    The returned pose is the body frame's (centre of mass, principal axes).
    """
    steps, window = round(seconds * physics.step_hz), round(physics.rest.window_s * physics.step_hz)
    drift_m = physics.rest.speed_mm_s / 1e3 * physics.rest.window_s
    turn_rad = physics.rest.spin_rad_s * physics.rest.window_s
    anchor, since, moved = world.pose(), 0, 0.0
    for step in range(SAMPLE_STEPS, steps + SAMPLE_STEPS, SAMPLE_STEPS):
        world.advance()
        v, w = world.velocity()
        speed, now = math.hypot(*v) + math.hypot(*w) * reach, world.pose()
        if any(happens(now) for happens in watches):
            return _Motion(_pose(now), speed, step / physics.step_hz, False, False)
        turned = _angle(anchor[1], now[1])
        moved = math.dist(anchor[0], now[0]) + turned * reach
        if speed > CALM_M_S or moved > drift_m or turned > turn_rad:
            anchor, since = now, step
        elif step - since >= window:
            return _Motion(_pose(now), moved * physics.step_hz / (step - since), step / physics.step_hz, True, True)
    return _Motion(_pose(now), speed, step / physics.step_hz, False, True)


def _angle(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle, radians, of the turn between two unit quaternions; for small turns the chord is half the angle."""
    return 4.0 * math.asin(min(1.0, 0.5 * min(math.dist(a, b), math.dist(a, [-c for c in b]))))


def _body_frame(mass: MassProperties) -> tuple[Pose, Array]:
    """Centre of mass and principal axes: `T_obj_body` [4, 4], and the principal moments [3] kg m^2."""
    moments, axes = np.linalg.eigh(mass.inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return pose(axes, mass.com), moments


def _pose(motion: Motion) -> Pose:
    position, quaternion = motion
    return pose(rotation_from_quaternion(np.array(quaternion)), np.array(position))
