"""`verso capture process`: poses, masks, cloud and mesh of a capture, written into its folder."""

import argparse
import json

import numpy as np

from schemas.capture.estimate import CaptureEstimate
from services.capture.settings import capture_settings


def process(options: argparse.Namespace) -> int:
    """Processes options.folder; reads `estimate`, `changes` (--set) and `json`. Returns 0. Raises JobError, CaptureError."""
    captures = capture_settings(options.changes, {"captures.estimation.estimate": options.estimate})
    from workers.pipeline.captures.process import process_folder

    done = process_folder(options.folder, captures)
    for estimate in done.estimates.by_name.values():
        chosen = " (chosen)" * (estimate.estimate == done.estimates.chosen)
        print(f"{estimate.estimate:8} {_describe(estimate)}{chosen}")
    for view in done.estimates.estimate.views:
        if view.status != "used":
            print(f"view {view.number} {view.status}: {'; '.join(view.reasons)}")
    for note in done.notes:
        print(f"note: {note}")
    for name in done.users:
        print(f"kept: {name}, which processing did not write")
    surface, slowest = done.merged.surface, sorted(done.seconds.items(), key=lambda item: -item[1])
    counts = f"{len(surface.points)} points, {len(surface.faces)} faces"
    print(f"{options.folder}: {counts}, {done.seconds['total']:.1f} s of processor time")
    print("  " + ", ".join(f"{name} {s:.1f} s" for name, s in slowest if name != "total"))
    if options.json:
        final = done.estimates.estimate
        answer = {
            "ok": True,
            "folder": str(options.folder),
            "estimate": final.estimate,
            "views": len(final.views),
            "used": len(final.used),
            "points": len(surface.points),
            "faces": len(surface.faces),
            "notes": list(done.notes),
            "kept": list(done.users),
            "seconds": dict(done.seconds),
        }
        print(json.dumps(answer))
    return 0


def _describe(estimate: CaptureEstimate) -> str:
    pixels = [view.reprojection_px for view in estimate.used if view.reprojection_px is not None]
    depth = [view.depth_mm for view in estimate.used if view.depth_mm is not None]
    words = [f"{len(estimate.used)} of {len(estimate.views)} views"]
    words += [f"corners {np.median(pixels):.2f} px"] if pixels else []
    words += [f"depth off the board {np.median(depth):.1f} mm"] if depth else []
    correction = estimate.depth
    words += (
        [f"depth offset {1e3 * correction.offset_m:+.1f} mm, scale {correction.scale:.4f}"]
        if correction.identified
        else []
    )
    words += [f"print scale {estimate.print_scale:.4f}"] if estimate.print_scale != 1.0 else []
    return ", ".join(words)
