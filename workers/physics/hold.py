"""Whether objects stay where they rest: landed in closed form, or let go there in the simulator on the skins of their meshes.

Where they do not stay they come to rest anew from where they went.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.base import Array, Pose
from schemas.errors import SettleError
from schemas.job.physics import Physics, Rest
from schemas.scene.scene import EffectPlan, ObjectStart, ScenePlan, Settled, Table
from workers.geometry.frames import motion_between, transform, translation
from workers.physics.bullet import GRAVITY_M_S2, SLOP_M, SLOP_SHARE, GroundShape
from workers.physics.contact_surface import faces_within, skin_of
from workers.physics.contacts import contacts_within
from workers.physics.effects import is_convex
from workers.physics.exact_rest import LEVEL, Rested
from workers.physics.fall import FINEST, Outcome, StepSizes, Watch, fall, strays
from workers.physics.placement import TOUCHING_M, Form, Placement, farthest_m, forms_of, place, placed_mesh
from workers.physics.pour import points_of
from workers.physics.release import CROWD, Drop, Pace, settings_of, unevenness
from workers.physics.rigid_body import make_body
from workers.physics.support import columns_apart, inside_margin, split_by_side, stands_on_face, vertical_gap

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
    held_m = max(held_m, min(UNEVEN_M, held_m * (unevenness(drop.starts) / UNEVEN) ** 0.25))
    changes = {"rest": still, "max_settle_s": 0.15 + still.window_s}
    held = dataclasses.replace(drop, physics=drop.physics.model_copy(update=changes))
    for far_m in (2.0**number * FAR_M for number in range(MOST_HOLDS)):
        most = POURED_STEPS if drop.in_waves else math.inf
        rested = placement.rest(poses, most, drop.physics.spinning_friction)
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
    skins, apart = _skins(placement, poses, near_m, top.height_m if level else -math.inf, insets_m)
    whole = [make_body(start, parts) for start, parts in zip(drop.starts, skins, strict=True)]
    bodies = [dataclasses.replace(body, margin_m=margin_m) for body, margin_m in zip(whole, margins_m, strict=True)]
    ground: GroundShape = split_by_side(drop.table.mesh)
    if level:
        ground = top.height_m - (margins_m[0] - insets_m[0] - slop_m)
    begun = np.stack([(T @ body.T_obj_body)[:3, 3] for T, body in zip(poses, bodies, strict=True)])
    watch, counts = Watch({"far": strays(begun, far_m)}, apart=apart), [len(skin) for skin in skins]
    if drop.budget.left <= 0.0:
        raise SettleError("unsupported", _too_much(drop, sum(counts)))
    outcome = fall(bodies, poses, ground, physics, StepSizes(physics.step_hz, math.inf), 0.0, watch, reach_m=SKIN_M)
    meeting = set(itertools.combinations(range(len(skins)), 2)).difference(apart)
    drop.budget.left -= outcome.seconds * physics.step_hz * sum(counts[i] * counts[j] for i, j in meeting)
    return outcome


def _too_much(drop: Drop, pieces: int) -> str:
    names = ", ".join(f"{start.region_id} ({start.asset.category})" for start in drop.starts)
    return (
        f"regions {names} touch with {pieces} faces and do not stay when they are let go, which was tried for as long as a "
        "scene may take: use coarser meshes or fewer objects_per_scene, or let them fall apart by a wider start.pile_offset_m"
    )


def _skins(
    placement: Placement, poses: Sequence[Pose], near_m: float, level_m: float, insets_m: Sequence[float]
) -> tuple[list[tuple[Array, ...]], list[tuple[int, int]]]:
    """(the pieces [N, 3] of each object, in its own frame, that are within this of others or of the table; pairs that are not).

    insets_m: how far each one's are inside of its mesh, as margins and overlap stand out: a cup in a tapered cup would rise by
    eight times as much. level_m: height of the half-space that the table is here, -inf if it is none. Only corners of an object's
    hull can meet it: they stand for the foot of one that is not convex, a ring of a hundred faces.
    """
    surfaces, level = placement.surfaces, [math.isfinite(level_m) and not is_convex(one) for one in placement.starts]
    points = [transform(T, one.vertices) for T, one in zip((*poses, np.eye(4)), surfaces, strict=True)]
    near, apart = [np.zeros(len(one.faces), dtype=np.bool_) for one in surfaces], list[tuple[int, int]]()
    for i, j in itertools.combinations(range(len(surfaces)), 2):
        if j < len(poses) or not level[i]:
            here, there = faces_within((points[i], surfaces[i].faces), (points[j], surfaces[j].faces), near_m)
            near[i][here] = near[j][there] = True
            if j < len(poses) and not len(here):
                apart.append((i, j))
    skins = []
    for number, (start, T) in enumerate(zip(placement.starts, poses, strict=True)):
        low = start.hull.vertices[level[number] & (transform(T, start.hull.vertices)[:, 2] <= level_m + near_m)]
        skin = skin_of(surfaces[number], np.flatnonzero(near[number]), SKIN_M, insets_m[number])
        skins.append((*skin, *(corner + np.add(SPIKE, [0.0, 0.0, insets_m[number]]) @ T[:3, :3] for corner in low)))
    return skins, apart


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
    placement = place(starts, poses, forms_of(starts), plan.table, physics)
    return let_go(Drop(starts, plan.table, physics, effects), placement, poses, rate=rate)[0]


def moved_by(start: ObjectStart, before: Pose, after: Pose) -> tuple[float, float]:
    """(mm that the farthest point of an object moves between two poses, degrees that it turns)."""
    moved_m, turned_rad = motion_between(start.hull.vertices, before, after)
    return moved_m * 1e3, math.degrees(turned_rad)


def land(drop: Drop, flat: bool, forms: Sequence[Form]) -> tuple[Placement, tuple[Pose, ...], float] | None:
    """Objects that stand where they first touch the table: placed, at `T_world_obj` [4, 4] of each, after so many seconds.

    None where one goes on. What then stands has come to rest: an impact without a rebound takes all speed where contacts all
    about the centre of mass take it at once, on a face (Stronge 2000, "Impact Mechanics"). A simulator, which finds them one by
    one, would turn and push it by millimetres; but a single hull on the flat top it lands within 2 micrometres, and that is not
    asked for here.
    """
    effects = drop.effects
    if effects.runs("restitution") or (flat and drop.single and not effects.runs("decomposition")):
        return None
    fallen = _fall_straight(drop.starts, drop.table)
    if fallen is None or fallen[1] > drop.physics.max_settle_s:
        return None
    poses, seconds = fallen
    placement = place(drop.starts, poses, forms, drop.table, drop.physics)
    rested = hold(drop, placement, poses)
    stands = rested.still and farthest_m(drop.starts, poses, rested.poses) <= TOUCHING_M
    return (placement, rested.poses, seconds) if stands else None


def _fall_straight(starts: Sequence[ObjectStart], table: Table) -> tuple[tuple[Pose, ...], float] | None:
    """(poses [4, 4] where objects first touch the table, seconds of the longest fall), all straight down.

    None where one does not come down on a face of its hull, or not in a column of its own.
    """
    if not all(stands_on_face(start.hull.vertices, -start.T_world_obj[2, :3]) for start in starts):
        return None
    if not all(columns_apart(points_of(a), points_of(b)) for a, b in itertools.combinations(starts, 2)):
        return None
    falls_m = [vertical_gap(placed_mesh(start, start.T_world_obj), table.mesh) for start in starts]
    if not 0.0 <= min(falls_m) <= max(falls_m) < math.inf:
        return None
    poses = tuple(translation(0.0, 0.0, -m) @ start.T_world_obj for start, m in zip(starts, falls_m, strict=True))
    return poses, math.sqrt(2.0 * max(falls_m) / GRAVITY_M_S2)
