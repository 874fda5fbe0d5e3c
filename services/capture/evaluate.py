"""`verso capture evaluate`: the errors of a processed capture against its truth or a given mesh."""

import argparse
import dataclasses
import json
from typing import TYPE_CHECKING, Any

from schemas.errors import CaptureError

if TYPE_CHECKING:
    from workers.capture.evaluate import SurfaceErrors
    from workers.pipeline.captures.stored_result import StoredResult


def evaluate(options: argparse.Namespace) -> int:
    """Scores options.folder against truth/, or its surface against the file `mesh`, which is aligned to it first. Returns 0.

    Raises CaptureError where the folder was not processed, or there is neither truth nor a mesh.
    """
    from workers.pipeline.captures.stored_result import read_result

    result = read_result(options.folder)
    surface, answer = _against_truth(result) if options.mesh is None else _against_mesh(result, options)
    _print_surface(surface)
    if options.json:
        known = {"ok": True, "folder": str(options.folder), "estimate": result.estimate.estimate}
        print(json.dumps({**known, **answer, **dataclasses.asdict(surface)}))
    return 0


def _against_truth(result: "StoredResult") -> tuple["SurfaceErrors", dict[str, Any]]:
    from workers.pipeline.captures.score import read_whole_truth, score_capture, score_measured

    truth = read_whole_truth(result.folder)
    if truth is None:
        raise CaptureError(
            "no_truth",
            f"{result.folder.path} has no truth/, which simulated captures have: give the object's mesh with --mesh",
        )
    score = score_capture(result.estimate, result.surface, result.views, truth)
    one = score.summary
    print(f"poses    median {one.pose_mm:.3f} mm, {one.pose_deg:.4f} degrees")
    print(f"         worst {score.worst_mm:.3f} mm, {score.worst_deg:.4f} degrees")
    for number, errors in score.held_out.items():
        print(
            f"view {number} made of the others: depth {errors.depth_median_mm:.2f} mm (95 %: {errors.depth_p95_mm:.2f}), "
            f"colour {errors.color_error:.1f} of 255, covers {errors.covered:.1%}, {errors.measured_share:.1%} measured"
        )
    depth = score_measured(result.surface, result.views, truth)
    print(
        f"depth    of {depth.measured_of_visible:.1%} of what was visible in any view; {depth.completeness_of_measured:.1%} of "
        "that has a point within 3 mm"
    )
    answer = {
        **dataclasses.asdict(depth),
        "aligned_by": None,
        "pose_mm": one.pose_mm,
        "pose_deg": one.pose_deg,
        "pose_worst_mm": score.worst_mm,
        "pose_worst_deg": score.worst_deg,
        "depth_median_mm": one.depth_median_mm,
        "held_out": {str(number): dataclasses.asdict(errors) for number, errors in score.held_out.items()},
    }
    return score.surface, answer


def _against_mesh(result: "StoredResult", options: argparse.Namespace) -> tuple["SurfaceErrors", dict[str, Any]]:
    from workers.pipeline.captures.score import read_mesh_file
    from workers.pipeline.captures.score_mesh import score_against_mesh

    surface, alignment = score_against_mesh(result, read_mesh_file(options.mesh))
    print(f"{options.mesh} was aligned to the cloud by ICP, which leaves {alignment.rms_mm:.2f} mm rms:")
    print("poses are not scored, and errors that a rigid motion explains are not seen")
    answer = {
        **dict.fromkeys(("pose_mm", "pose_deg", "depth_median_mm")),
        "aligned_by": "icp",
        "icp_rms_mm": alignment.rms_mm,
        "T_board_obj": alignment.T_board_obj.tolist(),
    }
    return surface, answer


def _print_surface(errors: "SurfaceErrors") -> None:
    print(
        f"cloud    {errors.points} points; median {errors.cloud_median_mm:.3f} mm, 95 %: {errors.cloud_p95_mm:.3f} mm off "
        "the surface"
    )
    print(f"surface  median {errors.surface_median_mm:.3f} mm, 95 %: {errors.surface_p95_mm:.3f} mm off the mesh")
    print(
        f"         {errors.completeness:.1%} of what was visible has a point within 3 mm; visible was {errors.visible_share:.1%}"
    )
