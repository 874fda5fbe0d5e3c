"""The physics step: objects from release to rest.

Objects are simulated until calm, brought to exact rest, measured, and refused where they do not rest.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose, frozen_array
from schemas.errors import SettleError
from schemas.job.assets import TABLE
from schemas.job.physics import Physics
from schemas.scene.scene import ContactForce, EffectPlan, ObjectStart, ScenePlan, Settled
from schemas.scene.shape import REGION_TABLE, Mesh, Shape
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import translation
from workers.geometry.mesh import join_meshes
from workers.physics.contacts import DEEPEST_M
from workers.physics.effects import ONLY_LATE, REMOVED, SPIN_LEFT, called_for, called_for_with, rooms_m
from workers.physics.ending import Ending, UnsupportedError, describe, describe_kept, require_calm
from workers.physics.fall import Outcome
from workers.physics.hold import RELEASE_RATE, hold, land, moved_by, release_again
from workers.physics.placement import (
    Form,
    Placement,
    farthest_m,
    find_gaps_m,
    find_overlaps_m,
    forms_of,
    place,
    place_on_top,
    placed_mesh,
    require_near_origin,
)
from workers.physics.pour import (
    NOTHING_MORE,
    LostError,
    Pouring,
    clearances_m,
    lift,
    moved_to,
    next_wave,
    points_of,
    renumbered,
)
from workers.physics.release import (
    LET_GO_COST,
    LOST_STEPS,
    Budget,
    Drop,
    Pace,
    release,
)
from workers.physics.support import snap_to_face, vertical_gap

PLACED_M = 1e-4
"""Height up to which an object was set down and not dropped, where it lands at 44 mm/s, and greatest overlap of objects at
release: correcting centimetres by a share per step gives tens of metres per second."""

STAYED_M = 1e-3
"""Motion from where they were set down up to which objects stayed there: three gaps of `PLACED_M` at the end of a lever."""

MOST_RELEASES, POURED_RELEASES = 3, 6
"""Times that objects are released, each from where exact rest gave up the time before; and those of a pile that fell in waves."""

WAVE_S, POURED_S = 0.7, 4.0
"""Time that a wave has before the next one falls on it, and the last before exact rest, whether it has come to rest or not."""


class LeftRoomError(Exception):
    """An object settled as if alone came where it may meet another."""


class LeftTopError(Exception):
    """A footprint left the flat top, so that the table's edges may matter."""


def settle(drop: Drop) -> tuple[tuple[ObjectStart, ...], tuple[Settled, ...]]:
    """Settle a single object, or several that may touch one another; with where each began, and without what was removed.

    Raises SettleError `objects_overlap`, `not_at_rest`, `left_table`, `unsupported` or `table_too_fine`, and LeftRoomError
    where a single object leaves its room.
    """
    drop = dataclasses.replace(drop, budget=Budget(LET_GO_COST, LOST_STEPS if drop.single else math.inf))
    forms, again = forms_of(drop.starts), dict[int, int]()
    for start in drop.starts:
        require_near_origin(start)
    poses = tuple(start.T_world_obj for start in drop.starts)
    if not drop.effects.runs("dynamics"):
        return drop.starts, describe(Ending(drop, _place(drop, poses, forms), poses))
    _require_apart(drop.starts, find_overlaps_m(forms, poses))
    if drop.physics.exact_rest and (placed := _rest_as_placed(drop, forms, poses)) is not None:
        return drop.starts, describe(placed)
    if drop.pouring.waves:
        drop = dataclasses.replace(drop, clearances_m=clearances_m(drop.starts, drop.table))
    while True:
        try:
            return drop.starts, _settle_in_ways(drop, forms)
        except LostError as lost:
            drop = _without_lost(drop, lost, again)
            forms = forms_of(drop.starts)


def _require_apart(starts: Sequence[ObjectStart], overlaps: Iterable[tuple[int, int, float]], first: int = 0) -> None:
    """Raises SettleError where two objects overlap, one of them from the number `first` on."""
    for i, j, depth_m in overlaps:
        if depth_m > PLACED_M and j >= first:
            raise SettleError(
                "objects_overlap",
                f"regions {starts[i].region_id} and {starts[j].region_id} begin {depth_m * 1e3:.2f} mm inside one another: let "
                "them go apart, or one above the other",
            )


