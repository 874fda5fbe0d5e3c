"""What a joint estimate found out about a capture and its user must know, in words."""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.captures import Board, Estimation
from workers.capture.poses.joint import Joint, Views
from workers.capture.poses.rows import SHARED
from workers.capture.poses.shared import NAMES, PRINT_SCALE
from workers.capture.poses.terms import BoardTerm, ObjectTerm

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
    if joint.board is not None:
        growth = joint.board.patches.ray_z[:, 2] ** 2
        notes.append(f"depth of the board: {_weights(joint.board, joint.board.view, growth)}")
    if joint.surface is not None:
        first, second = joint.surface.pairs.T
        z = joint.surface.patches.ray_z[:, 2]
        notes.append(
            f"depth of the object: {_weights(joint.surface, joint.surface.view[first], np.hypot(z[first] ** 2, z[second] ** 2))}"
        )
    if joint.board is None and joint.surface is None:
        notes.append("no depth on the board or the object: the joint estimate has corners alone")
    return notes


def _weights(term: BoardTerm | ObjectTerm, view: NDArray[np.int64], growth: Array) -> str:
    """The sigma of a patch, and of all that the patches of one view tell together."""
    together = np.bincount(view, 1.0 / (term.sigma_m**2 * term.inflation))
    patch, whole = np.median(term.sigma_m / growth), np.median(1.0 / np.sqrt(together[together > 0]))
    return f"sigma of a patch {1000 * patch:.2f} mm at 1 m, of all patches of a view together {1000 * whole:.2f} mm"
