"""How a drop ends: what is measured of objects at rest, and why those are refused that do not rest."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.errors import SettleError
from schemas.job.assets import TABLE
from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart, Settled, SupportedBy
from workers.geometry.frames import transform
from workers.physics.fall import Outcome
from workers.physics.placement import (
    FARTHEST_M,
    TOUCHING_M,
    Placement,
    Support,
    find_overlaps_m,
    measure_supports,
    placed_mesh,
)
from workers.physics.pour import LostError, moved_to, points_of
from workers.physics.release import LEFT_M, Drop
from workers.physics.support import inside_margin, vertical_gap

UNBALANCED = 1e-3
"""Share of the weight, and of weight times size, that the contacts of what rests may leave unbalanced."""

SPINS_M = 1e-3
"""Radius inside of which what turns spins in place, and does not roll."""


class UnsupportedError(LostError):
    """No balance was found, or none that holds, for these objects."""


@dataclass(frozen=True, eq=False)
class Ending:
    """The objects of a drop at the poses [4, 4] of their rest, after `seconds` in all, with the speed that was left.

    spun: whether some spun on at the end.
    """

    drop: Drop
    placement: Placement
    poses: tuple[Pose, ...]
    seconds: float = 0.0
    speed_m_s: float = 0.0
    spun: bool = False


def require_calm(drop: Drop, outcome: Outcome, fallen: Sequence[int], moving: bool) -> None:
    """Raises SettleError where objects were lost or still move, which they may where they are `moving`.

    fallen: the numbers of those that were let go.
    """
    if outcome.thrown:
        raise UnsupportedError(
            "thrown",
            f"an object flew off at {outcome.thrown_m_s:.0f} m/s, which no fall gives: raise physics.step_hz, or take objects "
            "of nearer masses",
            sorted(outcome.thrown.union(outcome.lost)),
            outcome.poses,
            fallen,
        )
    if outcome.rested and not outcome.lost:
        return
    coms = [_com(start, T) for start, T in zip(drop.starts, outcome.poses, strict=True)]
    if lost := outcome.lost or [number for number in fallen if _is_low(drop, coms[number][2])]:
        raise _left_table(drop, lost, outcome.poses, outcome.seconds, fallen, put_away=bool(outcome.lost))
    if not moving:
        raise SettleError("not_at_rest", _what_moves(drop.physics, drop.starts[fallen[outcome.moves[0]]], outcome))


def _what_moves(physics: Physics, start: ObjectStart, outcome: Outcome) -> str:
    _, speed_m_s, spin_rad_s = outcome.moves
    advice, reach_m = (
        "physics.max_settle_s or physics.rolling_friction",
        float(np.ptp(start.hull.vertices, axis=0).max()),
    )
    if physics.restitution > 0.0 and speed_m_s > spin_rad_s * reach_m:  # faster than it rolls
        advice = f"physics.max_settle_s, or lower physics.restitution, which is {physics.restitution:g}"
    elif slippery := [name for name in (start.asset.category, TABLE) if physics.friction_of(name) == 0.0]:
        advice = f"physics.friction, which is 0 of the {slippery[0]}"
    elif physics.spinning_friction == 0.0 and speed_m_s < spin_rad_s * SPINS_M:
        advice = "physics.spinning_friction, which is 0"
    return (
        f"region {start.region_id} ({start.asset.category}) still drifts at {speed_m_s * 1e3:.4g} mm/s and turns at "
        f"{spin_rad_s:.3g} rad/s after {outcome.seconds:.1f} s: raise {advice}"
    )


def _is_low(drop: Drop, height_m: float) -> bool:
    return not height_m >= drop.table.top.height_m - LEFT_M  # true of nan


def _com(start: ObjectStart, T: Pose) -> list[float]:
    return list(transform(T, start.asset.mass.com[None])[0].tolist())


def _left_table(
    drop: Drop,
    lost: Sequence[int],
    poses: Sequence[Pose],
    seconds: float,
    fallen: Iterable[int],
    put_away: bool = False,
) -> LostError:
    """put_away: the pose of the first of `lost` is where it was put, and not where it left."""
    start = drop.starts[lost[0]]
    x, y, z = _com(start, poses[lost[0]])
    whose, advice = "", "narrow start.offset_m or use larger tables"
    if not drop.single:
        whose = f" of region {start.region_id}"
        advice = "fewer objects_per_scene, a narrower start.offset_m or larger tables"
    at = "had left" if put_away else f"was at ({x:.3f}, {y:.3f}, {z:.3f}) m, off"
    message = f"after {seconds:.2f} s the centre of mass{whose} {at} the table's top"
    return LostError("left_table", f"{message}: {advice}", lost, poses, fallen)


def describe(ending: Ending) -> tuple[Settled, ...]:
    """The rest poses with their figures, measured between the true meshes and not taken from the simulator."""
    drop, supports = ending.drop, measure_supports(ending.placement, ending.poses)
    coms = [_com(start, T) for start, T in zip(drop.starts, ending.poses, strict=True)]
    # What is this low may hang on the table by a handle, or stand on its foot
    low = [n for n, held in enumerate(supports) if _is_low(drop, coms[n][2]) and _is_low(drop, held.highest_m)]
    if low:
        raise _left_table(drop, low, ending.poses, ending.seconds, range(len(supports)))
    if drop.physics.exact_rest or not drop.effects.runs("dynamics"):
        for number, held in enumerate(supports):
            _require_support(ending, number, held)
    support = _support_of(ending)
    return tuple(_settled(ending, T, held, support) for T, held in zip(ending.poses, supports, strict=True))


def _settled(ending: Ending, T_world_obj: Pose, held: Support, support: SupportedBy) -> Settled:
    return Settled(
        T_world_obj=frozen_array(T_world_obj),
        penetration_mm=max(0.0, -held.gap_m) * 1e3,
        hover_gap_mm=max(0.0, held.gap_m) * 1e3,
        support_margin_mm=held.margin_m * 1e3,
        equilibrium_residual=held.unbalanced,
        residual_speed_mm_s=ending.speed_m_s * 1e3,
        settle_s=ending.seconds,
        support=support,
        contacts=held.forces,
        spun=ending.spun,
    )


def describe_kept(ending: Ending, most_mm: float) -> tuple[Settled, ...]:
    """The figures of objects at poses that nothing led to.

    What touches nothing hovers by the way straight down to what is below it. What is no body, and near no surface, counts as its
    hull in the table. Raises SettleError where one is deeper in another, in the table or in the floor than `most_mm`.
    """
    starts, poses, forms = ending.drop.starts, (*ending.poses, np.eye(4)), ending.placement.forms
    meshes = [*(placed_mesh(start, T) for start, T in zip(starts, poses, strict=False)), ending.drop.table.mesh]
    names = [f"region {start.region_id} ({start.asset.instance_id})" for start in starts] + ["the table", "the floor"]
    overlaps, kept, table = list(find_overlaps_m(forms, poses)), list[Settled](), len(starts)
    for number, held in enumerate(measure_supports(ending.placement, ending.poses)):
        within = {i + j - number: depth_m for i, j, depth_m in overlaps if number in (i, j) and depth_m > 0.0}
        sunk_m = within.get(table, 0.0) if held.gap_m >= FARTHEST_M and forms[table].solid is not None else 0.0
        lowest_m = float(meshes[number].vertices[:, 2].min())
        gap_m = min(-sunk_m if sunk_m else held.gap_m, lowest_m)
        within[table + 1] = -lowest_m
        if gap_m > TOUCHING_M:
            below = [vertical_gap(meshes[number], mesh) for n, mesh in enumerate(meshes) if n != number]
            gap_m = min(lowest_m, *(way for way in below if way > 0.0), math.inf)
        if gap_m < -most_mm / 1e3:
            where = f"{names[number]} is {-gap_m * 1e3:.2f} mm inside {names[max(within, key=within.__getitem__)]}"
            raise SettleError("overlap", f"{where}, and check.overlap_mm is {most_mm:g}: move it, or raise that")
        kept.append(_settled(ending, ending.poses[number], replace(held, gap_m=gap_m), "kept"))
    return tuple(kept)


def _support_of(ending: Ending) -> SupportedBy:
    """`flat_top` where the mesh was not called for and every object is over the flat top with all of its points."""
    drop = ending.drop
    if not drop.effects.runs("dynamics"):
        return "placed"
    if drop.effects.runs("table_mesh"):
        return "mesh"
    points = np.concatenate([points_of(start) for start in moved_to(drop.starts, ending.poses)])
    return "flat_top" if inside_margin(points[:, :2], drop.table.top.outline).min() >= 0.0 else "mesh"


def _require_support(ending: Ending, number: int, held: Support) -> None:
    """Raises UnsupportedError where an object overlaps another or the table, hovers, or is out of balance."""
    if abs(held.gap_m) <= TOUCHING_M and held.unbalanced <= UNBALANCED:
        return
    drop, where = ending.drop, "inside what it touches" if held.gap_m < 0.0 else "from anything"
    raise UnsupportedError(
        "unsupported",
        f"{'it' if drop.single else f'region {drop.starts[number].region_id}'} came to rest {abs(held.gap_m) * 1e3:.3f} mm "
        f"{where}, with {held.unbalanced:.1%} of its weight out of balance; the bounds are {TOUCHING_M * 1e3:g} mm and "
        f"{UNBALANCED:.1%}: lower physics.rest.speed_mm_s",
        [number],
        ending.poses,
        range(len(drop.starts)),
    )
