"""The release of a scene's objects in the simulator, with the effects that the plan runs, at one pace after another.

Here too is by what the steps are chosen, and what ends a simulation early.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from schemas.base import Array
from schemas.job.assets import TABLE
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart, Table
from workers.geometry.frames import invert, transform
from workers.geometry.hull import least_width_m
from workers.physics.bullet import SLOP_SHARE, GroundShape, contact_friction
from workers.physics.convex_parts import parts_of
from workers.physics.fall import (
    LIFT_M,
    LOOK_STEPS,
    SAMPLE_STEPS,
    Outcome,
    StandingCondition,
    StepSizes,
    StopCondition,
    Velocity,
    Watch,
    energy_height_m,
    fall,
    strays,
)
from workers.physics.pour import AT_ONCE, NOTHING_MORE, Pouring
from workers.physics.rigid_body import Body, BodyPose, as_pose, build_body, choose_collision_shape
from workers.physics.support import SAME_LEVEL_M, Face, find_face, inside_margin, support_height

MANY, CROWD = 4, 25
"""Number of objects from which they fall as coarser convex parts, as time grows with the pairs of parts that are near. And that
from which they fall in the finest steps at once, and are not let go again: a second of that takes a hundred two minutes."""

MOST_PAIRS = 10_000
"""Pairs of convex parts of different objects from which few fall as many do. Where thin walls lie in one another Bullet looks at
all parts of one beside each of the other's: a step of two bowls of 700 parts takes 3 ms, two thirds of it to find contacts."""

GROUP_TRAVEL = 40.0
"""Several objects may travel so many times further in a step, 2 mm. Where they come to rest is chaotic: its distribution
matters and not the path."""

LEFT_M = 0.05
"""Depth of a centre of mass below the table's top at which the object has left the table."""

PRISM_M = 0.5
"""Height of the body that stands for a flat top with its edges: nothing passes through it in a step. It spares the second drop,
onto the mesh, of the many that roll to an edge; a stack on it gains energy, four times the bound, and none on a slab."""


DROP_SHARE = 0.002
"""Travel per step as a share of the drop, where that is more than `physics.max_step_travel_mm`. Bounds the energy regained
at touchdown to a thousandth of the fall's."""

THIN_SHARE = 0.05
"""Upper bound on the travel per step, as a share of the thinnest object's width."""

SLIDE_M = 1e-7
"""Distance that an object may still slide. Bullet's own steps at rest move it by as much."""


@dataclass(frozen=True)
class Pace:
    """Steps per second, solver iterations, travel per step, rest window and rest speed, as shares of what the settings say.

    thin: upper bound on the travel per step, as a share of the thinnest object's width. coarse: fewer convex parts and
    vertices, where exact rest follows. kept: see `StepSizes`.
    """

    rate: float = 1.0
    iterations: float = 1.0
    travel: float = 1.0
    window: float = 1.0
    speed: float = 1.0
    thin: float = THIN_SHARE
    coarse: bool = False
    kept: float = 1.0


PACES = (
    Pace(rate=0.5, travel=6.0, coarse=True),
    Pace(travel=2.0),
    Pace(rate=2.0, travel=0.7),
    Pace(rate=4.0, travel=0.25),
)
"""Of a single object, one after the other while its energy rises."""

PACES_TOGETHER = (Pace(), Pace(rate=16.0, travel=0.25, speed=10.0, kept=0.85))
"""The same of several, where they are not many concave ones; the last alone of a crowd, and once more where others do not come to
exact rest. What iterations leave undone adds up, as in a spring, where all of an impulse is kept: a stack of twenty-five cubes
sways for ever, and rests in 0.3 s with 0.8 to 0.9 kept. In 960 steps a second a stack of eight sinks by millimetres then."""

MOST_RISE = 0.3
"""Rise of energy, as a share of its bound, up to which a pace was slow enough for several: the simulation looks every eight
steps, and between two looks the energy may have been lower."""

