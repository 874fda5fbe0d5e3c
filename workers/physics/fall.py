"""Bodies let go above a ground, simulated until they rest: the loop about the simulator, and how fine its steps are."""

import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import MassProperties, Mesh
from workers.geometry.frames import invert, pose, rotation_from_quaternion, transform
from workers.geometry.hull import convex_hull
from workers.geometry.hull_offset import least_width_m, offset_hull
from workers.geometry.lathe_decomposition import TOLERANCE
from workers.physics.bullet import GRAVITY_M_S2, SLOP_M, Body, World, open_world
from workers.physics.convex_parts.step import parts_of
from workers.physics.effects import is_convex
from workers.physics.stop_conditions import Motion, Watch
from workers.physics.table_top import support_height

SAMPLE_STEPS = 8
"""Speeds are read every so many steps: reading costs as much as stepping."""

CALM_M_S = 0.05
"""A point of a resting object never moves faster than this, however briefly: it could not climb an eighth of a
millimetre any more."""

FINEST = 16
"""A step is this many times shorter than the longest at most."""

TOUCHDOWN_S = 0.005
"""So long, from `SKIPPED_TO_M` above the ground, steps are the shortest: what lands flat then stops at once, and no later
step would mend how deep it went."""

DROP_SHARE = 0.002
"""Travel per step as a share of the drop, where that is more than `physics.max_step_travel_mm`. It bounds the penetration at
touchdown, and so the energy that may be regained, to a thousandth of the fall's."""

REACH_STEPS = 4.0
"""On a mesh, contacts reach as far as a point goes in so many steps: far enough to be there before they close, and no further."""

THIN_SHARE = 0.05
"""Of the thinnest object: how far a point may go in a step at most."""

SKIPPED_TO_M = 2e-4
"""The fall through the air is not simulated until the lowest point is this near the ground."""

BOUNCES_M_S = 0.1
"""What meets the ground more slowly does not bounce: it would rise by half a millimetre at most."""


@dataclass(frozen=True, eq=False)
class Faller:
    """An object as the simulator takes it: `T_obj_body` [4, 4] leads to its centre of mass and principal axes.

    `reach_m`: from the centre of mass to the farthest vertex.
    """

    body: Body
    T_obj_body: Pose
    reach_m: float

    def only(self, vertices: Array) -> "Faller":
        """The same body with other vertices [N, 3], body frame."""
        return dataclasses.replace(self, body=dataclasses.replace(self.body, parts=(vertices,)))


@dataclass(frozen=True)
class Pace:
    """How fine the steps are: `slowest_hz` where all is slow, more where a point would go further than `way_m` in one."""

    slowest_hz: float
    way_m: float

    def rate(self, speed_m_s: float, lands: bool = False) -> float:
        """Steps a second for the fastest point's speed: `slowest_hz` times a power of two, the highest where it `lands`."""
        if math.isfinite(self.way_m) and lands:
            return FINEST * self.slowest_hz
        rate = self.slowest_hz
        while speed_m_s > rate * self.way_m and rate < FINEST * self.slowest_hz:
            rate *= 2.0
        return rate


@dataclass(frozen=True, eq=False)
class Fall:
    """What a simulation ended with, for each body its `T_world_obj`.

    speed_m_s: of the fastest point, at which it drifted over the last window; seconds: simulated, and fallen before;
    happened: the number of the watch that ended it, None where none did.
    """

    poses: tuple[Pose, ...]
    speed_m_s: float
    seconds: float
    rested: bool
    happened: int | None = None


def shaped(start: ObjectStart, physics: Physics) -> ObjectStart:
    """The object as `physics.collision` has it fall: with the box about it, along its own axes, in place of its hull.

    Its lowest point stays as high as the object's.
    """
    if physics.collision != "box":
        return start
    lower, upper = start.hull.vertices.min(axis=0), start.hull.vertices.max(axis=0)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (upper - lower) + lower
    low = [float(transform(start.T_world_obj, points)[:, 2].min()) for points in (start.hull.vertices, corners)]
    T = start.T_world_obj.copy()
    T[2, 3] += low[0] - low[1]
    return dataclasses.replace(start, hull=convex_hull(corners), T_world_obj=frozen_array(T))