def _without_lost(drop: Drop, lost: LostError, again: dict[int, int]) -> Drop:
    """The drop once more, with what was lost drawn again above what has fallen, or removed; raises `lost` where neither may be.

    again: how often each was drawn, by its region, which is counted.
    """
    pouring, starts = drop.pouring, list(moved_to(drop.starts, lost.poses))
    kept = [number for number in range(len(starts)) if number not in lost.numbers]
    if pouring.remove and not all(starts[number].is_clutter for number in kept) and lost.reason != "thrown":
        lying, ready = (frozenset(kept.index(n) for n in kept if n in some) for some in (lost.fallen, drop.ready))
        clear_m = tuple(drop.clearances_m[number] for number in kept) if drop.clearances_m else ()
        fewer = renumbered([starts[number] for number in kept])
        return dataclasses.replace(drop, starts=fewer, lying=lying, ready=ready, clearances_m=clear_m)
    others = [points_of(starts[number]) for number in sorted(lost.fallen)]
    for number in lost.numbers:
        region = starts[number].region_id
        again[region] = again.get(region, 0) + 1
        if pouring.draw is None or again[region] > pouring.most or drop.budget.falls < 0.0:
            raise lost
        starts[number] = pouring.draw(drop.starts[number], again[region], others)
        others.append(points_of(starts[number]))
    ready = drop.ready.union(lost.numbers)
    return dataclasses.replace(drop, starts=tuple(starts), lying=lost.fallen, ready=ready)


def _settle_in_ways(drop: Drop, forms: Sequence[Form]) -> tuple[Settled, ...]:
    """Settle at the first of the drop's paces at which what comes to rest is accepted."""
    drop = _on_top_or_mesh(drop, _pour)
    *earlier, last = drop.ways
    for paces in earlier:
        used = set[Pace]()
        try:
            return describe(_on_top_or_mesh(drop, partial(_come_to_rest, forms=forms, paces=paces, used=used)))
        except UnsupportedError:
            if used <= set(last):  # the last way would be the same once more
                raise
    return describe(_on_top_or_mesh(drop, partial(_come_to_rest, forms=forms, paces=last, used=set())))


Result = TypeVar("Result")


def _on_top_or_mesh(drop: Drop, run: Callable[[Drop, bool], Result]) -> Result:
    """What `run` of the drop and whether the table is its flat top gives: of that alone if it may be, else of the mesh."""
    if not drop.effects.runs("table_mesh"):
        with suppress(LeftTopError):
            return run(drop, True)
        late = called_for_with("table_mesh", drop.starts, drop.physics)
        drop = dataclasses.replace(drop, effects=add_effects(drop.effects, late))
    return run(drop, False)


def add_effects(effects: EffectPlan, names: Iterable[str]) -> EffectPlan:
    """The plan with these effects run too."""
    return dataclasses.replace(effects, ran=(*effects.ran, *names))


def _come_to_rest(drop: Drop, flat: bool, forms: Sequence[Form], paces: Sequence[Pace], used: set[Pace]) -> Ending:
    """Release at these paces until at rest, and add to `used` those that a release ended at.

    The simulation may end with objects that rolling friction or a shape's margin holds out of balance. They are followed
    as they tip or slip, and released again where that takes them far. Raises LeftTopError, LeftRoomError and SettleError.
    """
    exact, heaped, seconds = drop.physics.exact_rest, bool(drop.lying), drop.seconds
    if exact and (landed := land(drop, flat, forms)) is not None:
        return Ending(drop, *landed)
    placement, moved = None, 0
    most = POURED_RELEASES if heaped else MOST_RELEASES
    for _ in range(most):
        outcome, pace = _release(_briefly(drop, POURED_S) if heaped and exact else drop, flat, paces, used)
        seconds += outcome.seconds
        require_calm(drop, outcome, range(len(drop.starts)), moving=heaped and exact)
        if exact and flat and drop.single and (standing := _stand(drop, outcome, seconds)) is not None:
            return standing
        placement = placement or _place(drop, outcome.poses, forms)
        ending = Ending(drop, placement, outcome.poses, seconds, outcome.speed_m_s, bool(outcome.spinning))
        if not exact:
            return ending
        rested = hold(drop, placement, outcome.poses)
        if rested.still:
            return dataclasses.replace(ending, poses=rested.poses)
        finer = paces[list(paces).index(pace) + 1 :]
        if drop.single and pace.coarse and finer:
            # Coarse parts may let it in too deep for exact rest to see, which then goes through the table.
            gap_m, _ = find_gaps_m(placement.forms, (*rested.poses, np.eye(4)))
            if gap_m < -DEEPEST_M:
                paces = finer
                continue
        pairs = zip(drop.starts, outcome.poses, rested.poses, strict=True)
        moved = int(np.argmax([farthest_m([start], [before], [after]) for start, before, after in pairs]))
        drop = dataclasses.replace(drop, starts=moved_to(drop.starts, rested.poses))
    raise UnsupportedError(
        "unsupported",
        f"{'it' if drop.single else f'region {drop.starts[moved].region_id} ({drop.starts[moved].asset.category})'} tips or "
        f"slips on without end: released {most} times, for {seconds:.1f} s in all, it never came into balance"
        f"{': let it fall elsewhere, or in another size' if rested.balanced or not drop.single else ': raise physics.friction'}",
        [moved],
        rested.poses,
        range(len(drop.starts)),
    )


