"""The files board_00000.txt and correction_00000.txt of a capture that somebody else gave, and not an earlier run of ours.

T_board_cam,corrected = correction · board. process.json has the SHA-256 of each file that processing wrote, so that a file that
somebody wrote or changed by hand is known from our own, and is respected.
"""

from dataclasses import dataclass
from pathlib import Path

from schemas.base import Pose
from workers.store.capture_folder import read_pose
from workers.store.capture_results import own_files


@dataclass(frozen=True, eq=False)
class GivenPose:
    """What others say of a view's pose, in the frame of capture.json; None where there is no file, or it is our own."""

    board: Pose | None
    correction: Pose | None


def read_given_pose(path: Path, number: int) -> GivenPose:
    """The files of one view that we did not write. Raises CaptureError for a file that is no rigid transform."""
    own = own_files(path)
    names = f"board_{number:05d}.txt", f"correction_{number:05d}.txt"
    board, correction = (None if name in own else read_pose(path / name) for name in names)
    return GivenPose(board, correction)
