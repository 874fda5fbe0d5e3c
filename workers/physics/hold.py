"""Objects at rest on one another, let go again: whether they stay, and where they come to rest if friction lets go."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from schemas.base import Array, Pose
from workers.geometry.contact_surface import faces_within, skin_of
from workers.geometry.frames import transform
from workers.physics.bullet import SLOP_SHARE, GroundShape
from workers.physics.fall import Outcome, StepSizes, fall
from workers.physics.monitors import strays
from workers.physics.placement import Placement, farthest_m
from workers.physics.release import PACES_TOGETHER, Drop, Pace, settings_of
from workers.physics.rest.rest import rest
from workers.physics.rigid_body import make_body
from workers.physics.table_top import inside_margin, split_by_side

HELD_FROM = 9
"""Number of objects from which rest is held: of 24 piles of eight one moved by 0.11 mm when let go again, of twenty boxes a fifth
by more. To hold a pile of eight takes as long as all else of its physics."""

HELD_M = 8e-5
"""Motion in a rest window up to which objects stay; the bound of what is let go for a second is 0.1 mm."""

MOST_HOLDS = 6
"""Times that objects are let go, each from where they came to rest the time before; of twenty boxes most need one, some three."""

FAR_M, FARTHEST_M = 2e-4, 3.2e-3
"""Motion of a centre of mass at which they are stopped, at first and at most: only faces within twice that are there to meet."""

LONGEST_S = 1.0
"""How long they are let go at most. How far and how long doubles where something slipped, so that what slides slowly stops."""

THIN = 0.1
"""Margin of skins as a share of what bodies fall with: by one and a half times that Bullet pushes apart what touches, which would
lift the top of a stack of ten by 0.12 mm."""

SKIN_M = 1e-4
"""Depth of skins, and contact distance, above both margins. Bullet's own distance, some millimetres, finds many contacts between
skins that do nothing."""


def hold(drop: Drop, placement: Placement, poses: Sequence[Pose]) -> tuple[Pose, ...] | None:
    """The `T_world_obj` of objects that stay where they are when they are let go, from where they came to exact rest; else None.

    Forces that balance all weights do not exclude that friction lets go: of more contacts than equations there are many such
    forces, and bodies need not find them. What slips comes to exact rest anew, from where it went.
    """
    if len(drop.starts) < HELD_FROM:
        return tuple(poses)
    far_m, seconds = FAR_M, drop.physics.rest.window_s
    for _ in range(MOST_HOLDS):
        window = drop.physics.rest.model_copy(update={"window_s": 2.0 * seconds})
        changes = {"step_hz": PACES_TOGETHER[-1].rate * drop.physics.step_hz, "max_settle_s": seconds, "rest": window}
        held = dataclasses.replace(drop, physics=drop.physics.model_copy(update=changes))
        went = let_go(held, placement, poses, far_m).poses
        if farthest_m(drop.starts, poses, went) <= HELD_M:
            return tuple(poses)
        rested = rest(placement.things, went, placement.forms[-1].surface, placement.friction)
        if not rested.still:
            break
        poses = rested.poses
        far_m, seconds = min(FARTHEST_M, 2.0 * far_m), min(LONGEST_S, 2.0 * seconds)
    return None


def let_go(drop: Drop, placement: Placement, poses: Sequence[Pose], far_m: float = FAR_M) -> Outcome:
    """What objects at these `T_world_obj` do in steps of `physics.step_hz`, until one of them moved by `far_m`.

    Their shapes are the skins of their meshes where they are near one another, in convex pieces: exact, and each with contacts of
    its own. Of two bodies that are one piece each Bullet keeps four contacts, chosen from some millimetres away, so that a
    box stands on three corners of four and on what it does not touch.
    """
    physics, top, near_m = settings_of(drop, Pace()), drop.table.top, 2.0 * far_m
    skins = _skins(placement, poses, near_m)
    whole = [make_body(start, parts) for start, parts in zip(drop.starts, skins, strict=True)]
    bodies = [dataclasses.replace(body, margin_m=THIN * body.margin_m) for body in whole]
    points = np.concatenate([transform(T, one.hull.vertices) for one, T in zip(drop.starts, poses, strict=True)])
    low_m, inside_m = points[:, 2].min(), inside_margin(points[:, :2], top.outline).min()
    ground: GroundShape = split_by_side(drop.table.mesh)
    if top.convex and low_m > top.height_m - near_m and inside_m > near_m:
        ground = top.height_m - bodies[0].margin_m * (1.0 - SLOP_SHARE)
    begun = np.stack([(T @ body.T_obj_body)[:3, 3] for T, body in zip(poses, bodies, strict=True)])
    stops = {"far": strays(begun, far_m)}
    return fall(bodies, poses, ground, physics, StepSizes(physics.step_hz, math.inf), 0.0, stops, reach_m=SKIN_M)


def _skins(placement: Placement, poses: Sequence[Pose], near_m: float) -> list[tuple[Array, ...]]:
    """The pieces [N, 3] of each object, in its own frame, that are within this of others or of the table."""
    surfaces = [form.surface for form in placement.forms]
    points = [transform(T, one.vertices) for T, one in zip((*poses, np.eye(4)), surfaces, strict=True)]
    near = [np.zeros(len(one.faces), dtype=np.bool_) for one in surfaces]
    for i, j in itertools.combinations(range(len(surfaces)), 2):
        here, there = faces_within((points[i], surfaces[i].faces), (points[j], surfaces[j].faces), near_m)
        near[i][here] = near[j][there] = True
    return [skin_of(one, np.flatnonzero(each), SKIN_M) for one, each in zip(surfaces[:-1], near, strict=False)]
