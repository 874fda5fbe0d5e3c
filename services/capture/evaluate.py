"""`verso capture evaluate`: the errors of a processed capture against its truth or a given mesh."""

import argparse
import dataclasses
import json
from typing import Any

from schemas.errors import CaptureError


def evaluate(options: argparse.Namespace) -> int:
    """Scores options.folder against truth/, or its surface against the file `mesh`, which is aligned to it first. Returns 0.

    Raises CaptureError where the folder was not processed, or there is neither truth nor a mesh.
    """
    from workers.pipeline.captures.score import read_mesh_file, read_whole_truth, score_capture
    from workers.pipeline.captures.score_mesh import score_against_mesh
    from workers.pipeline.captures.stored_result import read_result

    result = read_result(options.folder)
    answer: dict[str, Any] = {"ok": True, "folder": str(options.folder), "estimate": result.estimate.estimate}
    if options.mesh is not None:
        surface, alignment = score_against_mesh(result, read_mesh_file(options.mesh))
        how = f"{options.mesh} aligned to the merged mesh by ICP, which leaves {alignment.rms_mm:.2f} mm rms"
        print(f"{how}: poses cannot be scored, and errors that a rigid motion explains are not seen")
        answer |= {"aligned_by": "icp", "icp_rms_mm": alignment.rms_mm, **dict.fromkeys(("pose_mm", "pose_deg"))}
        answer |= {"depth_median_mm": None, "T_board_obj": alignment.T_board_obj.tolist()}
    else:
        truth = read_whole_truth(result.folder)
        if truth is None:
            raise CaptureError(
                "no_truth",
                f"{options.folder} has no truth/, which simulated captures have: give the object's mesh with --mesh",
            )
        score = score_capture(result.estimate, result.surface, result.views, truth)
        surface, one = score.surface, score.summary
        print(
            f"poses    median {one.pose_mm:.3f} mm, {one.pose_deg:.4f} degrees; worst {score.worst_mm:.3f} mm, {score.worst_deg:.4f} degrees"
        )
        for number, errors in score.held_out.items():
            print(
                f"view {number} made of the others: depth {errors.depth_median_mm:.2f} mm (95 %: {errors.depth_p95_mm:.2f}), "
                f"colour {errors.color_error:.1f} of 255, covers {errors.covered:.1%}, {errors.measured_share:.1%} measured"
            )
        answer |= {"aligned_by": None, "pose_mm": one.pose_mm, "pose_deg": one.pose_deg}
        answer |= {"pose_worst_mm": score.worst_mm, "pose_worst_deg": score.worst_deg}
        answer |= {"depth_median_mm": one.depth_median_mm}
        answer["held_out"] = {str(number): dataclasses.asdict(errors) for number, errors in score.held_out.items()}
    print(
        f"cloud    {surface.points} points, median {surface.cloud_median_mm:.3f} mm, 95 %: {surface.cloud_p95_mm:.3f} mm off the surface"
    )
    print(
        f"surface  median {surface.surface_median_mm:.3f} mm, 95 %: {surface.surface_p95_mm:.3f} mm off the mesh; {surface.completeness:.1%} of what was visible has a point within 3 mm ({surface.visible_share:.1%} of the whole surface was)"
    )
    answer |= dataclasses.asdict(surface)
    if options.json:
        print(json.dumps(answer))
    return 0
