"""Objects from release to rest: simulate, require rest, correct a single object, and measure the rest pose."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from schemas.base import Array, Pose, frozen_array
from schemas.errors import SettleError
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart
from schemas.scene.scene import Settled, SupportedBy
from workers.geometry.elevation import sample_elevation
from workers.geometry.frames import transform
from workers.physics.effects import called_for_with
from workers.physics.fall import Outcome
from workers.physics.placement import Support, gap_m, measure_supports, placed_mesh, touch_down
from workers.physics.release import Drop, release
from workers.physics.rest_pose import find_contacts_xy, snap_to_face, support_margin, tip_onto_face
from workers.physics.separation import clearances, find_gaps_m

LEFT_M = 0.05
"""Depth of a centre of mass below the table's top at which the object has left the table."""

LESS_ROLLING_FRICTION = (1.0, 0.1, 0.01, 0.0)
"""Shares of the rolling friction in successive releases, each where the one before left the object on an edge."""

DAMPING = 0.9
"""Damping of releases with less rolling friction: nine tenths of the speed per second. Nothing else removes the little energy
that Bullet adds at each edge of a bottle on its side."""

UNBALANCED = 0.05
"""Share of the weight, and of weight times size, that contacts may leave unbalanced, as they are known to `CONTACT_M`."""

BALANCED = 1e-3
"""The same share as noise: two tenths of a millimetre between a centre of mass and the contacts."""

MOST_OVERLAP_M = 1e-4
"""Greatest overlap of objects at release. Correcting centimetres by a share per step gives tens of metres per second."""


class LeftRoomError(Exception):
    """An object settled as if alone came where it may meet another."""


@dataclass(frozen=True, eq=False)
class _Ending:
    """The outcome of a drop after `seconds` in all, with properties of a single object set down until it touches."""

    drop: Drop
    outcome: Outcome
    seconds: float

    @cached_property
    def T_touching(self) -> Pose:
        return touch_down(self.drop.starts[0], self.outcome.poses[0], self.drop.ground)

    @cached_property
    def support(self) -> Support:
        return self.supports_at((self.T_touching,))[0]

    def supports_at(self, poses: Sequence[Pose]) -> tuple[Support, ...]:
        """The support of every object at these poses, between meshes."""
        drop = self.drop
        return measure_supports(drop.starts, poses, drop.ground.table.mesh, drop.physics.friction**2)


def settle(drop: Drop) -> tuple[Settled, ...]:
    """Settle a single object, or several that may touch one another.

    Raises SettleError `objects_overlap`, `not_at_rest`, `left_table`, `unsupported` or `table_too_fine`, and LeftRoomError
    where a single object leaves its room. Several objects are not corrected: their figures are the simulation's.
    """
    if not drop.effects.runs("dynamics"):
        placed = Outcome(tuple(start.T_world_obj for start in drop.starts), 0.0, 0.0, rested=True)
        return _describe(_Ending(drop, placed, 0.0), "placed")
    _require_apart(drop.starts)
    if not drop.effects.runs("table_mesh"):
        ending = _come_to_rest(drop, flat=True)
        if ending is not None:
            return _describe(ending, "flat_top")
        late = called_for_with("table_mesh", drop.starts, drop.physics)
        drop = dataclasses.replace(drop, effects=add_effects(drop.effects, late))
    ending = _come_to_rest(drop, flat=False)
    assert ending is not None  # only the flat top has an edge
    return _describe(ending, "mesh")


def add_effects(effects: EffectPlan, names: Iterable[str]) -> EffectPlan:
    """The plan with these effects run too."""
    return dataclasses.replace(effects, ran=(*effects.ran, *names))


def _require_apart(starts: Sequence[ObjectStart]) -> None:
    for i, j, gap in find_gaps_m([placed_mesh(start, start.T_world_obj) for start in starts], near_m=0.0):
        if -gap > MOST_OVERLAP_M:
            raise SettleError(
                "objects_overlap",
                f"regions {starts[i].region_id} and {starts[j].region_id} begin {-gap * 1e3:.2f} mm inside one another: let "
                "them go apart, or one above the other",
            )


def _come_to_rest(drop: Drop, flat: bool) -> _Ending | None:
    """Release until at rest; None where a footprint left the flat top, so that the table's edges may matter.

    Rolling friction can hold a single object out of balance, within its lever arm of an edge of the hull or of the contacts
    (half a millimetre by default), where in truth it tips on. It is released again with less rolling friction.
    """
    seconds, ending, physics = 0.0, None, drop.physics
    repeated = drop.single and drop.effects.runs("rolling_friction")
    for share in LESS_ROLLING_FRICTION if repeated else LESS_ROLLING_FRICTION[:1]:
        less = physics.model_copy(update={"rolling_friction": share * physics.rolling_friction})
        damping = 0.0 if share == 1.0 else DAMPING
        outcome = release(dataclasses.replace(drop, physics=less), flat, damping)
        if outcome.stopped_by == "room":
            raise LeftRoomError
        if outcome.stopped_by == "edge":
            return None
        seconds += outcome.seconds
        ending = _Ending(drop, outcome, seconds)
        _require_rest(ending)
        ending, balanced = _balance(ending, flat)
        if balanced:
            break
        again = dataclasses.replace(drop.starts[0], T_world_obj=ending.outcome.poses[0])
        drop = dataclasses.replace(drop, starts=(again,))
    return ending


