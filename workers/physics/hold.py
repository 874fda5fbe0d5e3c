"""Objects at rest on one another, let go again: whether they stay, and where they come to rest if friction lets go."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.base import Array, Pose
from schemas.job.physics import Rest
from workers.geometry.contact_surface import faces_within, skin_of
from workers.geometry.frames import transform
from workers.physics.bullet import SLOP_SHARE, GroundShape
from workers.physics.effects import is_convex
from workers.physics.fall import FINEST, Outcome, StepSizes, fall
from workers.physics.monitors import strays
from workers.physics.placement import Placement, farthest_m
from workers.physics.release import CROWD, Drop, Pace, settings_of
from workers.physics.rest.contacts import contacts_within
from workers.physics.rest.rest import LEVEL, Rested, rest
from workers.physics.rigid_body import make_body
from workers.physics.table_top import inside_margin, split_by_side

HELD = (9, Rest(speed_mm_s=0.05, window_s=0.05), 1.5e-5), (math.inf, Rest(speed_mm_s=0.05, window_s=1.0), 5e-5)
"""When what is let go stays, of fewer objects than this: slower than half of 0.1 mm/s, and moved by this at most, metres. Skins
make up their margins by up to 10 micrometres. Slips in heaps take longer to begin: of twenty boxes three stood for 0.6 s before
they went by half a millimetre; and some creep by 0.03 mm in a second, wherever they are."""

MOST_HOLDS = 3
"""Times that objects are let go before they fall anew, each from where they came to rest the time before, and twice as far."""

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
    changes = {"rest": still, "max_settle_s": 0.15 + still.window_s}
    held = dataclasses.replace(drop, physics=drop.physics.model_copy(update=changes))
    for far_m in (2.0**number * FAR_M for number in range(MOST_HOLDS)):
        rested = rest(placement.things, poses, placement.forms[-1].surface, placement.friction)
        if not rested.still or len(poses) >= CROWD:
            return rested
        # No larger groups for what may move farther: the solver ends too early in them, and hides what slips
        groups = _groups(placement, rested.poses, level=False)
        poses = let_go(held, placement, rested.poses, far_m, groups)
        if farthest_m(drop.starts, rested.poses, poses) <= held_m:
            return rested
    return Rested(tuple(poses), False, 0)


def let_go(
    drop: Drop,
    placement: Placement,
    poses: Sequence[Pose],
    far_m: float = FAR_M,
    groups: Sequence[list[int]] | None = None,
    level_rate: float = FINEST,
) -> tuple[Pose, ...]:
    """The `T_world_obj` of objects, let go at these in the finest steps, once they rest, or one of them has moved by `far_m`.

    What cannot meet is let go on its own: beside others Bullet's solver ends before it has found the forces of each. groups:
    of those to let go; all, if not given. level_rate: steps a second, in the settings', of what meets level ground alone.
    """
    went = list(poses)
    for group in _groups(placement, poses, level=True) if groups is None else groups:
        few = dataclasses.replace(drop, starts=tuple(drop.starts[k] for k in group))
        outcome = _let_go(few, placement.of(group), [poses[k] for k in group], far_m, level_rate)
        for k, T in zip(group, outcome.poses, strict=True):
            went[k] = T
    return tuple(went)


def _groups(placement: Placement, poses: Sequence[Pose], level: bool) -> list[list[int]]:
    """The numbers of objects that can meet before one has moved by `FAR_M`; without `level` only those with contacts aslant."""
    contacts, count = contacts_within(placement.surfaces, (*poses, np.eye(4)), 2.0 * FAR_M), len(poses)
    paired, aslant = contacts.lower < count, np.linalg.norm(contacts.normals[:, :2], axis=1) > LEVEL
    pairs = np.ones(paired.sum()), (contacts.upper[paired], contacts.lower[paired])
    _, groups = connected_components(coo_array(pairs, shape=(count, count)), directed=False)
    asked = np.unique(groups if level else groups[contacts.upper[aslant]])
    return [np.flatnonzero(groups == each).tolist() for each in asked]


def _let_go(drop: Drop, placement: Placement, poses: Sequence[Pose], far_m: float, level_rate: float) -> Outcome:
    """The fall of objects that may meet.

    Their shapes are the skins of their meshes where they are near one another, in convex pieces: exact, and each with contacts of
    its own. Of two bodies that are one piece each Bullet keeps four contacts, chosen from some millimetres away, so that a
    box stands on three corners of four and on what it does not touch.
    """
    top, near_m = drop.table.top, 2.0 * far_m
    points = np.concatenate([transform(T, one.hull.vertices) for one, T in zip(drop.starts, poses, strict=True)])
    low_m, inside_m = points[:, 2].min(), inside_margin(points[:, :2], top.outline).min()
    level = top.convex and low_m > top.height_m - near_m and inside_m > near_m
    physics = settings_of(drop, Pace(rate=level_rate if level and drop.single else FINEST))
    skins = _skins(placement, poses, near_m, top.height_m if level else -math.inf)
    whole = [make_body(start, parts) for start, parts in zip(drop.starts, skins, strict=True)]
    bodies = [dataclasses.replace(body, margin_m=THIN * body.margin_m) for body in whole]
    ground: GroundShape = split_by_side(drop.table.mesh)
    if level:
        ground = top.height_m - bodies[0].margin_m * (1.0 - SLOP_SHARE)
    begun = np.stack([(T @ body.T_obj_body)[:3, 3] for T, body in zip(poses, bodies, strict=True)])
    stops = {"far": strays(begun, far_m)}
    return fall(bodies, poses, ground, physics, StepSizes(physics.step_hz, math.inf), 0.0, stops, reach_m=SKIN_M)


def _skins(placement: Placement, poses: Sequence[Pose], near_m: float, level_m: float) -> list[tuple[Array, ...]]:
    """The pieces [N, 3] of each object, in its own frame, that are within this of others or of the table.

    level_m: height of the half-space that the table is here, -inf if it is none. Only corners of an object's hull can meet it:
    they stand for the foot of one that is not convex, a ring of a hundred faces.
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
        skin = skin_of(surfaces[number], np.flatnonzero(near[number]), SKIN_M)
        skins.append((*skin, *(corner + SPIKE @ T[:3, :3] for corner in low)))
    return skins
