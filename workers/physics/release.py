"""The release of a scene's objects in the simulator, and their second release where they stand at rest on one another.

The first lets objects fall with the effects that the plan runs. The second tells whether they stay at exact rest, and where
they come to rest where friction lets go.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.base import Array, Pose
from schemas.errors import SettleError
from schemas.job.physics import Physics, Rest
from schemas.scene.scene import EffectPlan, ObjectStart, ScenePlan, Settled, Table
from workers.geometry.frames import motion_between, transform
from workers.physics.bullet import SLOP_M, SLOP_SHARE, GroundShape
from workers.physics.contact_surface import faces_within, skin_of
from workers.physics.contacts import contacts_within
from workers.physics.convex_parts import parts_of
from workers.physics.effects import is_convex
from workers.physics.exact_rest import LEVEL, MOST_STEPS, Rested, rest
from workers.physics.fall import (
    FINEST,
    LOOK_STEPS,
    SAMPLE_STEPS,
    THIN_SHARE,
    Outcome,
    StepSizes,
    Watch,
    choose_steps,
    fall,
    falls_below,
    free_fall_m,
    leaves_outline,
    stays_standing,
    strays,
)
from workers.physics.placement import Placement, farthest_m, forms_of, place
from workers.physics.pour import AT_ONCE, NOTHING_MORE, Pouring
from workers.physics.rigid_body import build_body, choose_collision_shape, make_body
from workers.physics.support import SAME_LEVEL_M, inside_margin, split_by_side

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
    iterations = math.ceil(math.sqrt(_unevenness(drop.starts)))
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


def _unevenness(starts: Sequence[ObjectStart]) -> float:
    """The largest mass over the smallest."""
    masses = [start.asset.mass.mass_kg for start in starts]
    return max(masses) / min(masses)


HELD = (9, Rest(speed_mm_s=0.05, window_s=0.05), 1.5e-5), (math.inf, Rest(speed_mm_s=0.05, window_s=1.0), 5e-5)
"""When what is let go stays, of fewer objects than this: slower than half of 0.1 mm/s, and moved by this at most, metres. Skins
make up their margins by up to 10 micrometres. Slips in heaps take longer to begin: of twenty boxes three stood for 0.6 s before
they went by half a millimetre; and some creep by 0.03 mm in a second, wherever they are."""

UNEVEN, UNEVEN_M = 8.0, 9e-5
"""Ratio of masses from which what is let go may move farther, by its fourth root, up to this: before Bullet's solver has found
the forces, a cube creeps by 24 micrometres under a hundred times its weight and by 60 under a thousand times; there by 240 with
a thirtieth of the iterations."""

STOPPED_M = 5e-5
"""The same of what has come to rest again: a cup in a tapered cup rises by eight times what its pieces stand out, which is up to
2 micrometres, as Bullet rounds them."""

RELEASE_RATE = 4.0
"""Steps a second in which objects are let go, in the settings'. In four times as many friction holds five times worse: of a gap
of nanometres Bullet lets a body close as much in a step as the step is short. Of single objects, at rest, tilted and lifted, both
refuse the same."""

POURED_HOLD_S = 0.1
"""The same time for what fell in waves: a second of fifteen takes 32 s."""

MOST_HOLDS = 3
"""Times that objects are let go before they fall anew, each from where they came to rest the time before, and twice as far."""

POURED_STEPS = 40
"""Steps of exact rest of a pile of many, a tenth of a second each, after which what still slides is released where it is."""

FAR_M = 2e-4
"""Motion of a centre of mass at which they are stopped at first: only faces within twice that are there to meet."""

THIN = 0.1
"""Margin of skins as a share of what bodies fall with, by which Bullet would lift the top of a stack of ten by 0.12 mm."""

SKIN_M = 1e-4
"""Depth of skins, and contact distance, above both margins: Bullet's own, of millimetres, finds many that do nothing."""

SPIKE = 2.0 * SKIN_M * np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0], [-0.1, -0.1, 1.0]])
"""[4, 3] metres, world: the piece above a corner that meets level ground, of which nothing else does."""


