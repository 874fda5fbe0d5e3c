"""What stood still: depth beside the colour of its view, and the object on the board from view to view."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from schemas.base import Array
from workers.capture.poses.joint import gather
from workers.capture.poses.observation import Observation
from workers.capture.poses.terms import SIGNIFICANT, Shared
from workers.geometry.frames import invert, transform

# ---------------------------------------------------------------------------------------------- where the object stood

WITHIN_RAD = 0.008
"""A point is compared with the patch of another view whose middle is at most so far from its direction: within the patch."""
GRAZING = 0.15
"""A patch whose plane a ray meets at a smaller cosine does not tell a depth there."""
SEEN_THROUGH_M = 0.004
"""A view that sees so much farther than a patch of another, beyond their noise, sees the object elsewhere. Depth of captures
whose object rests is within 3 mm in 99 of 100 comparisons."""
MOVED_SHARE = 0.032
"""More than this share of two groups' patches is seen through where the object moved between them. Measured on simulated
captures: of an object at rest up to 0.014 are (a mug's handle), of one that moved 3 cm 0.06 (a box, which slides within its
faces) to 0.8."""
FEW_PATCHES = 50.0
"""So many patches more count in the share by which groups are merged: a few that agree say little."""
LEVEL = 0.95
NEAR_BOARD_M = 0.01
"""A patch of the board has at least this cosine to its normal, and lies within this of its plane."""
NEAREST_M = 0.05
"""What is nearer to a camera is not seen by it."""


def object_groups(
    seen: Sequence[Observation], poses: Array, shared: Shared, sigma_m: float, unsure_m: Array
) -> list[list[int]]:
    """Indices of the views, ascending, in groups within which the object stands still; the largest group first.

    A patch of the object that another view looks through stands there no longer. Groups are merged, those that see through
    the smallest share of each other first, up to MOVED_SHARE. sigma_m is that of a patch at 1 m, unsure_m [V] that of what
    each pose does to a point of the object. A view that was compared with no other stays in the first group.
    """
    agree, through = _compare(seen, poses, shared, sigma_m, unsure_m)
    compared = agree + through
    groups = [[number] for number in range(len(seen))]
    while len(groups) > 1:
        i, j = np.triu_indices(len(groups), 1)
        count = agree[i, j] + through[i, j]
        score = (through[i, j] / (count + FEW_PATCHES)) + 1 / (agree[i, j] + FEW_PATCHES)
        score[(count == 0) | (through[i, j] > MOVED_SHARE * count)] = np.inf
        if np.isinf(score.min()):
            break
        kept, merged = i[score.argmin()], j[score.argmin()]
        groups[kept] += groups.pop(merged)
        for counts in (agree, through):
            counts[kept] += counts[merged]
            counts[:, kept] += counts[:, merged]
        agree, through = (np.delete(np.delete(c, merged, axis=0), merged, axis=1) for c in (agree, through))
    groups.sort(key=lambda group: (-len(group), min(group)))
    apart = [sorted(group) for group in groups[1:] if compared[np.ix_(group, groups[0])].any()]
    elsewhere = {number for group in apart for number in group}
    return [[number for number in range(len(seen)) if number not in elsewhere], *apart]


def _compare(
    seen: Sequence[Observation], poses: Array, shared: Shared, sigma_m: float, unsure_m: Array
) -> tuple[Array, Array]:
    """(agree, through), each [V, V] symmetric: patches by which two views agree, and those that one sees through."""
    points, normals = [], []
    for view, T in zip(seen, poses, strict=True):
        patches, _ = gather([view.object_patches, view.board_patches])
        p, normal = shared.corrected(patches), patches.normal @ shared.T_cam_depth[:3, :3].T
        # What hides a part of a gap between markers bends its plane.
        kept = (normal @ T[2, :3] > LEVEL) & (np.abs(transform(T, p)[:, 2]) < NEAR_BOARD_M)
        kept[: len(view.object_patches)] = True
        points.append(p[kept])
        normals.append(normal[kept])
    trees = [cKDTree(p[:, :2] / p[:, 2:]) if len(p) else None for p in points]
    counts = np.zeros((2, len(seen), len(seen)))
    for number, view in enumerate(seen):
        on_board = transform(poses[number], points[number][: len(view.object_patches)])
        for other, tree in enumerate(trees):
            if other == number or tree is None or not len(on_board):
                continue
            p = transform(invert(poses[other]), on_board)
            p = p[p[:, 2] > NEAREST_M]
            distance, nearest = tree.query(p[:, :2] / p[:, 2:])
            plane, ray = normals[other][nearest], p / p[:, 2:]
            along = (plane * ray).sum(axis=1)
            met = (distance < WITHIN_RAD) & (np.abs(along) > GRAZING)
            beyond = (plane * points[other][nearest]).sum(axis=1)[met] / along[met] - p[met, 2]
            sigma = np.hypot(sigma_m * p[met, 2] ** 2, np.hypot(unsure_m[number], unsure_m[other]))
            limit = SEEN_THROUGH_M + SIGNIFICANT * sigma
            counts[:, number, other] = (np.abs(beyond) <= limit).sum(), (beyond > limit).sum()
    agree, through = counts + counts.transpose(0, 2, 1)
    return agree, through