def make_faller(
    start: ObjectStart, physics: Physics, rolls: bool, damping: float = 0.0, cut: Sequence[Array] = ()
) -> Faller:
    """The object as its hull, or as convex parts `cut` from it (vertices [N, 3], object frame) where there are any.

    Bullet puts a margin about a collision shape. So the shape is made smaller by as much, less the depth that Bullet
    leaves things in the ground at rest: its faces then come to lie where the object's are.
    """
    T_obj_body, moments = body_frame(start.asset.mass)
    hulls = [convex_hull(part) for part in cut] or [start.hull]
    wanted = physics.margin_mm / 1e3 - SLOP_M
    smaller = [offset_hull(hull, wanted) for hull in hulls]
    inset = min(each.offset_m for each in smaller)
    if cut:
        each_to = zip(smaller, hulls, strict=True)
        smaller = [each if each.offset_m == inset else offset_hull(hull, inset) for each, hull in each_to]
    shapes, margin = [each.vertices for each in smaller], min(each.offset_m for each in smaller) + SLOP_M
    to_body = invert(T_obj_body)
    reach = float(np.linalg.norm(transform(to_body, start.hull.vertices), axis=1).max())
    parts = tuple(transform(to_body, each) for each in shapes)
    body = Body(start.asset.mass.mass_kg, moments, parts, margin, rolls, damping)
    return Faller(body, T_obj_body, reach)


def faller_of(
    start: ObjectStart, physics: Physics, ran: Collection[str], damping: float = 0.0, share: float = TOLERANCE
) -> Faller:
    """The object with the effects that ran: as its convex parts where `decomposition` did and it has several.

    Parts of built-in shapes may reach out by this share of their size.
    """
    cut: Sequence[Array] = ()
    if "decomposition" in ran and not is_convex(start):
        parts = parts_of(start.asset, physics.concavity, share)
        cut = parts if len(parts) > 1 else ()
    return make_faller(start, physics, "rolling_friction" in ran, damping, cut)


def choose_pace(starts: Sequence[ObjectStart], physics: Physics, ran: Collection[str], drop_m: float) -> Pace:
    """Steps from the scene's own scales: how far things fall, and how thin the thinnest is; all alike without `fine_step`."""
    if "fine_step" not in ran:
        return Pace(physics.step_hz, math.inf)
    thinnest = min(least_width_m(start.hull) for start in starts)
    return Pace(physics.step_hz, min(max(physics.max_step_travel_mm / 1e3, DROP_SHARE * drop_m), THIN_SHARE * thinnest))


def free_fall_m(points: Array, table: Table, flat: bool) -> float:
    """How far a hull's vertices [N, 3] may fall, world, before one can touch the flat top or the mesh; 0 where none is below."""
    below = table.top.height_m if flat else support_height(points[:, :2], table.mesh)
    return max(0.0, float(points[:, 2].min()) - below) if math.isfinite(below) else 0.0


def fall(
    fallers: Sequence[Faller],
    poses: Sequence[Pose],
    ground: float | Mesh,
    physics: Physics,
    pace: Pace,
    seconds: float,
    free_m: float,
    watches: Sequence[Watch] = (),
) -> Fall:
    """Let the objects go at `poses` (`T_world_obj`), and step until all rest, the time is over, or a watch happens.

    The first `free_m` metres are fallen by half g t squared, which is exact: nothing turns on the way. A watch looks at
    the pose of every body.
    """
    fallen = min(max(0.0, free_m - SKIPPED_TO_M), GRAVITY_M_S2 * seconds**2 / 2)
    lowered = [_lowered(T, fallen) @ f.T_obj_body for T, f in zip(poses, fallers, strict=True)]
    speed = math.sqrt(2.0 * GRAVITY_M_S2 * fallen)
    touchdown = TOUCHDOWN_S if fallen > 0.0 else 0.0
    placed = [(f.body, T) for f, T in zip(fallers, lowered, strict=True)]
    reach = REACH_STEPS * max(pace.way_m, speed / (FINEST * physics.step_hz))
    with open_world(placed, ground, physics, SAMPLE_STEPS, reach) as world:
        for number in range(len(fallers)):
            world.push((0.0, 0.0, -speed), body=number)
        found = _run(world, fallers, physics, pace, seconds - speed / GRAVITY_M_S2, watches, touchdown)
    ended = tuple(T @ invert(f.T_obj_body) for T, f in zip(found.poses, fallers, strict=True))
    return dataclasses.replace(found, poses=ended, seconds=found.seconds + speed / GRAVITY_M_S2)


