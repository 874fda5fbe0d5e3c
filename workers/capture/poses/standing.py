"""Where depth saw the board and the object in each view: of which moment it is, where the object stood, what lies beside it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from schemas.base import Array
from schemas.errors import CaptureError
from workers.capture.poses.joint import BoardTerm, gather
from workers.capture.poses.markers import Evidence
from workers.capture.poses.observation import SIDE_RAD, Observation
from workers.capture.poses.terms import SHARED, SIGNIFICANT, Problem, Shared, Solution, minimise
from workers.geometry.frames import invert, transform

# ---------------------------------------------------------------------------------------------- the moment of depth

FEWEST_PATCHES = 8
"""So many patches tell the plane in which depth sees the board."""
OFF_M, OFF_RAD = 0.0015, 0.002
"""Root mean squares over the views of less are what sensors err by themselves."""
LEFT = 0.3
"""What planes leave of heights, where depth is of another moment, at most: errors of a sensor bend planes."""
MOST_STEPS = 8
ANOTHER_MM, NEARER = 10.0, 0.3
"""Depth farther off the board than this is a neighbouring view's, where it lies off it by at most this share in that view."""


@dataclass(frozen=True, eq=False)
class Moment:
    """Where depth saw the board: T_board_depth [V, 4, 4] takes depth's places on the board to colour's; sigma across, metres."""

    T_board_depth: Array
    unsure_m: float
    note: str


def find_moment(term: BoardTerm, solution: Solution) -> Moment | None:
    """By how much each view's depth lies beside the board as its colour has it; None where they are of one moment.

    What a depth camera errs by in all views is in the solution, and tells nothing of moments; where they differ, it is no more
    than their mean, and depth is taken as it was measured.
    """
    T, left = _poses_by_depth(term, solution.poses, solution.shared)
    height_m, slope = np.sqrt((T[:, 2, 3] ** 2).mean()), np.sqrt((T[:, :2, 2] ** 2).sum(axis=1).mean())
    if height_m < OFF_M or slope < OFF_RAD or left > LEFT:
        return None
    note = (
        "depth and colour are not of one moment: from view to view depth lies otherwise off the board, by "
        f"{1000 * height_m:.1f} mm and {np.degrees(slope):.1f} degrees: hold the camera still for each view"
    )
    # Across the board nothing tells depth's place: it is off by as much as along it, and by turns at the camera's distance.
    T, _ = _poses_by_depth(term, solution.poses, Shared())
    distance_m = np.median(np.linalg.norm(solution.poses[:, :3, 3], axis=1))
    aside_m = np.hypot(np.sqrt((T[:, 2, 3] ** 2).mean()), slope / np.sqrt(2) * distance_m)
    return Moment(T, float(aside_m), note)


def _poses_by_depth(term: BoardTerm, poses: Array, shared: Shared) -> tuple[Array, float]:
    """(T_board_depth [V, 4, 4], by the least motions that lay depth on the board; what share of its height they leave)."""
    few = np.bincount(term.view, minlength=len(poses)) < FEWEST_PATCHES
    placed = minimise(Problem([term], np.zeros(SHARED), few), poses, shared, MOST_STEPS).poses
    before, after = (np.median(np.abs(term.rows(T, shared).residual)) for T in (poses, placed))
    return placed @ np.stack([invert(T) for T in poses]), float(after / before)


def check_moments(evidence: Evidence) -> None:
    """Raises CaptureError where the depth of several views is that of the view before or after."""
    views = [
        (seen, view.fit.T_board_cam)
        for seen, view in zip(evidence.observations, evidence.markers, strict=True)
        if view.fit and len(seen.board_patches) >= FEWEST_PATCHES
    ]
    pairs, off_board = [], 0
    for place, (seen, T) in enumerate(views):
        near = [(seen, T), views[place - 1], views[(place + 1) % len(views)]]
        off_mm = [1000 * float(np.median(np.abs(transform(T, seen.board_patches.ray_z)[:, 2]))) for _, T in near]
        off_board += off_mm[0] > ANOTHER_MM
        if off_mm[0] > ANOTHER_MM and min(off_mm) < min(ANOTHER_MM, NEARER * off_mm[0]):
            pairs.append(f"depth_{seen.number:05d} is of view {near[int(np.argmin(off_mm))][0].number}")
    if len(pairs) > 1 and 2 * len(pairs) > off_board:
        raise CaptureError(
            "depth", f"colour and depth are not of one moment: {', '.join(pairs)}: name each pair by one number"
        )


