"""The release of a scene's objects in the simulator, with the effects that the plan runs, at one pace after another."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Array
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart, Table
from workers.geometry.frames import transform
from workers.physics.bullet import SLOP_SHARE, GroundShape
from workers.physics.convex_parts import parts_of
from workers.physics.fall import (
    LOOK_STEPS,
    SAMPLE_STEPS,
    THIN_SHARE,
    Outcome,
    Watch,
    choose_steps,
    fall,
    falls_below,
    free_fall_m,
    leaves_outline,
    stays_standing,
    strays,
)
from workers.physics.pour import AT_ONCE, NOTHING_MORE, Pouring
from workers.physics.rigid_body import build_body, choose_collision_shape
from workers.physics.support import SAME_LEVEL_M

MANY, CROWD = 4, 25
"""Number of objects from which they fall as coarser convex parts, as time grows with the pairs of parts that are near. And that
from which they fall in the finest steps at once, and are not let go again: a second of that takes a hundred two minutes."""

GROUP_TRAVEL = 40.0
"""Several objects may travel so many times further in a step, 2 mm. Where they come to rest is chaotic: its distribution
matters and not the path. At twice that corners sink into the walls of mugs, which are 2 to 3 mm thick."""

LEFT_M = 0.05
"""Depth of a centre of mass below the table's top at which the object has left the table."""

PRISM_M = 0.5
"""Height of the body that stands for a flat top with its edges: nothing passes through it in a step. It spares the second drop,
onto the mesh, of the many that roll to an edge; a stack on it gains energy, four times the bound, and none on a slab."""


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

PACES_MANY = (Pace(rate=0.5, iterations=0.25, window=0.1, speed=10.0, thin=0.25, coarse=True), Pace(coarse=True))
"""Of many concave objects, the second where they do not come to exact rest. Their bounces are more than a rise of energy."""

PACES_POURED = (dataclasses.replace(PACES_MANY[0], rate=0.25),)
"""Of those that fall in waves: of nine heaps of 25 in three quarters of the time. To draw again what finds no balance is sooner
done than to drop all at a finer pace."""


@dataclass
class Budget:
    """What letting go may still cost a scene: steps times the square of the pieces that take part."""

    left: float = math.inf


LET_GO_COST = 3e8
"""What letting go may cost a scene: some five seconds, at 16 nanoseconds each (measured of 190 to 820 pieces)."""


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

    @property
    def many(self) -> bool:
        """Whether there are many objects, some of them concave."""
        return len(self.starts) >= MANY and self.effects.runs("decomposition")

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
        return (PACES_POURED,) if self.poured else (PACES_MANY[:1], PACES_MANY[1:])


def release(drop: Drop, flat: bool, paces: Sequence[Pace]) -> Outcome:
    """Release the objects where they start, onto the table's flat top or its mesh, until they rest or must be stopped.

    Stopped by `edge` where a footprint may leave the flat top, `below` where an object falls below the mesh, or among many
    below the top, and `room` where a single object leaves its room. Released again at the next pace where their energy rose,
    where one flew off, and where several did not rest.
    """
    for pace in paces:
        outcome = _release(drop, flat, pace, LOOK_STEPS if drop.single else SAMPLE_STEPS)
        if drop.single and pace != paces[-1] and DOUBTFUL_RISE <= outcome.rise < KNOWN_RISE:
            outcome = _release(drop, flat, pace, 1)
        slow_enough = outcome.rise < (KNOWN_RISE if drop.single else MOST_RISE) and not outcome.thrown
        if slow_enough and (drop.single or outcome.rested or outcome.stopped_by):
            break
    return outcome


def _release(drop: Drop, flat: bool, pace: Pace, looked: int) -> Outcome:
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
        standing = stays_standing(starts[0], bodies[0], table.top.height_m, physics.friction**2)
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
    watch = Watch(stops, below if goes_on else None, standing, sleeping=drop.many)
    return fall(bodies, poses, ground, physics, steps, free_m, watch)


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
