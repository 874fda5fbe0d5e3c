"""Whether the depth of a view is of the moment of its colour, by where depth sees the board."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from schemas.base import Array
from schemas.errors import CaptureError
from workers.capture.poses.joint import BoardTerm
from workers.capture.poses.markers import Evidence
from workers.capture.poses.terms import MAD, Shared, Solution, robust
from workers.geometry.frames import pose, transform

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
