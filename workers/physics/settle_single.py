"""One object from release to rest: when it rests, and what is made of the pose that the simulator stopped at."""

import dataclasses
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from schemas.base import Pose, frozen_array
from schemas.errors import SettleError
from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart, Settled, SupportedBy, Table
from workers.geometry.elevation import sample_elevation
from workers.geometry.frames import transform
from workers.physics.effects import called_for, on_mesh
from workers.physics.fall import FINEST, Fall, Faller, choose_pace, fall, faller_of, free_fall_m, shaped
from workers.physics.placement import LEFT_M, Ground, gap_m, ground_of, support_of, touch_down
from workers.physics.rest_pose import snap_to_face, support_margin, tip_onto_face, touching
from workers.physics.stop_conditions import (
    Watch,
    can_touch,
    stands_on_face,
    watch_edge,
    watch_gone,
    watch_room,
    watch_tilt,
)

LESS_ROLLING_FRICTION = (1.0, 0.1, 0.01, 0.0)
"""Shares of the rolling friction that an object is dropped with, each where the one before left it on an edge."""

DAMPING = 0.9
"""Of what is let go again with less rolling friction: it loses nine tenths of its speed in a second."""

UNBALANCED = 0.05
"""Share of its weight, and of weight times size, that contacts may fail to balance: what their positions, known to
`CONTACT_M`, leave open."""


BALANCED = 1e-3
"""The same share where what is left is noise: two tenths of a millimetre between a centre of mass and the contacts."""


class LeftRoomError(Exception):
    """An object came where it may meet another."""


@dataclass(frozen=True, eq=False)
class _Task:
    """One object to be dropped: where it starts, on what, and with which effects."""

    start: ObjectStart
    ground: Ground
    physics: Physics
    ran: Collection[str]
    room_m: float = math.inf
    damping: float = 0.0


def settle_alone(
    start: ObjectStart,
    table: Table,
    physics: Physics,
    ran: Collection[str] | None = None,
    room_m: float = math.inf,
) -> Settled:
    """One object on its own, with the effects that are named, or else those that it calls for. Raises SettleError.

    Its centre of mass may go `room_m` sideways.
    """
    ran = called_for((start,), table, physics) if ran is None else ran
    task = _Task(start, ground_of(table), physics, ran, room_m)
    if "dynamics" not in ran:
        return _describe(task, Fall((start.T_world_obj,), 0.0, 0.0, True), "placed")
    if "table_mesh" not in ran:
        motion = _settle_flat(task)
        if motion is not None:
            return _describe(task, motion, "flat_top")
        task = dataclasses.replace(task, ran=(*ran, *on_mesh((start,), physics)))
    return _describe(task, _settle_on_mesh(task), "mesh")


def _settle_flat(task: _Task) -> Fall | None:
    """Rest on the flat top alone; None where the footprint left it, so that the table's edges may have mattered.

    Rolling friction can hold an object within that lever arm of an edge of its hull, where in truth it would tip on.
    Such a pose has no face below the centre of mass. It is tipped on by geometry, because thin rods that are let go on
    an edge gain speed in Bullet; where the next face is far, it is let go once more with less rolling friction. Then it is
    damped, because what little Bullet adds in energy at each edge of a bottle on its side, nothing else takes away.
    """
    seconds, physics, asset = 0.0, task.physics, task.start.asset
    for less, damping in _less_and_less(task):
        motion = _simulate(dataclasses.replace(task, physics=less, damping=damping), physics.max_settle_s, flat=True)
        if motion.happened is not None:
            return None
        _require_rest(task, motion)
        seconds += motion.seconds
        if not physics.correction:
            return dataclasses.replace(motion, seconds=seconds)
        stopped = motion.poses[0]
        T = snap_to_face(stopped, task.start.hull, asset.mass.com, physics.snap_rad)
        tipped = tip_onto_face(T, task.start.hull, asset.mass.com)
        motion = Fall((T if tipped is None else tipped,), motion.speed_m_s, seconds, True)
        if tipped is not None:
            break
        task = dataclasses.replace(task, start=dataclasses.replace(task.start, T_world_obj=T))
    return motion


def _less_and_less(task: _Task) -> Iterator[tuple[Physics, float]]:
    """The physics, and damping, of each time that an object is let go: at first as asked, then with less rolling friction."""
    physics = task.physics
    for share in LESS_ROLLING_FRICTION if "rolling_friction" in task.ran else LESS_ROLLING_FRICTION[:1]:
        less = physics.model_copy(update={"rolling_friction": share * physics.rolling_friction})
        yield less, 0.0 if share == 1.0 else DAMPING


def _settle_on_mesh(task: _Task) -> Fall:
    """Rest on the table's mesh; what rolling friction held out of balance is let go once more with less of it.

    It holds a centre of mass that is within its lever arm beyond the contacts, half a millimetre with the defaults, where an
    object would in truth tip on.
    """
    seconds, physics = 0.0, task.physics
    for less, damping in _less_and_less(task):
        motion = _simulate(dataclasses.replace(task, physics=less, damping=damping), physics.max_settle_s, flat=False)
        _require_rest(task, motion)
        seconds += motion.seconds
        motion = dataclasses.replace(motion, seconds=seconds)
        T = touch_down(task.start, motion.poses[0], task.ground)
        if support_of(task.start, T, task.ground, physics.friction**2).residual <= BALANCED:
            break
        task = dataclasses.replace(task, start=dataclasses.replace(task.start, T_world_obj=motion.poses[0]))
    return motion


