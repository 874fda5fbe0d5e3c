"""The simulation of falling bodies until they rest, and the size of its steps."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from schemas.base import Array, Pose
from schemas.job.physics import Physics
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart, Table
from schemas.scene.shape import Mesh
from workers.geometry.frames import invert, translation
from workers.geometry.hull import least_width_m
from workers.physics.bullet import GRAVITY_M_S2, GroundShape, World, open_world
from workers.physics.monitors import EnergyRecord, StandingCondition, StopCondition, Velocity
from workers.physics.rest_pose import Face
from workers.physics.rigid_body import Body, BodyPose, as_pose
from workers.physics.table_top import support_height

SAMPLE_STEPS = 8
"""Steps between two readings of the speeds: a reading costs as much as a step."""

LOOK_STEPS = 4
"""Steps between two looks at the energy of a single object. What it rises in between is up to the same again, and with eight
steps up to 68 times as much: it is least just after an impact."""

CALM_M_S = 0.05
"""Upper bound on the momentary speed of any point of a resting object: at this speed it climbs an eighth of a millimetre."""

FINEST = 16
"""Ratio of the longest step to the shortest."""

DROP_SHARE = 0.002
"""Travel per step as a share of the drop, where that is more than `physics.max_step_travel_mm`. Bounds the energy regained
at touchdown to a thousandth of the fall's."""

REACH_STEPS = 4.0
"""Travel in this many steps is the contact distance on a mesh: contacts exist before they close, and no earlier."""

STANDING_SHARE = 0.2
"""Share of the rest window after which something calm is asked whether it stands."""

THIN_SHARE = 0.05
"""Upper bound on the travel per step, as a share of the thinnest object's width."""

SKIPPED_TO_M = 2e-4
"""Height of the lowest point above the ground at which the simulation takes over from free fall."""

BOUNCES_M_S = 0.1
"""Slower impacts do not bounce: the rebound is at most half a millimetre high."""


@dataclass(frozen=True)
class StepSizes:
    """Adaptive time steps: `base_hz`, or more where a point would travel further than `max_travel_m` in one step.

    looked: steps between two looks at the energy, a divisor of `SAMPLE_STEPS`; changes no motion. kept: see `open_world`.
    """

    base_hz: float
    max_travel_m: float
    looked: int = SAMPLE_STEPS
    kept: float = 1.0

    def rate_hz(self, speed_m_s: float) -> float:
        """Steps per second at the fastest point's speed: `base_hz` times a power of two."""
        rate = self.base_hz
        while speed_m_s > rate * self.max_travel_m and rate < FINEST * self.base_hz:
            rate *= 2.0
        return rate


@dataclass(frozen=True, eq=False)
class Outcome:
    """The end of a simulation, with `T_world_obj` [4, 4] of every object.

    speed_m_s: of the fastest point; where all `rested`, the drift over the last window. seconds: of free fall and simulation.
    stopped_by: the name of the stop condition that ended it. rise: how far the energy of all rose, as a share of its bound.
    face: of its hull that an object stands on, where that ended it.
    """

    poses: tuple[Pose, ...]
    speed_m_s: float
    seconds: float
    rested: bool
    stopped_by: str | None = None
    rise: float = 0.0
    face: Face | None = None


def choose_steps(
    starts: Sequence[ObjectStart], physics: Physics, effects: EffectPlan, drop_m: float, thin_share: float = THIN_SHARE
) -> StepSizes:
    """Step sizes from the height of the drop and the thinnest object; constant without the effect `fine_step`."""
    if not effects.runs("fine_step"):
        return StepSizes(physics.step_hz, math.inf)
    thinnest_m = min(least_width_m(start.hull) for start in starts)
    travel_m = max(physics.max_step_travel_mm / 1e3, DROP_SHARE * drop_m)
    return StepSizes(physics.step_hz, min(travel_m, thin_share * thinnest_m))


def free_fall_m(points: Array, table: Table, flat: bool) -> float:
    """Metres that points [N, 3], world, fall before one can touch the flat top or the mesh; 0 with nothing below."""
    below = table.top.height_m if flat else support_height(points[:, :2], table.mesh)
    return max(0.0, float(points[:, 2].min()) - below) if math.isfinite(below) else 0.0