DOUBTFUL_RISE, KNOWN_RISE = 0.4, 0.9
"""The same for a single object. From the first share a drop is repeated with a look after each step, which changes nothing of
it; up to the second, known so, the pace was slow enough."""

PACES_FEW = (Pace(rate=0.5, iterations=0.25, window=0.1, speed=10.0, thin=0.25, coarse=True), Pace(coarse=True))
"""Of two or three of many parts, the second where they do not come to exact rest. Bounces are more than a rise of energy."""

PACES_MANY = (
    dataclasses.replace(PACES_FEW[0], rate=0.25, travel=2.0),
    dataclasses.replace(PACES_FEW[0], coarse=False),
)
"""Of many concave objects, the second for the one pile in a hundred that does not come to exact rest: coarse parts are up to
three millimetres too small, as thick as walls. The first takes 0.74 times as long as `PACES_FEW`; what is kept, and the heights,
places and faces of a hundred piles of eight, are the same within their intervals."""

PACES_POURED = (dataclasses.replace(PACES_FEW[0], rate=0.25),)
"""Of those that fall in waves: of nine heaps of 25 in three quarters of the time. To draw again what finds no balance is sooner
done than to drop all at a finer pace. With twice the travel, waves lie 6 % higher."""


@dataclass
class Budget:
    """What letting go may still cost a scene: steps times the pairs of pieces of objects that may meet.

    falls: steps after which a single object that is lost is not drawn again.
    """

    left: float = math.inf
    falls: float = math.inf


LET_GO_COST = 1e8
"""What letting go may cost a scene: some five seconds, at 50 to 70 nanoseconds each (measured of 3 to 7 cups in one another)."""

LOST_STEPS = 6e4
"""Steps of the falls of a single object, of which 1,000 scenes that ended well took 39,000 at most. A plate of 3 m, which no draw
leaves on its table, takes 0.4 ms for each, and would fall twenty times."""


@dataclass(frozen=True, eq=False)
class Drop:
    """Objects to be released over a table, with the settings and the plan of effects.

    room_m: how far the centre of mass of a single object may go sideways. lying, ready: the numbers of those that have fallen
    already, and of those that were drawn again and start from where they are; clearances_m: of each over those before it;
    seconds: that waves took. budget: of letting go.
    """

    starts: tuple[ObjectStart, ...]
    table: Table
    physics: Physics
    effects: EffectPlan
    room_m: float = math.inf
    pouring: Pouring = NOTHING_MORE
    lying: frozenset[int] = frozenset()
    ready: frozenset[int] = frozenset()
    clearances_m: tuple[float, ...] = ()
    seconds: float = 0.0
    budget: Budget = field(default_factory=Budget)

    @cached_property
    def many(self) -> bool:
        """Whether there are many objects, some of them concave, or few of so many parts that steps take long."""
        if not self.effects.runs("decomposition"):
            return False
        return len(self.starts) >= MANY or self._count_pairs() > MOST_PAIRS

    def _count_pairs(self) -> int:
        """Pairs of convex parts, as fine as they are, of different objects."""
        counts = [len(parts_of(start.asset, self.physics.concavity)) for start in self.starts]
        return (sum(counts) ** 2 - sum(count**2 for count in counts)) // 2

    @property
    def poured(self) -> bool:
        """Whether many fall in waves, and what finds no balance is drawn again."""
        return self.many and self.in_waves and self.pouring.draw is not None

    @property
    def in_waves(self) -> bool:
        """Whether the objects fall in more waves than one."""
        return self.pouring.waves and len(self.starts) > AT_ONCE

    @property
    def single(self) -> bool:
        """Whether there is one object."""
        return len(self.starts) == 1

    @property
    def ways(self) -> tuple[tuple[Pace, ...], ...]:
        """The paces to fall at, and those to fall at once more where what comes to rest is refused."""
        if self.single:
            return (PACES,)
        if len(self.starts) >= CROWD and not self.pouring.waves:
            return (PACES_TOGETHER[-1:],)
        if not self.many:
            return (PACES_TOGETHER, PACES_TOGETHER[-1:])
        if self.poured:
            return (PACES_POURED,)
        return tuple((pace,) for pace in (PACES_MANY if len(self.starts) >= MANY else PACES_FEW))