def _release(drop: Drop, flat: bool, paces: Sequence[Pace], used: set[Pace]) -> tuple[Outcome, Pace]:
    outcome, pace = release(drop, flat, paces)
    used.add(pace)
    if outcome.stopped_by == "room":
        raise LeftRoomError
    if outcome.stopped_by == "edge":
        raise LeftTopError
    return outcome, pace


def _pour(drop: Drop, flat: bool) -> Drop:
    """The drop with all waves but the last where they lie. Raises LeftTopError and SettleError."""
    while drop.pouring.waves:
        drop, falling = _raise_next_wave(drop)
        if len(falling) == len(drop.starts):
            break
        few = dataclasses.replace(drop, starts=tuple(drop.starts[number] for number in falling))
        outcome, _ = _release(_briefly(few, WAVE_S), flat, drop.ways[0][:1], set())
        poses = [start.T_world_obj for start in drop.starts]
        for number, T in zip(falling, outcome.poses, strict=True):
            poses[number] = T
        lost, thrown = (tuple(falling[k] for k in some) for some in (outcome.lost, outcome.thrown))
        whole = dataclasses.replace(outcome, poses=tuple(poses), lost=lost, thrown=frozenset(thrown))
        require_calm(drop, whole, falling, moving=True)
        seconds, starts = drop.seconds + outcome.seconds, moved_to(drop.starts, poses)
        drop = dataclasses.replace(drop, starts=starts, lying=frozenset(falling), seconds=seconds)
    return drop


def _raise_next_wave(drop: Drop) -> tuple[Drop, list[int]]:
    """(the drop, with its next wave above what lies and above one another; the numbers of what lies and of that wave)."""
    wave, starts = next_wave(len(drop.starts), drop.lying), list(drop.starts)
    if drop.lying:
        below = set(drop.lying)
        for number in wave:
            if number not in drop.ready:
                others = [starts[each] for each in sorted(below)]
                starts[number] = lift(starts[number], others, drop.table, drop.clearances_m[number])
            below.add(number)
    drop = dataclasses.replace(drop, starts=tuple(starts), ready=drop.ready.union(wave))
    return drop, sorted(drop.lying.union(wave))


def _briefly(drop: Drop, most_s: float) -> Drop:
    """The drop, simulated for no longer than this."""
    seconds = min(most_s, drop.physics.max_settle_s)
    return dataclasses.replace(drop, physics=drop.physics.model_copy(update={"max_settle_s": seconds}))


def _rest_as_placed(drop: Drop, forms: Sequence[Form], poses: tuple[Pose, ...]) -> Ending | None:
    """Objects that begin in touch and in balance, as a stack that was built; None where they have to fall."""
    if min(points_of(start)[:, 2].min() for start in drop.starts) > drop.table.top.height_m + PLACED_M:
        return None
    placement = _place(drop, poses, forms)
    if max(find_gaps_m(placement.forms, [*poses, np.eye(4)])[:-1]) > PLACED_M:
        return None
    rested = placement.rest(poses)
    stayed = rested.still and farthest_m(drop.starts, poses, rested.poses) <= STAYED_M
    return Ending(drop, placement, rested.poses) if stayed else None


def _place(drop: Drop, poses: Sequence[Pose], forms: Sequence[Form]) -> Placement:
    return place(drop.starts, poses, forms, drop.table, drop.physics)


