"""Objects from release to rest: simulated until calm, brought to exact rest, measured, and refused where they do not rest."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from schemas.base import Pose, frozen_array
from schemas.errors import SettleError
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart
from schemas.scene.scene import Settled, SupportedBy
from workers.geometry.elevation import vertical_gap
from workers.geometry.frames import transform, translation
from workers.physics.effects import called_for_with
from workers.physics.fall import Outcome
from workers.physics.placement import TOUCHING_M, Placement, measure_supports, place, place_on_top, placed_mesh
from workers.physics.release import Drop, release
from workers.physics.rest.rest import rest
from workers.physics.rest_pose import snap_to_face
from workers.physics.separation import Form, find_overlaps_m

LEFT_M = 0.05
"""Depth of a centre of mass below the table's top at which the object has left the table."""

UNBALANCED = 0.01
"""Share of the weight, and of weight times size, that the contacts of what rests may leave unbalanced."""

MOST_OVERLAP_M = 1e-4
"""Greatest overlap of objects at release. Correcting centimetres by a share per step gives tens of metres per second."""

MOST_RELEASES = 4
"""Times that objects are released, each from where exact rest gave up the time before."""


class LeftRoomError(Exception):
    """An object settled as if alone came where it may meet another."""


@dataclass(frozen=True, eq=False)
class _Ending:
    """Objects at the poses [4, 4] of their rest, after `seconds` in all, with the speed that the simulation left them."""

    placement: Placement
    poses: tuple[Pose, ...]
    seconds: float = 0.0
    speed_m_s: float = 0.0


def settle(drop: Drop) -> tuple[Settled, ...]:
    """Settle a single object, or several that may touch one another.

    Raises SettleError `objects_overlap`, `not_at_rest`, `left_table`, `unsupported` or `table_too_fine`, and LeftRoomError
    where a single object leaves its room.
    """
    if not drop.effects.runs("dynamics"):
        poses = tuple(start.T_world_obj for start in drop.starts)
        return _judged(_Ending(_place(drop, poses), poses), "placed", judged=True)
    _require_apart(drop.starts)
    if not drop.effects.runs("table_mesh"):
        ending = _come_to_rest(drop, flat=True)
        if ending is not None:
            return _judged(ending, "flat_top", drop.physics.exact_rest)
        late = called_for_with("table_mesh", drop.starts, drop.physics)
        drop = dataclasses.replace(drop, effects=add_effects(drop.effects, late))
    ending = _come_to_rest(drop, flat=False)
    assert ending is not None  # only the flat top has an edge
    return _judged(ending, "mesh", drop.physics.exact_rest)


def add_effects(effects: EffectPlan, names: Iterable[str]) -> EffectPlan:
    """The plan with these effects run too."""
    return dataclasses.replace(effects, ran=(*effects.ran, *names))


def _require_apart(starts: Sequence[ObjectStart]) -> None:
    forms = [Form(start.asset.shape) for start in starts]
    for i, j, depth_m in find_overlaps_m(forms, [start.T_world_obj for start in starts]):
        if depth_m > MOST_OVERLAP_M:
            raise SettleError(
                "objects_overlap",
                f"regions {starts[i].region_id} and {starts[j].region_id} begin {depth_m * 1e3:.2f} mm inside one another: let "
                "them go apart, or one above the other",
            )


