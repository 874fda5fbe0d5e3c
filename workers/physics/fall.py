"""The simulation of falling bodies until they rest, in steps as short as their speeds ask for, and the record of their energy."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from schemas.base import Array, Pose
from schemas.job.physics import Physics, Rest
from schemas.scene.shape import Mesh
from workers.geometry.frames import add_up, invert, translation
from workers.physics.bullet import GRAVITY_M_S2, LEAST_BOUNCE_M_S, GroundShape, World, open_world
from workers.physics.rigid_body import Body, BodyPose, as_pose
from workers.physics.support import Face

SHARE = 1e-3
"""Bound on a rise of energy, as a share of what the drop sets free."""

LIFT_M = 2e-5
"""The same as a height that the rise would lift the body by, where that is more: what Bullet leaves a shape to hover by."""

Velocity = tuple[Sequence[float], Sequence[float]]
"""Velocity of the centre of mass, m/s, and angular velocity, rad/s, world axes."""

StopCondition = Callable[[int, BodyPose], bool]
"""Whether a body, by its number, at this pose ends the simulation."""

StandingCondition = Callable[[BodyPose, Velocity], Face | None]
"""The face below a body at this pose and velocity, if it stays on it."""


class EnergyRecord:
    """The energy of bodies from time to time, over their weight, metres: the first, the least and the last of it."""

    def __init__(self, bodies: Sequence[Body], at: Sequence[BodyPose], moving: Sequence[Velocity]) -> None:
        mass_kg = add_up(body.mass_kg for body in bodies)
        self._shares = [body.mass_kg / mass_kg for body in bodies]
        self._radii2 = [[float(moment) / body.mass_kg for moment in body.moments] for body in bodies]
        self._first = self._least = self._last = self._height_m(at, moving)
        self._most = 0.0

    def add(self, at: Sequence[BodyPose], moving: Sequence[Velocity]) -> None:
        """Note the energy at these poses and velocities."""
        self._last = self._height_m(at, moving)
        self._least = min(self._least, self._last)
        self._most = max(self._most, self._last - self._least)

    def rise(self, end_m: float | None = None) -> float:
        """The most that the energy rose above its least until then, as a share of the bound.

        end_m: energy that the fall ends with, if it is not the last until then.
        """
        return self._most / max(SHARE * (self._first - (self._last if end_m is None else end_m)), LIFT_M)

    def _height_m(self, at: Sequence[BodyPose], moving: Sequence[Velocity]) -> float:
        """The height at which their centre of mass has as much at rest."""
        height_m = 0.0
        for share, radii2, pose, motion in zip(self._shares, self._radii2, at, moving, strict=True):
            height_m += share * energy_height_m(radii2, pose, motion)
        return height_m


def energy_height_m(radii2: Sequence[float], at: BodyPose, moving: Velocity) -> float:
    """The energy of a body over its weight, metres, from these squares [3] of its radii of inertia, metres squared."""
    (_, _, height), (x, y, z, w) = at
    (u, v, s), (p, q, r) = moving
    # The angular velocity along the body's axes
    along = (
        (1 - 2 * (y * y + z * z)) * p + 2 * (x * y + z * w) * q + 2 * (x * z - y * w) * r,
        2 * (x * y - z * w) * p + (1 - 2 * (x * x + z * z)) * q + 2 * (y * z + x * w) * r,
        2 * (x * z + y * w) * p + 2 * (y * z - x * w) * q + (1 - 2 * (x * x + y * y)) * r,
    )
    turning = radii2[0] * along[0] * along[0] + radii2[1] * along[1] * along[1] + radii2[2] * along[2] * along[2]
    return height + (u * u + v * v + s * s + turning) / (2 * GRAVITY_M_S2)


def strays(middles: Array, far_m: float) -> StopCondition:
    """Stop when a centre of mass is further than this from its middle [3], or from the vertical line through it [2]."""
    at, axes = middles.tolist(), middles.shape[1]
    return lambda number, now: math.dist(now[0][:axes], at[number]) > far_m


SAMPLE_STEPS = 8
"""Steps between two readings of the speeds: a reading costs as much as a step."""

LOOK_STEPS = 4
"""Steps between two looks at the energy of a single object. What it rises in between is up to the same again, and with eight
steps up to 68 times as much: it is least just after an impact."""

CALM_M_S = 0.05
"""Upper bound on the momentary speed of any point of a resting object: at this speed it climbs an eighth of a millimetre."""

FINEST = 16
"""Ratio of the longest step to the shortest."""

REACH_STEPS = 4.0
"""Travel in this many steps is the contact distance on a mesh: contacts exist before they close, and no earlier."""

STANDING_SHARE = 0.2
"""Share of the rest window after which something calm is asked whether it stands."""

SKIPPED_TO_M = 2e-4
"""Height of the lowest point above the ground at which the simulation takes over from free fall."""

TOP_S = 2.0 * LEAST_BOUNCE_M_S / GRAVITY_M_S2
"""Time for which what bounces is as slow about the top of its flight as impacts that do not bounce."""

DISCARDED_S = 1.0
"""Time from which a fall may end because it is discarded. What leaves a flat top before falls onto the mesh instead: of 4,200
scenes two ended elsewhere where falls were discarded at once, and none with this."""

THROWN, SLOW_M_S = 3.0, 0.5
"""Ratio of a speed to that of a fall from the highest start, from which long steps threw an object: of two balls that fall as one
a far lighter upper one leaves at three times the speed at most. And a speed at which nothing has flown off."""


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
    face: of its hull that an object stands on, where that ended it. lost: the numbers of those that were put away; thrown: of
    those that were ever faster than a fall makes them, and the speed of the fastest, m/s. spinning: of those that do nothing but
    spin about the vertical, as fast as at first. moves: where not all rested, of what does not rest the number, the speed, m/s,
    and the spin, rad/s. steps: that were simulated.
    """

    poses: tuple[Pose, ...]
    speed_m_s: float
    seconds: float
    rested: bool
    stopped_by: str | None = None
    rise: float = 0.0
    face: Face | None = None
    lost: tuple[int, ...] = ()
    thrown: frozenset[int] = frozenset()
    thrown_m_s: float = 0.0
    spinning: tuple[int, ...] = ()
    moves: tuple[int, float, float] = (0, 0.0, 0.0)
    steps: int = 0