def _stand(drop: Drop, outcome: Outcome, seconds: float) -> Ending | None:
    """A single object turned onto the steady face of its hull that is below it, on the flat top; None where none is near."""
    (start,), table = drop.starts, drop.table
    known = None if drop.physics.collision == "box" else outcome.face  # a box has other faces than the object's hull
    T = snap_to_face(outcome.poses[0], start.hull, start.asset.mass.com, known)
    if T is None:
        return None
    T = translation(0.0, 0.0, -vertical_gap(placed_mesh(start, T), table.mesh)) @ T
    placement = place_on_top(start, T, table, drop.physics)
    return Ending(drop, placement, (T,), seconds, outcome.speed_m_s, bool(outcome.spinning))


LEFT_TOP, LEFT_ROOM = "a footprint left the table's flat top", "an object left the room that it had to itself"


@dataclass(frozen=True, eq=False)
class Rest:
    """Every object of a scene at rest, with where each began at last, and effects that the plan had skipped and why they ran."""

    starts: tuple[ObjectStart, ...]
    settled: tuple[Settled, ...]
    called: Mapping[str, str] = field(default_factory=dict)


def settle_scene(plan: ScenePlan, physics: Physics, effects: EffectPlan, pouring: Pouring = NOTHING_MORE) -> Rest:
    """Drop the scene's objects, wait until they rest, and correct the simulator's gap and tilt of single ones.

    Objects that cannot meet settle one by one. Raises SettleError `objects_overlap`, `not_at_rest`, `left_table`,
    `unsupported` or `table_too_fine`. A pure function: every simulation starts from an empty world.
    """
    starts, table, called = plan.objects, plan.table, dict[str, str]()
    if len(starts) > 1 and effects.runs("object_contacts"):
        began, settled = settle(Drop(starts, table, physics, effects, pouring=pouring))
    else:
        try:
            began, settled = _settle_alone(plan, physics, effects, pouring)
        except LeftRoomError:
            called = dict.fromkeys(called_for_with("object_contacts", starts, physics), LEFT_ROOM)
            began, settled = settle(Drop(starts, table, physics, add_effects(effects, called), pouring=pouring))
    if any(rest.support == "mesh" for rest in settled):
        called |= dict.fromkeys(called_for_with("table_mesh", starts, physics), LEFT_TOP)
    late = {REMOVED: len(began) < len(starts), SPIN_LEFT: any(rest.spun for rest in settled)}
    called |= {name: ONLY_LATE[name] for name, ran in late.items() if ran}
    return Rest(began, settled, {name: why for name, why in called.items() if not effects.runs(name)})


def _settle_alone(
    plan: ScenePlan, physics: Physics, effects: EffectPlan, pouring: Pouring
) -> tuple[tuple[ObjectStart, ...], tuple[Settled, ...]]:
    """Objects that cannot meet, one by one, without those that are lost where these are removed; the last is not."""
    began, settled, alone = list[ObjectStart](), list[Settled](), len(plan.objects) == 1
    for start, room_m in zip(plan.objects, rooms_m(plan.objects), strict=True):
        try:
            more = pouring if alone else NOTHING_MORE
            starts, rests = settle(Drop((start,), plan.table, physics, effects, room_m, more))
        except LostError as lost:
            if pouring.draw is not None and not alone:
                raise LeftRoomError from None  # a new start has another room
            if not pouring.remove or (start is plan.shown[-1] and not began) or lost.reason == "thrown":
                raise
            continue
        began += starts
        settled += rests
    return renumbered(began) if len(began) < len(plan.objects) else tuple(began), tuple(settled)


def keep_scene(plan: ScenePlan, physics: Physics, effects: EffectPlan, most_mm: float) -> Rest:
    """The scene's objects where they were put, measured there: they need not rest. Those not `placed` fall on them and the table.

    Clutter falls on all of it, and is left out where it finds no rest. Raises as `describe_kept` and `settle_scene`.
    """
    placed = tuple(start for start in plan.shown if start.placed)
    drop = Drop(placed, plan.table, physics, effects)
    poses = tuple(start.T_world_obj for start in placed)
    for start in placed:
        require_near_origin(start)
    rest = Rest(placed, describe_kept(Ending(drop, _place(drop, poses, forms_of(placed)), poses), most_mm))
    if falling := tuple(start for start in plan.shown if not start.placed):
        rest = _fall_over(plan, rest, falling, physics, effects)
    if clutter := plan.objects[len(plan.shown) :]:
        with suppress(SettleError):
            rest = _fall_over(plan, rest, clutter, physics, effects)
    return rest