def release(drop: Drop, flat: bool, paces: Sequence[Pace]) -> tuple[Outcome, Pace]:
    """Release the objects where they start, onto the table's flat top or its mesh, until they rest or must be stopped.

    Returns the end and its pace. Stopped by `edge` where a footprint may leave the flat top, `below` where an object falls
    below the mesh, or among many below the top, and `room` where a single object leaves its room. Released again at the next
    pace where their energy rose, where one flew off, and where several did not rest.
    """
    looked, most_rise = (LOOK_STEPS, KNOWN_RISE) if drop.single else (SAMPLE_STEPS, MOST_RISE)
    for pace in paces[:-1]:
        outcome = _release(drop, flat, pace, looked, most_rise)
        if drop.single and DOUBTFUL_RISE <= outcome.rise < KNOWN_RISE:
            outcome = _release(drop, flat, pace, 1, most_rise)
        slow_enough = outcome.rise < most_rise and not outcome.thrown
        if slow_enough and (drop.single or outcome.rested or outcome.stopped_by):
            return outcome, pace
    return _release(drop, flat, paces[-1], looked, math.inf), paces[-1]


def _release(drop: Drop, flat: bool, pace: Pace, looked: int, most_rise: float) -> Outcome:
    table, effects, physics = drop.table, drop.effects, settings_of(drop, pace)
    starts = [choose_collision_shape(start, physics) for start in drop.starts]
    poses = [start.T_world_obj for start in starts]
    coarse = pace.coarse and physics.exact_rest
    bodies = [build_body(start, physics, effects, coarse, level=flat and drop.single) for start in starts]
    hulls = [transform(T, start.hull.vertices) for T, start in zip(poses, starts, strict=True)]
    free_m = min(free_fall_m(points, table, flat) for points in hulls)
    # On a mesh a single object keeps the shortest travel per step, however far it falls.
    drop_m = max(float(points[:, 2].min()) for points in hulls) - table.top.height_m
    steps = choose_steps(starts, physics, effects, drop_m if flat or not drop.single else 0.0, pace.thin)
    steps = dataclasses.replace(steps, looked=looked, kept=pace.kept)
    reach_m = max(body.reach_m for body in bodies)
    lowest_m = table.top.height_m - LEFT_M if drop.many else float(table.mesh.vertices[:, 2].min())
    below = falls_below(lowest_m - reach_m)
    goes_on = drop.pouring.goes_on and not drop.single
    stops = {} if goes_on else {"below": below}
    ground: GroundShape = table.mesh
    standing = None
    if flat and drop.single and physics.exact_rest:
        standing = stays_standing(starts[0], bodies[0], table.top.height_m, physics)
    if flat and not drop.many:
        hover_m = bodies[0].margin_m * (1.0 - SLOP_SHARE)
        ground, stops = table.top.height_m - hover_m, {"edge": leaves_outline(table.top.outline, reach_m)}
        goes_on = False
    elif flat:
        levels = (np.full((len(table.top.outline), 1), z) for z in (table.top.height_m, table.top.height_m - PRISM_M))
        ground = np.concatenate([np.hstack([table.top.outline, level]) for level in levels])
    elif not drop.single and table.asset.lofted is not None and not table.top.convex:
        ground = _parts_of_vessel(table)
    if math.isfinite(drop.room_m):
        stops["room"] = strays((poses[0] @ bodies[0].T_obj_body)[None, :2, 3], drop.room_m)
    # What is on the slab of the flat top is above it, but for what it sinks in
    least_m = (table.top.height_m if isinstance(ground, float) else lowest_m) - reach_m
    leaves = below if goes_on else None
    watch = Watch(stops, leaves, standing, sleeping=drop.many, most_rise=most_rise, lowest_m=least_m)
    outcome = fall(bodies, poses, ground, physics, steps, free_m, watch)
    drop.budget.falls -= outcome.steps
    return outcome


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


