"""What stood still: depth beside the colour of its view, and the object on the board from view to view."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from schemas.base import Array
from schemas.errors import CaptureError
from workers.capture.poses.joint import BoardTerm, gather
from workers.capture.poses.markers import Evidence
from workers.capture.poses.observation import Observation
from workers.capture.poses.terms import MAD, SIGNIFICANT, Shared, Solution, robust
from workers.geometry.frames import invert, pose, transform

# ---------------------------------------------------------------------------------------------- depth beside colour

PLANE, FEWEST_PATCHES = 3, 8
"""A view's depth lies beside the board by a height and two slopes, which so many patches tell."""
APART_M, APART_RAD = 0.0015, 0.002
"""Root mean squares over the views of less are what sensors err by themselves."""
LEFT = 0.3
"""What planes leave of heights, where depth is of another moment, at most: errors of a sensor bend planes."""
STEPS = 4
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
    planes, left = _fit_planes(term, solution.poses, solution.shared)
    height_m, slope = np.sqrt((planes[:, 0] ** 2).mean()), np.sqrt((planes[:, 1:] ** 2).sum(axis=1).mean())
    if height_m < APART_M or slope < APART_RAD or left > LEFT:
        return None
    note = (
        "depth and colour are not of one moment: from view to view depth lies otherwise off the board, by "
        f"{1000 * height_m:.1f} mm and {np.degrees(slope):.1f} degrees: hold the camera still for each view"
    )
    planes, _ = _fit_planes(term, solution.poses, Shared())
    turns = Rotation.from_rotvec(np.column_stack([-planes[:, 2], planes[:, 1], np.zeros(len(planes))])).as_matrix()
    beside = np.stack([pose(R, np.array([0, 0, -h])) for R, h in zip(turns, planes[:, 0], strict=True)])
    # Across the board nothing tells depth's place: it is off by as much as along it, and by turns at the camera's distance.
    distance_m = np.median(np.linalg.norm(solution.poses[:, :3, 3], axis=1))
    aside_m = np.hypot(np.sqrt((planes[:, 0] ** 2).mean()), slope / np.sqrt(2) * distance_m)
    return Moment(beside, float(aside_m), note)


def _fit_planes(term: BoardTerm, poses: Array, shared: Shared) -> tuple[Array, float]:
    """(height, metres, and slopes along x and y of depth over the board in each view [V, 3], and what share they leave).

    The planes are robust; the share is of medians, over all patches.
    """
    p = np.einsum("pij,pj->pi", poses[term.view, :3, :3], shared.corrected(term.patches)) + poses[term.view, :3, 3]
    planes, left = np.zeros((len(poses), PLANE)), p[:, 2] / term.growth
    for number in range(len(poses)):
        here = term.view == number
        if here.sum() < FEWEST_PATCHES:
            continue
        growth, A, height = term.growth[here], np.column_stack([np.ones(here.sum()), p[here, :2]]), p[here, 2]
        weight = 1.0 / growth**2
        for _ in range(STEPS):
            planes[number] = np.linalg.lstsq(A * np.sqrt(weight)[:, None], height * np.sqrt(weight), rcond=None)[0]
            left[here] = (height - A @ planes[number]) / growth
            spread = max(MAD * float(np.median(np.abs(left[here]))), 1e-6)
            weight = robust((left[here] / spread) ** 2, growth**-2.0)[0]
    return planes, float(np.median(np.abs(left)) / np.median(np.abs(p[:, 2] / term.growth)))


def check_moments(evidence: Evidence) -> None:
    """Raises CaptureError where the depth of several views is that of the view before or after."""
    fits = {
        seen.number: view.fit.T_board_cam
        for seen, view in zip(evidence.observations, evidence.markers, strict=True)
        if view.fit
    }
    numbers, pairs, off_board = sorted(fits), [], 0
    by_number = {seen.number: seen.board_patches for seen in evidence.observations}
    for place, number in enumerate(numbers):
        patches = by_number[number]
        if len(patches) < FEWEST_PATCHES:
            continue
        near = [number, *{numbers[place - 1], numbers[(place + 1) % len(numbers)]} - {number}]
        off_mm = [1000 * float(np.median(np.abs(transform(fits[n], patches.ray_z)[:, 2]))) for n in near]
        if off_mm[0] > ANOTHER_MM:
            off_board += 1
            nearest = int(np.argmin(off_mm))
            if off_mm[nearest] < min(ANOTHER_MM, NEARER * off_mm[0]):
                pairs.append(f"depth_{number:05d} is of view {near[nearest]}")
    if len(pairs) > 1 and 2 * len(pairs) > off_board:
        raise CaptureError(
            "depth", f"colour and depth are not of one moment: {', '.join(pairs)}: name each pair by one number"
        )


# ---------------------------------------------------------------------------------------------- where the object stood

WITHIN_RAD = 0.008
"""A point is compared with the patch of another view whose middle is at most so far from its direction: within the patch."""
ASIDE = 16
"""So many patches around a point are looked at, where a pose is so unsure that it may take it aside."""
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
            ray, unsure = p / p[:, 2:], np.hypot(unsure_m[number], unsure_m[other])
            distance, nearest = tree.query(ray[:, :2], k=range(1, min(ASIDE, tree.n) + 1))
            # A pose that is unsure may take a point past the edge of what it lies on: all that it may meet must be nearer.
            near = distance < SIGNIFICANT * unsure / p[:, 2:]
            near[:, 0] |= distance[:, 0] < WITHIN_RAD
            plane = normals[other][np.minimum(nearest, tree.n - 1)]
            along = np.einsum("pki,pi->pk", plane, ray)
            near &= np.abs(along) > GRAZING
            at = points[other][np.minimum(nearest, tree.n - 1)]
            beyond = (plane * at).sum(axis=2) / np.where(near, along, 1.0) - p[:, 2:]
            sigma = np.hypot(sigma_m * p[:, 2:] ** 2, unsure / np.where(near, np.abs(along), 1.0))
            limit = SEEN_THROUGH_M + SIGNIFICANT * sigma
            agrees = (near & (np.abs(beyond) <= limit)).any(axis=1)
            through = near.any(axis=1) & (~near | (beyond > limit)).all(axis=1)
            counts[:, number, other] = agrees.sum(), through.sum()
    agree, through = counts + counts.transpose(0, 2, 1)
    return agree, through