@dataclass(frozen=True)
class Watch:
    """What a simulation looks at beside rest.

    stops: conditions by name, of which one ends it. leaves: what holds of an object that is put away, while the others go on.
    standing: ends the fall of a single object sooner. sleeping: what rests costs no time until something that moves touches it.
    apart: pairs of bodies that cannot meet before it ends, which cost no time. most_rise: rise of energy from which the fall is
    discarded: it ends, by `rise`, once it is sure to rise by as much, even if all bodies end at the height `lowest_m`, world z.
    """

    stops: Mapping[str, StopCondition] = field(default_factory=dict)
    leaves: StopCondition | None = None
    standing: StandingCondition | None = None
    sleeping: bool = False
    apart: Sequence[tuple[int, int]] = ()
    most_rise: float = math.inf
    lowest_m: float = -math.inf


def fall(
    bodies: Sequence[Body],
    poses: Sequence[Pose],
    ground: GroundShape,
    physics: Physics,
    steps: StepSizes,
    free_m: float,
    watch: Watch = Watch(),
    reach_m: float = math.inf,
) -> Outcome:
    """Release objects at `poses` (`T_world_obj`) until all rest, `physics.max_settle_s` is over, or a stop condition holds.

    The first `free_m` metres are fallen in closed form, which is exact: nothing turns in the air. reach_m: contact distance, if
    less than Bullet's own; on a mesh it follows from the steps.
    """
    fallen_m = min(max(0.0, free_m - SKIPPED_TO_M), GRAVITY_M_S2 * physics.max_settle_s**2 / 2)
    placed = [(body, translation(0, 0, -fallen_m) @ T @ body.T_obj_body) for body, T in zip(bodies, poses, strict=True)]
    speed_m_s = math.sqrt(2.0 * GRAVITY_M_S2 * fallen_m)
    fallen_s = speed_m_s / GRAVITY_M_S2
    if isinstance(ground, Mesh | tuple):
        reach_m = min(reach_m, REACH_STEPS * max(steps.max_travel_m, speed_m_s / (FINEST * physics.step_hz)))
    with open_world(placed, ground, physics, steps.looked, reach_m, steps.kept) as world:
        for number in range(len(bodies)):
            world.set_velocity((0.0, 0.0, -speed_m_s), body=number)
        for pair in watch.apart:
            world.keep_apart(*pair)
        outcome = _Simulation(world, bodies, physics, steps, watch).run(physics.max_settle_s - fallen_s)
    ended = tuple(T @ invert(body.T_obj_body) for T, body in zip(outcome.poses, bodies, strict=True))
    return dataclasses.replace(outcome, poses=ended, seconds=outcome.seconds + fallen_s)