def _parts_of_vessel(table: Table) -> list[Array]:
    """The convex parts [N, 3], world, of a built-in tray or bin, without its legs.

    Its triangles have no inside: what lies under many others sinks through a floor of them.
    """
    parts = [transform(table.T_world_table, part) for part in parts_of(table.asset)]
    return [part for part in parts if part[:, 2].max() >= table.top.height_m - SAME_LEVEL_M]


def settings_of(drop: Drop, pace: Pace) -> Physics:
    """The settings at this pace, with those of effects that do not run at zero.

    Several objects may travel further in a step. They get more solver iterations: the solver goes from contact to contact, and
    an iteration carries the less of a force the more the masses differ, and the more objects lie on one another.
    """
    physics, rest = drop.physics, drop.physics.rest
    iterations = math.ceil(math.sqrt(unevenness(drop.starts)))
    rates = {"speed_mm_s": pace.speed * rest.speed_mm_s}
    changes: dict[str, object] = {
        "rest": rest.model_copy(update=rates | {"window_s": pace.window * rest.window_s}),
        "step_hz": max(1, round(pace.rate * physics.step_hz)),
        "solver_iterations": max(1, round(pace.iterations * iterations * physics.solver_iterations)),
        "max_step_travel_mm": pace.travel * (1.0 if drop.single else GROUP_TRAVEL) * physics.max_step_travel_mm,
    }
    if not drop.effects.runs("restitution"):
        changes["restitution"] = 0.0
    if not drop.effects.runs("rolling_friction"):
        changes |= {"rolling_friction": 0.0, "spinning_friction": 0.0}
    return physics.model_copy(update=changes)


def unevenness(starts: Sequence[ObjectStart]) -> float:
    """The largest mass over the smallest."""
    masses = [start.asset.mass.mass_kg for start in starts]
    return max(masses) / min(masses)


def leaves_outline(outline: Array, reach_m: float) -> StopCondition:
    """Stop when a body of this reach may extend beyond the edge of a convex outline [N, 2].

    Skips the edges while the body is nearer to the outline's middle than any edge, less the reach.
    """
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    x, y = middle.tolist()
    safe_m = float(inside_margin(middle[None, :], outline)[0]) - reach_m

    def leaves(_: int, at: BodyPose) -> bool:
        if math.hypot(at[0][0] - x, at[0][1] - y) < safe_m:
            return False
        return bool(inside_margin(np.array([at[0][:2]]), outline)[0] < reach_m)

    return leaves


def falls_below(height_m: float) -> StopCondition:
    """Stop when a centre of mass is below this height, world z."""
    return lambda _, at: at[0][2] < height_m


def stays_standing(start: ObjectStart, body: Body, top_m: float, physics: Physics) -> StandingCondition:
    """The condition of an object over a flat top at the height `top_m`.

    It has less energy than it takes to tip over the nearest edge of a steady face, and than friction takes up in `SLIDE_M`:
    m g h <= friction m g s. Energy may rise in the simulation, but not by more than `LIFT_M`.
    """
    friction = float(contact_friction(physics.friction_of(body.category), physics.friction_of(TABLE)))
    radii2 = [float(moment) / body.mass_kg for moment in body.moments]
    T_body_obj = invert(body.T_obj_body)

    def stands(at: BodyPose, moving: Velocity) -> Face | None:
        energy_m = energy_height_m(radii2, at, moving)
        if energy_m - at[0][2] > friction * SLIDE_M:
            return None
        face = find_face(as_pose(at) @ T_body_obj, start.hull, start.asset.mass.com)
        if face is None:
            return None
        over_m = max(0.0, energy_m - top_m - face.height_m)
        return face if over_m + LIFT_M <= math.hypot(face.height_m, face.margin_m) - face.height_m else None

    return stands