def _balance(ending: _Ending, flat: bool) -> tuple[_Ending, bool]:
    """(the ending with a single object on the flat top turned onto its face, whether no further release is needed).

    An object on the flat top without a face below its centre of mass is tipped on by geometry: Bullet adds speed to thin
    rods released on an edge. Where the next face is far, it is released again.
    """
    drop, outcome = ending.drop, ending.outcome
    if drop.single and not flat:
        return ending, ending.support.residual <= BALANCED
    if not drop.single or not drop.physics.correction:
        return ending, True
    hull, com = drop.starts[0].hull, drop.starts[0].asset.mass.com
    T = snap_to_face(outcome.poses[0], hull, com, drop.physics.snap_rad)
    tipped = tip_onto_face(T, hull, com)
    corrected = dataclasses.replace(outcome, poses=(T if tipped is None else tipped,))
    return dataclasses.replace(ending, outcome=corrected), tipped is not None


def _require_rest(ending: _Ending) -> None:
    drop, outcome = ending.drop, ending.outcome
    for start, T in zip(drop.starts, outcome.poses, strict=True):
        com = transform(T, start.asset.mass.com[None, :])[0]
        if not _is_on_table(ending, com):
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


def _is_on_table(ending: _Ending, com: Array) -> bool:
    """Whether a centre of mass [3] is not below the top; of a single object also over it, unless the top holds it anyway.

    As it does over a hole, or where the object hangs on an edge.
    """
    drop, ground = ending.drop, ending.drop.ground
    lowest_m = ground.table.top.height_m - LEFT_M
    high = bool(com[2] >= lowest_m)
    # nan compares false
    if not drop.single or (high and sample_elevation(com[None, :2], ground.terrain)[0] >= lowest_m):
        return high
    return ending.outcome.rested and ending.support.residual <= UNBALANCED and ending.support.highest_m >= lowest_m


def _describe(ending: _Ending, support: SupportedBy) -> tuple[Settled, ...]:
    """The rest poses with their figures, measured between the meshes and not taken from the simulator."""
    measured = [_measure_single(ending, support)] if ending.drop.single else _measure_group(ending)
    return tuple(
        Settled(
            T_world_obj=frozen_array(T),
            penetration_mm=max(0.0, -gap) * 1e3,
            hover_gap_mm=max(0.0, gap) * 1e3,
            support_margin_mm=margin * 1e3,
            equilibrium_residual=residual,
            residual_speed_mm_s=ending.outcome.speed_m_s * 1e3,
            settle_s=ending.seconds,
            support=support,
        )
        for T, gap, margin, residual in measured
    )


def _measure_group(ending: _Ending) -> list[tuple[Pose, float, float, float]]:
    """(pose, gap in metres, margin of support in metres, equilibrium residual) of every object."""
    drop, poses = ending.drop, ending.outcome.poses
    gaps_m = clearances([placed_mesh(*one) for one in zip(drop.starts, poses, strict=True)], drop.ground.terrain)
    supports = ending.supports_at(poses)
    return [(T, gap, each.margin_m, each.residual) for T, gap, each in zip(poses, gaps_m, supports, strict=True)]


def _measure_single(ending: _Ending, support: SupportedBy) -> tuple[Pose, float, float, float]:
    """The same figures of a single object. Raises SettleError `unsupported`."""
    (start,), ground = ending.drop.starts, ending.drop.ground
    corrected = support != "placed" and ending.drop.physics.correction
    T = ending.T_touching if corrected else ending.outcome.poses[0]
    if support == "mesh":
        held = ending.support if corrected else ending.supports_at((T,))[0]
        margin_m, residual = held.margin_m, held.residual
    else:
        com = transform(T, start.asset.mass.com[None, :])[0]
        margin_m, residual = support_margin(find_contacts_xy(start.hull, T, ground.terrain), com[:2]), 0.0
    # Uncorrected, an object on a face may touch with one corner only, which shows nothing.
    judged = support != "flat_top" or corrected
    if judged and (residual > UNBALANCED or (support != "mesh" and not margin_m > 0.0)):
        raise SettleError(
            "unsupported",
            f"it came to rest with its centre of mass {-margin_m * 1e3:.2f} mm outside the hull of its contacts, which leave "
            f"{residual:.0%} of its weight without balance: raise physics.snap_rad or lower physics.rest.speed_mm_s",
        )
    return T, gap_m(start, T, ground), margin_m, residual