def _lowered(T: Pose, by_m: float) -> Pose:
    lower = T.copy()
    lower[2, 3] -= by_m
    return lower


@dataclass
class _Stillness:
    """Since when, seconds, a body has gone nowhere from its `anchor`."""

    anchor: Motion
    since: float = 0.0
    moved: float = 0.0


def _run(
    world: World,
    fallers: Sequence[Faller],
    physics: Physics,
    pace: Pace,
    seconds: float,
    watches: Sequence[Watch],
    touchdown_s: float,
) -> Fall:
    """Step until everything rests, the time is over, or something that was watched for happens.

    A body rests when, for the whole window, no point of it has gone further than the rest speed would take it, nor turned
    further than the rest spin would, and nothing moved faster than `CALM_M_S`. Displacement counts and not speed, because
    Bullet's contact points flicker between the many vertices of a round rim, and an object that stands still for all
    purposes may rattle by micrometres at some millimetres a second for ever.

    The returned poses are the body frames' (centre of mass, principal axes).
    """
    rest = physics.rest
    drift_m, turn_rad = rest.speed_mm_s / 1e3 * rest.window_s, rest.spin_rad_s * rest.window_s
    still = [_Stillness(world.pose(k)) for k in range(len(fallers))]
    time, rate, bounces = 0.0, physics.step_hz * 1.0, physics.restitution > 0.0
    speeds = _speeds(world, fallers)
    while True:
        wanted = pace.rate(max(speeds), time < touchdown_s)
        if bounces and max(speeds) < BOUNCES_M_S:
            world.bounce(0.0)
            bounces, rate = False, 0.0
        if wanted != rate:
            world.pace(wanted, bounces)
            rate = wanted
        world.advance()
        time += SAMPLE_STEPS / rate
        speeds, motions = _speeds(world, fallers), [world.pose(k) for k in range(len(fallers))]
        for number, happens in enumerate(watches):
            if any(happens(motion) for motion in motions):
                return Fall(tuple(map(as_pose, motions)), max(speeds), time, False, number)
        for at, now, body, speed in zip(still, motions, fallers, speeds, strict=True):
            turned = _angle(at.anchor[1], now[1])
            at.moved = math.dist(at.anchor[0], now[0]) + turned * body.reach_m
            if speed > CALM_M_S or at.moved > drift_m or turned > turn_rad:
                at.anchor, at.since = now, time
        if all(time - at.since >= rest.window_s for at in still):
            drift = max(at.moved / (time - at.since) for at in still)
            return Fall(tuple(map(as_pose, motions)), drift, time, True)
        if time >= seconds:
            return Fall(tuple(map(as_pose, motions)), max(speeds), time, False)


def _speeds(world: World, fallers: Sequence[Faller]) -> list[float]:
    """Of each body, a bound on the speed of its fastest point, m/s."""
    moving = [world.velocity(k) for k in range(len(fallers))]
    return [math.hypot(*v) + math.hypot(*w) * body.reach_m for (v, w), body in zip(moving, fallers, strict=True)]


def _angle(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle, radians, of the turn between two unit quaternions; for small turns the chord is half the angle."""
    return 4.0 * math.asin(min(1.0, 0.5 * min(math.dist(a, b), math.dist(a, [-c for c in b]))))


def body_frame(mass: MassProperties) -> tuple[Pose, Array]:
    """Centre of mass and principal axes: `T_obj_body` [4, 4], and the principal moments [3] kg m^2."""
    moments, axes = np.linalg.eigh(mass.inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return pose(axes, mass.com), moments


def as_pose(motion: Motion) -> Pose:
    """[4, 4] of a position and a quaternion."""
    position, quaternion = motion
    return pose(rotation_from_quaternion(np.array(quaternion)), np.array(position))