@dataclass
class _Stillness:
    """How long a body has stayed near its `anchor`: since this time, seconds, and moved by these metres."""

    anchor: BodyPose
    since: float = 0.0
    moved_m: float = 0.0


SPIN_KEPT = 0.8
"""Share of a spin that is left after the last window if nothing slows it: its contact is on its axis, or without friction."""


@dataclass(frozen=True)
class _Late:
    """Where a body was as the last window began, and its spin about the vertical, rad/s."""

    pose: BodyPose
    spin_rad_s: float

    def spins_on(self, at: BodyPose, moving: Velocity, rest: Rest, reach_m: float) -> bool:
        """Whether the body has done nothing since but spin: it neither drifted nor leant further, and is calm but for that."""
        (v, (p, q, r)), window_s = moving, rest.window_s
        leant = math.dist(as_pose(self.pose)[2, :3], as_pose(at)[2, :3])
        stays = (
            math.dist(self.pose[0], at[0]) <= rest.speed_mm_s / 1e3 * window_s and leant <= rest.spin_rad_s * window_s
        )
        calm = math.hypot(*v) + math.hypot(p, q) * reach_m <= CALM_M_S
        return stays and calm and abs(r) >= SPIN_KEPT * abs(self.spin_rad_s)


class _Simulation:
    """Bodies in a world, stepped until they rest; the poses are those of the body frames.

    A body rests when for the whole window no point moved further than the rest speed allows, it turned no further than the rest
    spin allows, and no point was faster than `CALM_M_S`. Displacement decides and not speed: Bullet's contact points flicker
    between the many vertices of a round rim, and an object at rest may rattle by micrometres at some millimetres per second for
    ever.
    """

    def __init__(self, world: World, bodies: Sequence[Body], physics: Physics, steps: StepSizes, watch: Watch) -> None:
        self.world, self.bodies, self.physics, self.steps, self.watch = world, bodies, physics, steps, watch
        self.time, self.rate_hz = 0.0, physics.step_hz * 1.0
        self.bounces, self.slow_s = physics.restitution > 0.0, math.inf
        self._read()
        self.speeds = _speeds(bodies, self.moving)
        self.still = [_Stillness(pose) for pose in self.at]
        self.energy = EnergyRecord(bodies, self.at, self.moving)
        heights = [pose[0][2] for pose in self.at]
        slowest = min(math.hypot(*v) for v, _ in self.moving)
        self.low_m, self.top_m = min(heights), max(heights) + slowest**2 / (2.0 * GRAVITY_M_S2)
        self.lost, self.thrown, self.thrown_m_s = list[int](), set[int](), 0.0
        self.asked_s, self.taken = -1.0, 0
        self.late = list[_Late]()

    def run(self, end_s: float) -> Outcome:
        """Step until all rest, `end_s` seconds are over or a stop condition holds."""
        while True:
            self._set_pace()
            self._advance()
            if len(self.bodies) > 1:
                self._find_thrown()
                self._put_away()
            self.speeds = _speeds(self.bodies, self.moving)
            if self.time > DISCARDED_S and self.energy.rise(self.watch.lowest_m) >= self.watch.most_rise:
                return self._outcome(max(self.speeds), False, "rise")
            for name, stop in self.watch.stops.items():
                if any(stop(number, pose) for number, pose in enumerate(self.at)):
                    return self._outcome(max(self.speeds), False, name)
            self._follow_stillness()
            face = self._face_stood_on()
            if face is not None or all(self._rests(each) for each in self.still):
                drift_m_s = max(each.moved_m / (self.time - each.since) for each in self.still)
                return self._outcome(drift_m_s, True, face=face)
            if self.time >= end_s:
                return self._out_of_time()
            if not self.late and self.time >= end_s - self.physics.rest.window_s:
                self.late = [_Late(pose, w[2]) for pose, (_, w) in zip(self.at, self.moving, strict=True)]

    def _read(self) -> None:
        numbers = range(len(self.bodies))
        self.at, self.moving = [self.world.pose(k) for k in numbers], [self.world.velocity(k) for k in numbers]

    def _set_pace(self) -> None:
        """Steps as short as the speeds ask for, and no more bounces once all is slow."""
        wanted_hz = self.steps.rate_hz(max(self.speeds))
        self.slow_s = min(self.slow_s, self.time) if max(self.speeds) < LEAST_BOUNCE_M_S else math.inf
        if self.bounces and self.time - self.slow_s > TOP_S:
            self.world.set_restitution(0.0)
            self.bounces, self.rate_hz = False, 0.0
        if wanted_hz != self.rate_hz:
            self.world.set_rate(wanted_hz)
            self.rate_hz = wanted_hz

    def _advance(self) -> None:
        for _ in range(SAMPLE_STEPS // self.steps.looked):
            self.world.advance()
            self._read()
            self.energy.add(self.at, self.moving)
        self.time += SAMPLE_STEPS / self.rate_hz
        self.taken += SAMPLE_STEPS

    def _find_thrown(self) -> None:
        """Notes bodies that are faster than a fall from the highest start makes them."""
        for number, (pose, (v, _)) in enumerate(zip(self.at, self.moving, strict=True)):
            speed, fallen_m = math.hypot(*v), self.top_m - min(self.low_m, pose[0][2])
            if speed > max(SLOW_M_S, THROWN * math.sqrt(2.0 * GRAVITY_M_S2 * fallen_m)):
                self.thrown.add(number)
                self.thrown_m_s = max(self.thrown_m_s, speed)

    def _put_away(self) -> None:
        leaves = self.watch.leaves
        if leaves is None:
            return
        for number in range(len(self.bodies)):
            if number not in self.lost and leaves(number, self.at[number]):
                self.world.put_away(number)
                self.lost.append(number)
                self.at[number], self.moving[number] = self.world.pose(number), self.world.velocity(number)

    def _follow_stillness(self) -> None:
        """Since when each body has stayed where it is; what has for a whole window may sleep."""
        rest = self.physics.rest
        drift_m, turn_rad = rest.speed_mm_s / 1e3 * rest.window_s, rest.spin_rad_s * rest.window_s
        for number, (still, pose, body) in enumerate(zip(self.still, self.at, self.bodies, strict=True)):
            turned = _angle(still.anchor[1], pose[1])
            still.moved_m = math.dist(still.anchor[0], pose[0]) + turned * body.reach_m
            if self.speeds[number] > CALM_M_S or still.moved_m > drift_m or turned > turn_rad:
                still.anchor, still.since = pose, self.time
            elif self.watch.sleeping and self._rests(still):
                self.world.let_sleep(number)

    def _rests(self, still: _Stillness) -> bool:
        return self.time - still.since >= self.physics.rest.window_s

    def _face_stood_on(self) -> Face | None:
        """The face that a single calm object stands on; asked once after each time that it moved."""
        standing, since = self.watch.standing, self.still[0].since
        if standing is None or not self.asked_s < since <= self.time - STANDING_SHARE * self.physics.rest.window_s:
            return None
        self.asked_s = self.time
        return standing(self.at[0], self.moving[0])

    def _out_of_time(self) -> Outcome:
        """The time is over and something moves: all of it may do nothing but spin, which counts as rest."""
        rest, moves = self.physics.rest, [k for k, still in enumerate(self.still) if not self._rests(still)]
        reach_m = [body.reach_m for body in self.bodies]
        if self.late and all(self.late[k].spins_on(self.at[k], self.moving[k], rest, reach_m[k]) for k in moves):
            return dataclasses.replace(self._outcome(max(self.speeds), True), spinning=tuple(moves))
        fastest = max(moves, key=lambda k: self.speeds[k])
        v, w = (math.hypot(*each) for each in self.moving[fastest])
        return dataclasses.replace(self._outcome(max(self.speeds), False), moves=(fastest, v, w))

    def _outcome(self, speed_m_s: float, rested: bool, name: str | None = None, face: Face | None = None) -> Outcome:
        # What others stop begins anew, or is let go again where it stops
        rise = self.energy.rise() if name in (None, "below", "rise") else 0.0
        away = tuple(self.lost), frozenset(self.thrown), self.thrown_m_s
        return Outcome(
            tuple(map(as_pose, self.at)), speed_m_s, self.time, rested, name, rise, face, *away, steps=self.taken
        )


def _speeds(bodies: Sequence[Body], moving: Sequence[Velocity]) -> list[float]:
    """For each body an upper bound on the speed of its fastest point, m/s."""
    return [math.hypot(*v) + math.hypot(*w) * body.reach_m for (v, w), body in zip(moving, bodies, strict=True)]


def _angle(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle, radians, of the rotation between two unit quaternions; for small rotations the chord is half the angle."""
    return 4.0 * math.asin(min(1.0, 0.5 * min(math.dist(a, b), math.dist(a, [-c for c in b]))))