# ---------------------------------------------------------------------------------------------- the object

WITHIN_RAD = SIDE_RAD / 2
"""A point is compared with the patch of another view whose middle is at most half a patch from its direction, this in the usual
sizes of images: beside the rim of a thin thing the next patch is of what lies behind."""
ASIDE = 16
"""So many patches around a point are looked at, where a pose is so unsure that it may take it aside."""
GRAZING = 0.15
"""A patch whose plane a ray meets at a smaller cosine does not tell a depth there."""
SEEN_THROUGH_M = 0.004
"""A view that sees so much farther than a patch of another, beyond their noise, sees the object elsewhere. Depth of captures
whose object rests is within 3 mm in 99 of 100 comparisons."""
SMOOTH = 1.3
"""Pixels of a flat patch, 25 or more, lie off its plane by at most so many times the usual: two sigmas of what noise does."""
MOVED_SHARE = 0.024
"""More than this share of two groups' patches is seen through where the object moved between them. Measured on eighteen
simulated captures: of an object at rest 0.004 are in the median and 0.03 at most (one of eight views of an open jar, whose rim is
thin), of a box that moved 2 to 4 cm 0.05, as it slides within its faces, and of others up to 0.9."""
FEW_PATCHES = 50.0
"""So many patches more count in the shares by which groups are merged: a few say little."""
LINKED_M = 0.03
"""Patches of a view so near to one another are of one thing."""
APART_M = 0.05
"""And it is no part of the object, nor the object itself a little moved, where it reaches so far from what most views share."""
LEAST_CLUTTER = 3
"""So many patches of it, at least."""
LEVEL = 0.95
NEAR_BOARD_M = 0.01
"""A patch of the board has at least this cosine to its normal, and lies within this of its plane."""
NEAREST_M = 0.05
"""What is nearer to a camera is not seen by it."""


def object_groups(
    seen: Sequence[Observation],
    poses: Array,
    shared: Shared,
    sigma_m: float,
    unsure_m: Array,
    within_rad: float = WITHIN_RAD,
) -> tuple[list[list[int]], list[NDArray[np.bool_]]]:
    """(indices of the views, ascending, in groups within which the object stands still, the largest first; clutter by view).

    A patch of the object that another view looks through stands there no longer. Groups are merged, those that see through
    the smallest share of each other first, up to MOVED_SHARE. sigma_m is that of a patch at 1 m, unsure_m [V] that of what
    each pose does to a point of the object. A view that was compared with no other stays in the first group. Clutter [P] of
    each view's patches, what it alone has on the board, is compared with none. within_rad: half a patch, seen from the camera.
    """
    points, views = _compare(seen, poses, shared, (sigma_m, unsure_m), within_rad)
    clutter = _clutter(points, views)
    groups = _merge(np.stack([v[:, ~out].sum(axis=1) for v, out in zip(views, clutter, strict=True)], axis=1))
    rest = sorted(number for group in groups[1:] for number in group)
    if any(clutter[number].any() for number in rest):  # what moved far is clutter beside what most views share
        apart = np.stack([views[number].sum(axis=1)[:, rest] for number in rest], axis=1)
        groups[1:] = [[rest[n] for n in group] for group in _merge(apart)]
    return groups, clutter


def _merge(counts: Array) -> list[list[int]]:
    """Groups of views by counts [2, V, V]: patches of one by which another agrees, and which it looks through."""
    agree, through = counts + counts.transpose(0, 2, 1)
    compared = agree + through
    groups = [[number] for number in range(len(agree))]
    while len(groups) > 1:
        i, j = np.triu_indices(len(groups), 1)
        count = agree[i, j] + through[i, j]
        score = (through[i, j] / (count + FEW_PATCHES)) + 1 / (agree[i, j] + FEW_PATCHES)
        score[(count == 0) | (through[i, j] > MOVED_SHARE * (count + FEW_PATCHES))] = np.inf
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
    return [[number for number in range(len(compared)) if number not in elsewhere], *apart]