def watching(physics: Physics, seconds: float) -> Physics:
    """The same physics in the finest steps, in which nothing counts as resting before the time is over."""
    rest = physics.rest.model_copy(update={"window_s": 2.0 * seconds})
    return physics.model_copy(update={"step_hz": FINEST * physics.step_hz, "max_settle_s": seconds, "rest": rest})


def let_go(
    start: ObjectStart, rest: Settled, table: Table, physics: Physics, ran: Collection[str], seconds: float
) -> Pose:
    """Where the object is, `T_world_obj` [4, 4], so long after it was released where it rests, in the finest steps."""
    again = dataclasses.replace(start, T_world_obj=rest.T_world_obj, placed=False)
    task = _Task(again, ground_of(table), watching(physics, seconds), ran)
    return _simulate(task, seconds, rest.support != "mesh" and "table_mesh" not in ran).poses[0]


def _require_rest(task: _Task, motion: Fall) -> None:
    table, start = task.ground.table, task.start
    com = transform(motion.poses[0], start.asset.mass.com[None, :])[0]
    over_top = (
        sample_elevation(com[None, :2], task.ground.terrain)[0] >= table.top.height_m - LEFT_M
    )  # nan compares false
    high = com[2] >= table.top.height_m - LEFT_M
    if not (over_top and high) and not (motion.rested and _is_held(task, motion)):
        raise SettleError(
            "left_table",
            f"after {motion.seconds:.2f} s the centre of mass was at ({com[0]:.3f}, {com[1]:.3f}, {com[2]:.3f}) m, off the "
            "table's top: narrow start.offset_m or use larger tables",
        )
    if not motion.rested:
        raise SettleError(
            "not_at_rest",
            f"still moving at {motion.speed_m_s * 1e3:.2f} mm/s after {motion.seconds:.1f} s: raise physics.max_settle_s "
            "or physics.rolling_friction",
        )


def _is_held(task: _Task, motion: Fall) -> bool:
    """Whether the top holds it though its centre of mass is not over the top: over a hole, or hung on an edge."""
    T = touch_down(task.start, motion.poses[0], task.ground)
    support = support_of(task.start, T, task.ground, task.physics.friction**2)
    return support.residual <= UNBALANCED and support.highest_m >= task.ground.table.top.height_m - LEFT_M


def _describe(task: _Task, motion: Fall, support: SupportedBy) -> Settled:
    """The figures of a rest pose, measured between the meshes and not taken from the simulator."""
    start = task.start
    corrected = support != "placed" and task.physics.correction
    T = touch_down(start, motion.poses[0], task.ground) if corrected else motion.poses[0]
    gap_mm = gap_m(start, T, task.ground) * 1e3
    com = transform(T, start.asset.mass.com[None, :])[0]
    margin, residual = support_margin(touching(start.hull, T, task.ground.terrain), com[:2]), 0.0
    if support == "mesh":
        held = support_of(start, T, task.ground, task.physics.friction**2)
        margin, residual = held.margin_m, held.residual
    # Uncorrected, what stands on a face may touch with one of its corners, which tells nothing.
    judged = support != "flat_top" or corrected
    if judged and (residual > UNBALANCED or (support != "mesh" and not margin > 0.0)):
        raise SettleError(
            "unsupported",
            f"it came to rest with its centre of mass {-margin * 1e3:.2f} mm outside the hull of its contacts, which leave "
            f"{residual:.0%} of its weight without balance: raise physics.snap_rad or lower physics.rest.speed_mm_s",
        )
    return Settled(
        T_world_obj=frozen_array(T),
        penetration_mm=max(0.0, -gap_mm),
        hover_gap_mm=max(0.0, gap_mm),
        support_margin_mm=margin * 1e3,
        equilibrium_residual=residual,
        residual_speed_mm_s=motion.speed_m_s * 1e3,
        settle_s=motion.seconds,
        support=support,
    )


def _simulate(task: _Task, seconds: float, flat: bool) -> Fall:
    """Drop the object onto the flat top or the mesh; a watch happens where its footprint leaves the flat top.

    What stands on a level plane touches it with few of its vertices as long as it does not tip, and Bullet's time goes
    with their number. So it falls with these alone, and falls again with all of them should it tip. Where `decomposition`
    runs it falls as its convex parts, else as its hull.
    """
    start, table = shaped(task.start, task.physics), task.ground.table
    faller = faller_of(start, task.physics, task.ran, task.damping)
    free = free_fall_m(transform(start.T_world_obj, start.hull.vertices), table, flat)
    pace = choose_pace((start,), task.physics, task.ran, free if flat else 0.0)
    ground = table.top.height_m if flat else table.mesh
    T_world_body = start.T_world_obj @ faller.T_obj_body
    gone = watch_gone(float(table.mesh.vertices[:, 2].min()) - faller.reach_m)
    leaves = watch_edge(table.top.outline, faller.reach_m) if flat else gone
    strays = watch_room(T_world_body[:2, 3], task.room_m)

    def drop(faller: Faller, *more: Watch) -> Fall:
        watches = (leaves, strays, *more)
        motion = fall([faller], [start.T_world_obj], ground, task.physics, pace, seconds, free, watches)
        if motion.happened == 1:
            raise LeftRoomError
        return motion

    down = -T_world_body[2, :3]
    if flat and len(faller.body.parts) == 1 and stands_on_face(faller.body.parts[0], down):
        vertices = faller.body.parts[0]
        motion = drop(faller.only(vertices[can_touch(vertices, down)]), watch_tilt(T_world_body))
        if motion.happened != 2:
            return motion
    return drop(faller)