def _fall_over(
    plan: ScenePlan, rest: Rest, falling: Sequence[ObjectStart], physics: Physics, effects: EffectPlan
) -> Rest:
    """With these objects at rest on what lies still, as on one body with the least of its frictions. Raises SettleError."""
    still, poses, ground = rest.starts, [each.T_world_obj for each in rest.settled], plan.ground
    assert ground is not None
    starts = (*still, *falling)
    begin = (*poses, *(start.T_world_obj for start in falling))
    _require_apart(starts, find_overlaps_m(forms_of(starts), begin), len(still))
    meshes, shape = [plan.table.mesh, *map(placed_mesh, still, poses)], plan.table.asset.shape
    closed = shape.closed and all(start.asset.shape.closed for start in still)
    table = dataclasses.replace(
        plan.table,
        asset=dataclasses.replace(plan.table.asset, shape=Shape(shape.parts, closed), lofted=None),
        mesh=join_meshes(meshes),
        top=dataclasses.replace(plan.table.top, convex=False),
    )
    if isinstance(physics.friction, dict):
        least = min(physics.friction_of(name) for name in (TABLE, *(start.asset.category for start in still)))
        physics = physics.model_copy(update={"friction": {**physics.friction, TABLE: least}})
    called = called_for(falling, table, physics)
    over = dataclasses.replace(plan, objects=tuple(falling), ground=dataclasses.replace(ground, table=table))
    fallen = settle_scene(over, physics, add_effects(effects, called))
    late = dict.fromkeys(sorted(called), "not all poses are kept") | dict(fallen.called)
    ends = np.cumsum([len(mesh.faces) for mesh in meshes])
    return _with_contacts(rest, fallen, table.mesh, ends, {**rest.called, **late})


def _with_contacts(rest: Rest, fallen: Rest, below: Mesh, ends: NDArray[np.int64], called: Mapping[str, str]) -> Rest:
    """Both, in order of region: contacts with one body of the table and of what lies still are those with the nearest of these.

    below: the table and what lies still, world, of which `ends` [bodies] count the faces up to each one's last. What lies still
    has the contacts with what fell on it too, but for clutter.
    """
    settled = list(rest.settled)
    for start, each in zip(fallen.starts, fallen.settled, strict=True):
        _, faces = distance_to_mesh(np.reshape([one.point for one in each.contacts], (-1, 3)), below)
        contacts = list(each.contacts)
        for number, (contact, part) in enumerate(
            zip(each.contacts, np.searchsorted(ends, faces, "right"), strict=True)
        ):
            if contact.with_region != REGION_TABLE or part == 0:
                continue
            under, point = settled[part - 1], contact.point
            contacts[number] = dataclasses.replace(contact, with_region=rest.starts[part - 1].region_id)
            if not start.is_clutter:
                normal, force = frozen_array(-contact.normal), frozen_array(-contact.force)
                pressed = (*under.contacts, ContactForce(start.region_id, point, normal, force))
                settled[part - 1] = dataclasses.replace(under, contacts=pressed)
        settled.append(dataclasses.replace(each, contacts=tuple(contacts)))
    starts = (*rest.starts, *fallen.starts)
    order = sorted(range(len(starts)), key=lambda number: starts[number].region_id)
    return Rest(tuple(starts[k] for k in order), tuple(settled[k] for k in order), called)


RECHECK_S = 1.0
"""Simulated time of the second release."""


def recheck_scene(
    plan: ScenePlan, rest: Rest, physics: Physics, effects: EffectPlan, rate: float = RELEASE_RATE
) -> Rest:
    """The same rest, with the motion of every object after a second release of all. rate: as of `release_again`."""
    effects, plan = add_effects(effects, rest.called), dataclasses.replace(plan, objects=rest.starts)
    poses = release_again(plan, rest.settled, physics, effects, RECHECK_S, rate)
    settled = []
    for start, before, after in zip(rest.starts, rest.settled, poses, strict=True):
        moved_mm, turned_deg = moved_by(start, before.T_world_obj, after)
        settled.append(dataclasses.replace(before, recheck_move_mm=moved_mm, recheck_turn_deg=turned_deg))
    return dataclasses.replace(rest, settled=tuple(settled))
