"""`verso capture synthesize`: RGB, depth and mask of a processed capture from other poses."""

import argparse
import json
from pathlib import Path

from schemas.errors import CaptureError, InputError


def synthesize(options: argparse.Namespace) -> int:
    """Writes views of options.folder to options.out: from the pose in the file `pose`, or with `mirror` one for each view.

    Returns 0. Raises InputError where the pose file is missing, CaptureError where nothing was processed or nothing is seen.
    """
    from workers.pipeline.captures.stored_result import read_result
    from workers.pipeline.captures.synthesized_files import write_mirrors, write_synthesized
    from workers.store.capture_folder import read_pose

    out = options.out or Path(options.folder) / "views"
    result = read_result(options.folder)
    if options.mirror:
        made = write_mirrors(result, out)
    else:
        T_board_cam = read_pose(options.pose)
        if T_board_cam is None:
            raise InputError(f"{options.pose} is not there: it holds T_board_cam, 4 lines of 4 numbers")
        made = [write_synthesized(result, T_board_cam, out)]
    if not made:
        raise CaptureError("nothing_seen", f"no view of {options.folder} has a view from the other side")
    for one in made:
        what = f"{one['name']}: {one['measured_share']:.1%} measured, from views {', '.join(map(str, one['sources']))}"
        print(f"{what}; d_z {one['d_z_m']:.3f} m" if "d_z_m" in one else what)
    print(f"{out}: {len(made)} view{'s' * (len(made) > 1)}")
    if options.json:
        print(json.dumps({"ok": True, "out": str(out), "views": made}))
    return 0