def fall(
    bodies: Sequence[Body],
    poses: Sequence[Pose],
    ground: GroundShape,
    physics: Physics,
    steps: StepSizes,
    free_m: float,
    stops: Mapping[str, StopCondition] | None = None,
    sleeping: bool = False,
    standing: StandingCondition | None = None,
    reach_m: float = math.inf,
) -> Outcome:
    """Release objects at `poses` (`T_world_obj`) until all rest, `physics.max_settle_s` is over, or a stop condition holds.

    The first `free_m` metres are fallen in closed form, which is exact: nothing turns in the air. sleeping: what rests costs no
    time until something that moves touches it. standing: ends the fall of a single object sooner. reach_m: contact distance, if
    less than Bullet's own; on a mesh it follows from the steps.
    """
    fallen_m = min(max(0.0, free_m - SKIPPED_TO_M), GRAVITY_M_S2 * physics.max_settle_s**2 / 2)
    placed = [(one, translation(0, 0, -fallen_m) @ T @ one.T_obj_body) for one, T in zip(bodies, poses, strict=True)]
    speed_m_s = math.sqrt(2.0 * GRAVITY_M_S2 * fallen_m)
    fallen_s = speed_m_s / GRAVITY_M_S2
    end_s = physics.max_settle_s - fallen_s
    if isinstance(ground, Mesh | tuple):
        reach_m = min(reach_m, REACH_STEPS * max(steps.max_travel_m, speed_m_s / (FINEST * physics.step_hz)))
    with open_world(placed, ground, physics, steps.looked, reach_m, steps.kept) as world:
        for number in range(len(bodies)):
            world.set_velocity((0.0, 0.0, -speed_m_s), body=number)
        outcome = _simulate(world, bodies, physics, steps, end_s, stops or {}, sleeping, standing)
    ended = tuple(T @ invert(one.T_obj_body) for T, one in zip(outcome.poses, bodies, strict=True))
    return dataclasses.replace(outcome, poses=ended, seconds=outcome.seconds + fallen_s)


@dataclass
class _Stillness:
    """How long a body has stayed near its `anchor`: since this time, seconds, and moved by these metres."""

    anchor: BodyPose
    since: float = 0.0
    moved_m: float = 0.0


def _simulate(
    world: World,
    bodies: Sequence[Body],
    physics: Physics,
    steps: StepSizes,
    end_s: float,
    stops: Mapping[str, StopCondition],
    sleeping: bool,
    standing: StandingCondition | None,
) -> Outcome:
    """Step until all rest, the time is over or a stop condition holds; the poses are those of the body frames.

    end_s: the time to simulate. A body rests when for the whole window no point moved further than
    the rest speed allows, it turned no further than the rest spin allows, and no point was faster than `CALM_M_S`. Displacement
    decides and not speed: Bullet's contact points flicker between the many vertices of a round rim, and an object at rest may
    rattle by micrometres at some millimetres per second for ever.
    """
    rest = physics.rest
    drift_m, turn_rad = rest.speed_mm_s / 1e3 * rest.window_s, rest.spin_rad_s * rest.window_s
    still = [_Stillness(world.pose(k)) for k in range(len(bodies))]
    time, rate, bounces, asked = 0.0, physics.step_hz * 1.0, physics.restitution > 0.0, -1.0
    moving = [world.velocity(k) for k in range(len(bodies))]
    speeds, energy = _speeds(bodies, moving), EnergyRecord(bodies, [one.anchor for one in still], moving)
    while True:
        wanted = steps.rate_hz(max(speeds))
        if bounces and max(speeds) < BOUNCES_M_S:
            world.set_restitution(0.0)
            bounces, rate = False, 0.0
        if wanted != rate:
            world.set_rate(wanted)
            rate = wanted
        for _ in range(SAMPLE_STEPS // steps.looked):
            world.advance()
            at, moving = [world.pose(k) for k in range(len(bodies))], [world.velocity(k) for k in range(len(bodies))]
            energy.add(at, moving)
        time += SAMPLE_STEPS / rate
        speeds = _speeds(bodies, moving)
        for name, stop in stops.items():
            if any(stop(number, one) for number, one in enumerate(at)):
                return Outcome(tuple(map(as_pose, at)), max(speeds), time, False, name)
        for number, (one, now, body, speed) in enumerate(zip(still, at, bodies, speeds, strict=True)):
            turned = _angle(one.anchor[1], now[1])
            one.moved_m = math.dist(one.anchor[0], now[0]) + turned * body.reach_m
            if speed > CALM_M_S or one.moved_m > drift_m or turned > turn_rad:
                one.anchor, one.since = now, time
            elif sleeping and time - one.since >= rest.window_s:
                world.let_sleep(number)
        face = None
        if standing is not None and asked < still[0].since <= time - STANDING_SHARE * rest.window_s:
            asked, face = time, standing(at[0], moving[0])
        if face is not None or all(time - one.since >= rest.window_s for one in still):
            drift_m_s = max(one.moved_m / (time - one.since) for one in still)
            return Outcome(tuple(map(as_pose, at)), drift_m_s, time, True, rise=energy.rise(), face=face)
        if time >= end_s:
            return Outcome(tuple(map(as_pose, at)), max(speeds), time, False, rise=energy.rise())


def _speeds(bodies: Sequence[Body], moving: Sequence[Velocity]) -> list[float]:
    """For each body an upper bound on the speed of its fastest point, m/s."""
    return [math.hypot(*v) + math.hypot(*w) * body.reach_m for (v, w), body in zip(moving, bodies, strict=True)]


def _angle(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle, radians, of the rotation between two unit quaternions; for small rotations the chord is half the angle."""
    return 4.0 * math.asin(min(1.0, 0.5 * min(math.dist(a, b), math.dist(a, [-c for c in b]))))