def hold(drop: Drop, placement: Placement, poses: Sequence[Pose]) -> Rested:
    """Exact rest of objects from these `T_world_obj`, in which they stay when they are let go; or how far they came.

    Forces that balance all weights do not exclude that friction lets go: of more contacts than equations there are many such
    forces, and bodies need not find them. What slips comes to exact rest anew, from where it went. A crowd is not let go.
    """
    still, held_m = next((still, most_m) for fewer_than, still, most_m in HELD if len(poses) < fewer_than)
    if drop.in_waves:
        still = still.model_copy(update={"window_s": POURED_HOLD_S})
    held_m = max(held_m, min(UNEVEN_M, held_m * (_unevenness(drop.starts) / UNEVEN) ** 0.25))
    spinning_m = 2.0 * drop.physics.friction * drop.physics.spinning_friction  # Bullet's arm
    changes = {"rest": still, "max_settle_s": 0.15 + still.window_s}
    held = dataclasses.replace(drop, physics=drop.physics.model_copy(update=changes))
    for far_m in (2.0**number * FAR_M for number in range(MOST_HOLDS)):
        most = POURED_STEPS if drop.in_waves else MOST_STEPS
        rested = rest(placement.things, poses, placement.forms[-1].surface, placement.friction, most, spinning_m)
        if not rested.still or len(poses) >= CROWD:
            return rested
        # No larger groups for what may move farther: the solver ends too early in them, and hides what slips
        groups = _groups(placement, rested.poses, level=False)
        poses, stopped = let_go(held, placement, rested.poses, far_m, groups)
        if farthest_m(drop.starts, rested.poses, poses) <= (max(held_m, STOPPED_M) if stopped else held_m):
            return rested
    return Rested(tuple(poses), False, 0, balanced=True)


def let_go(
    drop: Drop,
    placement: Placement,
    poses: Sequence[Pose],
    far_m: float = FAR_M,
    groups: Sequence[list[int]] | None = None,
    rate: float = RELEASE_RATE,
) -> tuple[tuple[Pose, ...], bool]:
    """(`T_world_obj` of objects, let go at these, once they rest, or one of them has moved by `far_m`; whether all came to rest).

    What cannot meet is let go on its own: beside others Bullet's solver ends before it has found the forces of each. groups:
    of those to let go; all, if not given. rate: steps a second, in the settings', but of one on anything else than level ground.
    """
    went, rested = list(poses), True
    for group in _groups(placement, poses, level=True) if groups is None else groups:
        few = dataclasses.replace(drop, starts=tuple(drop.starts[k] for k in group))
        outcome = _let_go(few, placement.of(group), [poses[k] for k in group], far_m, rate)
        rested = rested and outcome.rested
        for k, T in zip(group, outcome.poses, strict=True):
            went[k] = T
    return tuple(went), rested


def _groups(placement: Placement, poses: Sequence[Pose], level: bool) -> list[list[int]]:
    """The numbers of objects that can meet before one has moved by `FAR_M`; without `level` only those with contacts aslant."""
    contacts, count = contacts_within(placement.surfaces, (*poses, np.eye(4)), 2.0 * FAR_M), len(poses)
    paired, aslant = contacts.lower < count, np.linalg.norm(contacts.normals[:, :2], axis=1) > LEVEL
    pairs = np.ones(paired.sum()), (contacts.upper[paired], contacts.lower[paired])
    _, groups = connected_components(coo_array(pairs, shape=(count, count)), directed=False)
    asked = np.unique(groups if level else groups[contacts.upper[aslant]])
    return [np.flatnonzero(groups == each).tolist() for each in asked]


