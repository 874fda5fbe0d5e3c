"""The physics step: objects from release to rest, and a second release as a check.

Objects are simulated until calm, brought to exact rest, measured, and refused where they do not rest.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.errors import SettleError
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart, ScenePlan, Settled, SupportedBy
from workers.geometry.frames import motion_between, transform, translation
from workers.physics.effects import called_for_with, rooms_m
from workers.physics.exact_rest import rest
from workers.physics.fall import FINEST, Outcome
from workers.physics.placement import (
    TOUCHING_M,
    Form,
    Placement,
    Support,
    farthest_m,
    find_gaps_m,
    find_overlaps_m,
    forms_of,
    measure_supports,
    place,
    place_on_top,
    placed_mesh,
)
from workers.physics.release import LEFT_M, Drop, Pace, hold, let_go, release
from workers.physics.support import inside_margin, snap_to_face, vertical_gap

UNBALANCED = 1e-3
"""Share of the weight, and of weight times size, that the contacts of what rests may leave unbalanced."""

PLACED_M = 1e-4
"""Height up to which an object was set down and not dropped, where it lands at 44 mm/s, and greatest overlap of objects at
release: correcting centimetres by a share per step gives tens of metres per second."""

STAYED_M = 1e-3
"""Motion from where they were set down up to which objects stayed there: three gaps of `PLACED_M` at the end of a lever."""

MOST_RELEASES = 3
"""Times that objects are released, each from where exact rest gave up the time before."""


class UnsupportedError(SettleError):
    """No balance was found, or none that holds."""


class LeftRoomError(Exception):
    """An object settled as if alone came where it may meet another."""


@dataclass(frozen=True, eq=False)
class _Ending:
    """The objects of a drop at the poses [4, 4] of their rest, after `seconds` in all, with the speed that was left."""

    drop: Drop
    placement: Placement
    poses: tuple[Pose, ...]
    seconds: float = 0.0
    speed_m_s: float = 0.0


def settle(drop: Drop) -> tuple[Settled, ...]:
    """Settle a single object, or several that may touch one another.

    Raises SettleError `objects_overlap`, `not_at_rest`, `left_table`, `unsupported` or `table_too_fine`, and LeftRoomError
    where a single object leaves its room.
    """
    forms = forms_of(drop.starts)
    if not drop.effects.runs("dynamics"):
        poses = tuple(start.T_world_obj for start in drop.starts)
        return _describe(_Ending(drop, _place(drop, poses, forms), poses), "placed", judged=True)
    for i, j, depth_m in find_overlaps_m(forms, [start.T_world_obj for start in drop.starts]):
        if depth_m > PLACED_M:
            raise SettleError(
                "objects_overlap",
                f"regions {drop.starts[i].region_id} and {drop.starts[j].region_id} begin {depth_m * 1e3:.2f} mm inside one "
                "another: let them go apart, or one above the other",
            )
    if drop.physics.exact_rest and (placed := _rest_as_placed(drop, forms)) is not None:
        return _describe(placed, _support_of(placed), judged=True)
    *earlier, last = drop.ways
    for paces in earlier:
        with suppress(UnsupportedError):
            return _settle(drop, forms, paces)
    return _settle(drop, forms, last)


def _settle(drop: Drop, forms: Sequence[Form], paces: Sequence[Pace]) -> tuple[Settled, ...]:
    if not drop.effects.runs("table_mesh"):
        ending = _come_to_rest(drop, forms, paces, flat=True)
        if ending is not None:
            return _describe(ending, _support_of(ending), drop.physics.exact_rest)
        late = called_for_with("table_mesh", drop.starts, drop.physics)
        drop = dataclasses.replace(drop, effects=add_effects(drop.effects, late))
    ending = _come_to_rest(drop, forms, paces, flat=False)
    assert ending is not None  # only the flat top has an edge
    return _describe(ending, _support_of(ending), drop.physics.exact_rest)


def _support_of(ending: _Ending) -> SupportedBy:
    """`flat_top` where the mesh was not called for and every object is over the flat top with all of its points."""
    if ending.drop.effects.runs("table_mesh"):
        return "mesh"
    outline = ending.drop.table.top.outline
    points = [transform(T, one.hull.vertices) for one, T in zip(ending.drop.starts, ending.poses, strict=True)]
    return "flat_top" if inside_margin(np.concatenate(points)[:, :2], outline).min() >= 0.0 else "mesh"


def add_effects(effects: EffectPlan, names: Iterable[str]) -> EffectPlan:
    """The plan with these effects run too."""
    return dataclasses.replace(effects, ran=(*effects.ran, *names))


def _come_to_rest(drop: Drop, forms: Sequence[Form], paces: Sequence[Pace], flat: bool) -> _Ending | None:
    """Release at these paces until at rest; None where a footprint left the flat top, so that the table's edges may matter.

    The simulation may end with objects that rolling friction or a shape's margin holds out of balance. They are followed
    as they tip or slip, and released again where that takes them far.
    """
    seconds, placement = 0.0, None
    for _ in range(MOST_RELEASES):
        outcome = release(drop, flat, paces)
        if outcome.stopped_by == "room":
            raise LeftRoomError
        if outcome.stopped_by == "edge":
            return None
        seconds += outcome.seconds
        _require_calm(drop, outcome)
        exact = drop.physics.exact_rest
        if exact and flat and drop.single and (standing := _stand(drop, outcome, seconds)) is not None:
            return standing
        placement = placement or _place(drop, outcome.poses, forms)
        ending = _Ending(drop, placement, outcome.poses, seconds, outcome.speed_m_s)
        if not exact:
            return ending
        rested = hold(drop, placement, outcome.poses)
        if rested.still:
            return dataclasses.replace(ending, poses=rested.poses)
        starts = (dataclasses.replace(one, T_world_obj=T) for one, T in zip(drop.starts, rested.poses, strict=True))
        drop = dataclasses.replace(drop, starts=tuple(starts))
    raise UnsupportedError(
        "unsupported",
        f"{'it tips or slips' if drop.single else 'something tips or slips'} on without end: released {MOST_RELEASES} times, "
        f"for {seconds:.1f} s in all, it never came into balance: lower physics.rest.speed_mm_s, or raise physics.friction",
    )


def _rest_as_placed(drop: Drop, forms: Sequence[Form]) -> _Ending | None:
    """Objects that begin in touch and in balance, as a stack that was built; None where they have to fall."""
    poses = tuple(start.T_world_obj for start in drop.starts)
    lowest_m = min(transform(T, one.hull.vertices)[:, 2].min() for T, one in zip(poses, drop.starts, strict=True))
    if lowest_m > drop.table.top.height_m + PLACED_M:
        return None
    placement = _place(drop, poses, forms)
    if max(find_gaps_m(placement.forms, [*poses, np.eye(4)])[:-1]) > PLACED_M:
        return None
    rested = rest(placement.things, poses, placement.forms[-1].surface, placement.friction)
    stayed = rested.still and farthest_m(drop.starts, poses, rested.poses) <= STAYED_M
    return _Ending(drop, placement, rested.poses) if stayed else None


def _place(drop: Drop, poses: Sequence[Pose], forms: Sequence[Form]) -> Placement:
    return place(drop.starts, poses, forms, drop.table, drop.physics.friction**2)


def _stand(drop: Drop, outcome: Outcome, seconds: float) -> _Ending | None:
    """A single object turned onto the steady face of its hull that is below it, on the flat top; None where none is near."""
    (start,), table = drop.starts, drop.table
    known = None if drop.physics.collision == "box" else outcome.face  # a box has other faces than the object's hull
    T = snap_to_face(outcome.poses[0], start.hull, start.asset.mass.com, known)
    if T is None:
        return None
    T = translation(0.0, 0.0, -vertical_gap(placed_mesh(start, T), table.mesh)) @ T
    return _Ending(drop, place_on_top(start, T, table, drop.physics.friction**2), (T,), seconds, outcome.speed_m_s)


def _require_calm(drop: Drop, outcome: Outcome) -> None:
    if outcome.rested:
        return
    for start, T in zip(drop.starts, outcome.poses, strict=True):
        if _is_low(drop, _com(start, T)[2]):
            raise _left_table(drop, start, T, outcome.seconds)
    raise SettleError(
        "not_at_rest",
        f"{'still moving' if drop.single else 'something still moves'} at {outcome.speed_m_s * 1e3:.2f} mm/s after "
        f"{outcome.seconds:.1f} s: raise physics.max_settle_s or physics.rolling_friction",
    )


def _is_low(drop: Drop, height_m: float) -> bool:
    return not height_m >= drop.table.top.height_m - LEFT_M  # true of nan


def _com(start: ObjectStart, T: Pose) -> list[float]:
    return list(transform(T, start.asset.mass.com[None])[0].tolist())


def _left_table(drop: Drop, start: ObjectStart, T: Pose, seconds: float) -> SettleError:
    x, y, z = _com(start, T)
    whose, advice = "", "narrow start.offset_m or use larger tables"
    if not drop.single:
        whose = f" of region {start.region_id}"
        advice = "fewer objects_per_scene, a narrower start.offset_m or larger tables"
    return SettleError(
        "left_table",
        f"after {seconds:.2f} s the centre of mass{whose} was at ({x:.3f}, {y:.3f}, {z:.3f}) m, off the table's top: {advice}",
    )


def _describe(ending: _Ending, support: SupportedBy, judged: bool) -> tuple[Settled, ...]:
    """The rest poses with their figures, measured between the true meshes and not taken from the simulator."""
    supports = measure_supports(ending.placement, ending.poses)
    for start, T, held in zip(ending.drop.starts, ending.poses, supports, strict=True):
        # What is this low may hang on the table by a handle, or stand on its foot
        if _is_low(ending.drop, _com(start, T)[2]) and _is_low(ending.drop, held.highest_m):
            raise _left_table(ending.drop, start, T, ending.seconds)
        if judged:
            _require_support(ending.drop, start, held)
    return tuple(
        Settled(
            T_world_obj=frozen_array(T),
            penetration_mm=max(0.0, -held.gap_m) * 1e3,
            hover_gap_mm=max(0.0, held.gap_m) * 1e3,
            support_margin_mm=held.margin_m * 1e3,
            equilibrium_residual=held.unbalanced,
            residual_speed_mm_s=ending.speed_m_s * 1e3,
            settle_s=ending.seconds,
            support=support,
            contacts=held.forces,
        )
        for T, held in zip(ending.poses, supports, strict=True)
    )


def _require_support(drop: Drop, start: ObjectStart, held: Support) -> None:
    """Raises SettleError `unsupported` where an object overlaps another or the table, hovers, or is out of balance."""
    if abs(held.gap_m) <= TOUCHING_M and held.unbalanced <= UNBALANCED:
        return
    where = "inside what it touches" if held.gap_m < 0.0 else "from anything"
    raise UnsupportedError(
        "unsupported",
        f"{'it' if drop.single else f'region {start.region_id}'} came to rest {abs(held.gap_m) * 1e3:.3f} mm {where}, with "
        f"{held.unbalanced:.1%} of its weight out of balance; the bounds are {TOUCHING_M * 1e3:g} mm and {UNBALANCED:.1%}: "
        "lower physics.rest.speed_mm_s",
    )


RECHECK_S = 1.0
"""Simulated time of the second release."""

RECHECK_RATE = 4.0
"""Steps a second of the second release, in the settings', of a single object on level ground: a quarter of the finest. Nothing
slips slowly there. At rest, tilted and lifted, both rates refuse the same (docs/rest.md), this one in 0.31 of the time."""

LEFT_TOP, LEFT_ROOM = "a footprint left the table's flat top", "an object left the room that it had to itself"


@dataclass(frozen=True, eq=False)
class Rest:
    """Every object of a scene at rest, and the reasons why effects that the plan had skipped ran after all."""

    settled: tuple[Settled, ...]
    called: Mapping[str, str] = field(default_factory=dict)


def settle_scene(plan: ScenePlan, physics: Physics, effects: EffectPlan) -> Rest:
    """Drop the scene's objects, wait until they rest, and correct the simulator's gap and tilt of single ones.

    Objects that cannot meet settle one by one. Raises SettleError `objects_overlap`, `not_at_rest`, `left_table`,
    `unsupported` or `table_too_fine`. A pure function: every simulation starts from an empty world.
    """
    starts, table, called = plan.objects, plan.table, dict[str, str]()
    if len(starts) > 1 and effects.runs("object_contacts"):
        settled = settle(Drop(starts, table, physics, effects))
    else:
        try:
            rooms = zip(starts, rooms_m(starts), strict=True)
            settled = tuple(settle(Drop((start,), table, physics, effects, room_m))[0] for start, room_m in rooms)
        except LeftRoomError:
            called = dict.fromkeys(called_for_with("object_contacts", starts, physics), LEFT_ROOM)
            settled = settle(Drop(starts, table, physics, add_effects(effects, called)))
    if any(rest.support == "mesh" for rest in settled):
        called |= dict.fromkeys(called_for_with("table_mesh", starts, physics), LEFT_TOP)
    return Rest(settled, {name: why for name, why in called.items() if not effects.runs(name)})


def recheck_scene(
    plan: ScenePlan, rest: Rest, physics: Physics, effects: EffectPlan, level_rate: float = RECHECK_RATE
) -> Rest:
    """The same rest, with the motion of every object after a second release of all. level_rate: as of `release_again`."""
    effects = add_effects(effects, rest.called)
    poses = release_again(plan, rest.settled, physics, effects, RECHECK_S, level_rate)
    settled = []
    for start, before, after in zip(plan.objects, rest.settled, poses, strict=True):
        moved_mm, turned_deg = moved_by(start, before.T_world_obj, after)
        settled.append(dataclasses.replace(before, recheck_move_mm=moved_mm, recheck_turn_deg=turned_deg))
    return dataclasses.replace(rest, settled=tuple(settled))


def release_again(
    plan: ScenePlan,
    settled: Sequence[Settled],
    physics: Physics,
    effects: EffectPlan,
    seconds: float,
    level_rate: float = FINEST,
) -> tuple[Pose, ...]:
    """`T_world_obj` [4, 4] of every object this long after its release from where it rests, or once one moved by `hold.FAR_M`.

    With the effects of the plan, without correction. Nothing counts as resting before the end. In the finest steps, and a single
    object on level ground in `level_rate` times as many a second as the settings say.
    """
    rest = physics.rest.model_copy(update={"window_s": 2.0 * seconds})
    physics = physics.model_copy(update={"max_settle_s": seconds, "rest": rest})
    starts, poses = plan.objects, [each.T_world_obj for each in settled]
    placement = place(starts, poses, forms_of(starts), plan.table, physics.friction**2)
    return let_go(Drop(starts, plan.table, physics, effects), placement, poses, level_rate=level_rate)


def moved_by(start: ObjectStart, before: Pose, after: Pose) -> tuple[float, float]:
    """(mm that the farthest point of an object moves between two poses, degrees that it turns)."""
    moved_m, turned_rad = motion_between(start.hull.vertices, before, after)
    return moved_m * 1e3, math.degrees(turned_rad)