def _clutter(points: Sequence[Array], views: Sequence[Array]) -> list[NDArray[np.bool_]]:
    """[P] of each view's patches: those of things that reach away from what most views share, and that most look through.

    points [P, 3], board frame; views [2, P, V]: which agree with a patch, and which look through it.
    """
    place, view = np.concatenate(points), np.repeat(np.arange(len(points)), [len(p) for p in points])
    agree, through = (np.concatenate([v[kind].sum(axis=1) for v in views]) for kind in (0, 1))
    common = np.flatnonzero((agree > 0) & (agree >= through))
    thing, count = _things(place[common])
    of_views = np.unique(np.stack([thing, view[common]]), axis=1)[0]  # each thing once for each view that has it
    of_views = np.bincount(of_views, minlength=count)
    common = common[2 * of_views[thing] >= of_views.max(initial=0)]
    clutter = np.zeros(len(place), np.bool_)
    if len(common):
        far = (cKDTree(place[common]).query(place)[0] > APART_M) & (through > agree)
        for number in range(len(points)):
            loose = np.setdiff1d(np.flatnonzero(view == number), common)
            thing, count = _things(place[loose])
            clutter[loose] = (np.bincount(thing, far[loose], count) >= LEAST_CLUTTER)[thing]
    return np.split(clutter, np.cumsum([len(p) for p in points])[:-1])


def _things(points: Array) -> tuple[NDArray[np.int64], int]:
    """([P] the thing that each of points [P, 3] is of, how many there are)."""
    pairs = cKDTree(points).query_pairs(LINKED_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(points),) * 2)
    count, thing = connected_components(graph, directed=False)
    return thing, count


def _compare(
    seen: Sequence[Observation], poses: Array, shared: Shared, sigmas: tuple[float, Array], within_rad: float
) -> tuple[list[Array], list[Array]]:
    """(points [P, 3] of each view's object patches, board frame; [2, P, V]: which views agree with each, which look through)."""
    points, normals, bends, (sigma_m, unsure_m) = [], [], [], sigmas
    rough = [o.object_patches.sigma_m / o.object_patches.ray_z[:, 2] ** 2 for o in seen if len(o.object_patches)]
    smooth = SMOOTH * float(np.median(np.concatenate(rough))) if rough else 0.0
    for view, T in zip(seen, poses, strict=True):
        patches, _ = gather([view.object_patches, view.board_patches])
        p, normal = shared.corrected(patches), patches.normal @ shared.T_cam_depth[:3, :3].T
        # What hides a part of a gap between markers bends its plane.
        kept = (normal @ T[2, :3] > LEVEL) & (np.abs(transform(T, p)[:, 2]) < NEAR_BOARD_M)
        kept[: len(view.object_patches)] = True
        points.append(p[kept])
        normals.append(normal[kept])
        # A patch across a crease is on neither side of it: its plane errs by what bends it.
        bends.append(np.sqrt(np.maximum(0.0, patches.sigma_m**2 - (smooth * p[:, 2] ** 2) ** 2))[kept])
    trees = [cKDTree(p[:, :2] / p[:, 2:]) if len(p) else None for p in points]
    on_board = [transform(T, p[: len(v.object_patches)]) for v, T, p in zip(seen, poses, points, strict=True)]
    views = [np.zeros((2, len(p), len(seen))) for p in on_board]
    for number, place in enumerate(on_board):
        for other, tree in enumerate(trees):
            if other == number or tree is None or not len(place):
                continue
            p = transform(invert(poses[other]), place)
            front = np.flatnonzero(p[:, 2] > NEAREST_M)
            p = p[front]
            ray, unsure = p / p[:, 2:], np.hypot(unsure_m[number], unsure_m[other])
            own_bend = bends[number][: len(place)][front, None]
            distance, nearest = tree.query(ray[:, :2], k=range(1, min(ASIDE, tree.n) + 1))
            # A pose that is unsure may take a point past the edge of what it lies on: all that it may meet must be nearer.
            near, nearest = distance < SIGNIFICANT * unsure / p[:, 2:], np.minimum(nearest, tree.n - 1)
            near[:, 0] |= distance[:, 0] < within_rad
            along = np.einsum("pki,pi->pk", normals[other][nearest], ray)
            near &= np.abs(along) > GRAZING
            along = np.where(near, along, 1.0)
            beyond = (normals[other][nearest] * points[other][nearest]).sum(axis=2) / along - p[:, 2:]
            across = np.sqrt(unsure**2 + own_bend**2 + bends[other][nearest] ** 2)
            sigma = np.hypot(sigma_m * p[:, 2:] ** 2, across / np.abs(along))
            limit = SEEN_THROUGH_M + SIGNIFICANT * sigma
            views[number][0, front, other] = (near & (np.abs(beyond) <= limit)).any(axis=1)
            views[number][1, front, other] = near.any(axis=1) & (~near | (beyond > limit)).all(axis=1)
    return on_board, views