def _let_go(drop: Drop, placement: Placement, poses: Sequence[Pose], far_m: float, rate: float) -> Outcome:
    """The fall of objects that may meet.

    Their shapes are the skins of their meshes where they are near one another, in convex pieces: exact, and each with contacts of
    its own. Of two bodies that are one piece each Bullet keeps four contacts, chosen from some millimetres away, so that a
    box stands on three corners of four and on what it does not touch.
    """
    top, near_m = drop.table.top, 2.0 * far_m
    points = np.concatenate([transform(T, one.hull.vertices) for one, T in zip(drop.starts, poses, strict=True)])
    low_m, inside_m = points[:, 2].min(), inside_margin(points[:, :2], top.outline).min()
    level = top.convex and low_m > top.height_m - near_m and inside_m > near_m
    physics = settings_of(drop, Pace(rate=rate if level or not drop.single else FINEST))
    margins_m = [THIN * make_body(start).margin_m for start in drop.starts]
    slop_m = min(SLOP_M, SLOP_SHARE * min(margins_m))
    insets_m = [0.0 if drop.single else margin_m - slop_m / 2.0 for margin_m in margins_m]
    skins = _skins(placement, poses, near_m, top.height_m if level else -math.inf, insets_m)
    whole = [make_body(start, parts) for start, parts in zip(drop.starts, skins, strict=True)]
    bodies = [dataclasses.replace(body, margin_m=margin_m) for body, margin_m in zip(whole, margins_m, strict=True)]
    ground: GroundShape = split_by_side(drop.table.mesh)
    if level:
        ground = top.height_m - (margins_m[0] - insets_m[0] - slop_m)
    begun = np.stack([(T @ body.T_obj_body)[:3, 3] for T, body in zip(poses, bodies, strict=True)])
    watch, pieces = Watch({"far": strays(begun, far_m)}), sum(map(len, skins))
    if drop.budget.left <= 0.0:
        raise SettleError("unsupported", _too_much(drop, pieces))
    outcome = fall(bodies, poses, ground, physics, StepSizes(physics.step_hz, math.inf), 0.0, watch, reach_m=SKIN_M)
    drop.budget.left -= outcome.seconds * physics.step_hz * pieces**2
    return outcome


def _too_much(drop: Drop, pieces: int) -> str:
    names = ", ".join(f"{start.region_id} ({start.asset.category})" for start in drop.starts)
    return (
        f"regions {names} touch with {pieces} faces and do not stay when they are let go, which was tried for as long as a "
        "scene may take: use coarser meshes or fewer objects_per_scene, or let them fall apart by a wider start.pile_offset_m"
    )


def _skins(
    placement: Placement, poses: Sequence[Pose], near_m: float, level_m: float, insets_m: Sequence[float]
) -> list[tuple[Array, ...]]:
    """The pieces [N, 3] of each object, in its own frame, that are within this of others or of the table.

    insets_m: how far each one's are inside of its mesh, as margins and overlap stand out: a cup in a tapered cup would rise by
    eight times as much. level_m: height of the half-space that the table is here, -inf if it is none. Only corners of an object's
    hull can meet it: they stand for the foot of one that is not convex, a ring of a hundred faces.
    """
    surfaces, level = placement.surfaces, [math.isfinite(level_m) and not is_convex(one) for one in placement.starts]
    points = [transform(T, one.vertices) for T, one in zip((*poses, np.eye(4)), surfaces, strict=True)]
    near = [np.zeros(len(one.faces), dtype=np.bool_) for one in surfaces]
    for i, j in itertools.combinations(range(len(surfaces)), 2):
        if j < len(poses) or not level[i]:
            here, there = faces_within((points[i], surfaces[i].faces), (points[j], surfaces[j].faces), near_m)
            near[i][here] = near[j][there] = True
    skins = []
    for number, (start, T) in enumerate(zip(placement.starts, poses, strict=True)):
        low = start.hull.vertices[level[number] & (transform(T, start.hull.vertices)[:, 2] <= level_m + near_m)]
        skin = skin_of(surfaces[number], np.flatnonzero(near[number]), SKIN_M, insets_m[number])
        skins.append((*skin, *(corner + np.add(SPIKE, [0.0, 0.0, insets_m[number]]) @ T[:3, :3] for corner in low)))
    return skins


def release_again(
    plan: ScenePlan,
    settled: Sequence[Settled],
    physics: Physics,
    effects: EffectPlan,
    seconds: float,
    rate: float = RELEASE_RATE,
) -> tuple[Pose, ...]:
    """`T_world_obj` [4, 4] of every object this long after its release from where it rests, or once one moved by `FAR_M`.

    With the effects of the plan, without correction. Nothing counts as resting before the end. rate: steps a second, in the
    settings'.
    """
    calm = physics.rest.model_copy(update={"window_s": 2.0 * seconds})
    physics = physics.model_copy(update={"max_settle_s": seconds, "rest": calm})
    starts, poses = plan.objects, [each.T_world_obj for each in settled]
    placement = place(starts, poses, forms_of(starts), plan.table, physics.friction**2)
    return let_go(Drop(starts, plan.table, physics, effects), placement, poses, rate=rate)[0]


def moved_by(start: ObjectStart, before: Pose, after: Pose) -> tuple[float, float]:
    """(mm that the farthest point of an object moves between two poses, degrees that it turns)."""
    moved_m, turned_rad = motion_between(start.hull.vertices, before, after)
    return moved_m * 1e3, math.degrees(turned_rad)