def _come_to_rest(drop: Drop, flat: bool) -> _Ending | None:
    """Release until at rest; None where a footprint left the flat top, so that the table's edges may matter.

    The simulation may end with objects that rolling friction or a shape's margin holds out of balance. They are followed
    as they tip, and released again where that takes them far.
    """
    seconds, placement = 0.0, None
    for _ in range(MOST_RELEASES):
        outcome = release(drop, flat)
        if outcome.stopped_by == "room":
            raise LeftRoomError
        if outcome.stopped_by == "edge":
            return None
        seconds += outcome.seconds
        _require_calm(drop, outcome)
        if not drop.physics.exact_rest:
            return _Ending(_place(drop, outcome.poses), outcome.poses, seconds, outcome.speed_m_s)
        if flat and drop.single and (standing := _stand(drop, outcome.poses[0])) is not None:
            return dataclasses.replace(standing, seconds=seconds, speed_m_s=outcome.speed_m_s)
        placement = placement or _place(drop, outcome.poses)
        rested = rest(placement.things, outcome.poses, placement.forms[-1].surface, placement.friction)
        if rested.still:
            return _Ending(placement, rested.poses, seconds, outcome.speed_m_s)
        starts = (dataclasses.replace(one, T_world_obj=T) for one, T in zip(drop.starts, rested.poses, strict=True))
        drop = dataclasses.replace(drop, starts=tuple(starts))
    raise SettleError(
        "not_at_rest",
        f"{_what(drop)} tips on without end: it was released {MOST_RELEASES} times, for {seconds:.1f} s in all, and "
        "never came into balance: lower physics.rest.speed_mm_s",
    )


def _what(drop: Drop) -> str:
    return "it" if drop.single else "something"


def _place(drop: Drop, poses: Sequence[Pose]) -> Placement:
    return place(drop.starts, poses, drop.ground.table, drop.physics.friction**2)


def _stand(drop: Drop, T_world_obj: Pose) -> _Ending | None:
    """A single object turned onto the steady face of its hull that is below it, on the flat top; None where none is near."""
    start = drop.starts[0]
    T = snap_to_face(T_world_obj, start.hull, start.asset.mass.com)
    if T is None:
        return None
    T = translation(0.0, 0.0, -vertical_gap(placed_mesh(start, T), drop.ground.terrain)) @ T
    return _Ending(place_on_top(start, T, drop.ground.table, drop.physics.friction**2), (T,))


def _require_calm(drop: Drop, outcome: Outcome) -> None:
    lowest_m = drop.ground.table.top.height_m - LEFT_M
    for start, T in zip(drop.starts, outcome.poses, strict=True):
        com = transform(T, start.asset.mass.com[None, :])[0]
        if com[2] >= lowest_m:
            continue
        whose, advice = "", "narrow start.offset_m or use larger tables"
        if not drop.single:
            whose = f" of region {start.region_id}"
            advice = "fewer objects_per_scene, a narrower start.offset_m or larger tables"
        raise SettleError(
            "left_table",
            f"after {outcome.seconds:.2f} s the centre of mass{whose} was at ({com[0]:.3f}, {com[1]:.3f}, {com[2]:.3f}) "
            f"m, off the table's top: {advice}",
        )
    if not outcome.rested:
        raise SettleError(
            "not_at_rest",
            f"{'still moving' if drop.single else 'something still moves'} at {outcome.speed_m_s * 1e3:.2f} mm/s after "
            f"{outcome.seconds:.1f} s: raise physics.max_settle_s or physics.rolling_friction",
        )


def _judged(ending: _Ending, support: SupportedBy, judged: bool) -> tuple[Settled, ...]:
    """The rest poses with their figures, measured between the true meshes and not taken from the simulator.

    Raises SettleError `unsupported` where an object overlaps, hovers or is out of balance, and `judged`.
    """
    settled, starts = [], ending.placement.starts
    for start, T, held in zip(starts, ending.poses, measure_supports(ending.placement, ending.poses), strict=True):
        if judged and (abs(held.gap_m) > TOUCHING_M or not held.unbalanced <= UNBALANCED):
            side = "inside what it touches" if held.gap_m < 0.0 else "from anything"
            raise SettleError(
                "unsupported",
                f"{'it' if len(starts) == 1 else f'region {start.region_id}'} came to rest {abs(held.gap_m) * 1e3:.3f} mm "
                f"{side}, with {held.unbalanced:.1%} of its weight out of balance; the bounds are {TOUCHING_M * 1e3:g} mm and "
                f"{UNBALANCED:.0%}: lower physics.rest.speed_mm_s",
            )
        settled.append(
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
        )
    return tuple(settled)
