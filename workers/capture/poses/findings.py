"""What a joint estimate found out about a capture and its user must know, in words."""

import math

import numpy as np

from schemas.base import Array
from schemas.job.captures import Board, Estimation
from workers.capture.poses.joint import Joint, Views
from workers.capture.poses.rows import SHARED
from workers.capture.poses.shared import NAMES, PRINT_SCALE
from workers.capture.poses.terms import ObjectTerm

SCALES_DIFFER = 0.01
"""Print and depth disagree: smaller differences may be errors of depth that change with distance, within specification."""
SIGNIFICANT = 3.0


def scale_note(joint: Joint, board: Board, spec: Estimation) -> str:
    """Whether print and depth disagree about the scale, which no capture can decide; empty where they agree."""
    shared = joint.solution.shared
    index = PRINT_SCALE if spec.trust == "depth" else NAMES.index("scale")
    # The scale of depth turns a measured length into a true one; the print's does so for a length of board.json.
    excess = (shared.print_scale if spec.trust == "depth" else 1.0 / shared.scale) - 1.0
    sigma = math.sqrt(max(0.0, float(joint.covariance[index - SHARED, index - SHARED])))
    if joint.prior[index] == 0 or abs(excess) < max(SCALES_DIFFER, SIGNIFICANT * sigma):
        return ""
    larger = "larger" if excess > 0 else "smaller"
    start = (
        "print and depth disagree about the scale: "
        f"by depth the print is {100 * abs(excess):.1f} % {larger} than board.json says"
    )
    if board.measured_ruler_m is not None:
        return f"{start}, although its ruler was measured; the ruler was believed" if spec.trust == "print" else start
    believed = "the print" if spec.trust == "print" else "depth"
    return (
        f"{start}. Which is right cannot be identified from the capture alone; {believed} was believed. "
        f"Measure the printed ruler ({1000 * board.ruler_m:g} mm) and write its length into board.json as measured_ruler_m"
    )


def noise_notes(joint: Joint, views: Views) -> list[str]:
    """The sigmas that the terms were weighed with."""
    notes = [f"sigma of a corner: {views.corner_px:.3f} px"]
    for term, what in ((joint.board, "the board"), (joint.surface, "the object")):
        if term is not None:
            patches = term.patches
            growth = patches.ray_z[:, 2] ** 2 if what == "the board" else np.hypot(*_squares(term))
            notes.append(
                f"depth of {what}: sigma of a patch {1000 * float(np.median(term.sigma_m / growth)):.2f} mm at 1 m, "
                f"variance inflated {term.inflation:.1f} times because patches of a view err alike"
            )
    if joint.board is None and joint.surface is None:
        notes.append("no depth on the board or the object: the joint estimate has corners alone")
    return notes


def _squares(term: object) -> tuple[Array, Array]:
    assert isinstance(term, ObjectTerm)
    z = term.patches.ray_z[:, 2]
    return z[term.pairs[:, 0]] ** 2, z[term.pairs[:, 1]] ** 2
