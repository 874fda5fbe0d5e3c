"""The files board_00000.txt and correction_00000.txt of a capture: those that were given, and those that we write.

T_board_cam,corrected = correction · board. Beside what we write stands poses.json with the SHA-256 of each file, so that a
file that somebody wrote or changed by hand is known from our own of an earlier run, and is respected.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from schemas.base import Pose
from schemas.errors import CaptureError
from workers.store.capture_folder import read_pose, write_pose

OWN_FILE = "poses.json"


@dataclass(frozen=True, eq=False)
class GivenPose:
    """What others say of a view's pose, in the frame of capture.json; None where there is no file, or it is our own."""

    board: Pose | None
    correction: Pose | None


def read_given_pose(path: Path, number: int) -> GivenPose:
    """The files of one view that we did not write. Raises CaptureError for a file that is no rigid transform."""
    own = _own_digests(path)
    board, correction = (
        None if _is_own(path / name, own) else read_pose(path / name) for name in (_board(number), _correction(number))
    )
    return GivenPose(board, correction)


def write_pose_files(path: Path, board: Mapping[int, Pose], correction: Mapping[int, Pose]) -> None:
    """Writes both files of each view by number; a file that was given is left as it is."""
    own = _own_digests(path)
    poses = {_board(number): T for number, T in board.items()}
    poses |= {_correction(number): T for number, T in correction.items()}
    for name, T in sorted(poses.items()):
        file = path / name
        if file.exists() and not _is_own(file, own):
            own.pop(name, None)
            continue
        write_pose(file, T)
        own[name] = _digest(file)
    text = json.dumps(own, indent=1, sort_keys=True)
    (path / OWN_FILE).write_text(text + "\n", encoding="utf-8")


def _board(number: int) -> str:
    return f"board_{number:05d}.txt"


def _correction(number: int) -> str:
    return f"correction_{number:05d}.txt"


def _own_digests(path: Path) -> dict[str, str]:
    """SHA-256 by file name of the files that we wrote."""
    try:
        own = json.loads((path / OWN_FILE).read_bytes())
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise CaptureError("unreadable", f"{path / OWN_FILE} is no JSON: take it out ({error})") from error
    if not isinstance(own, dict) or not all(isinstance(value, str) for value in own.values()):
        raise CaptureError("unreadable", f"{path / OWN_FILE} is no table of file names: take it out")
    return own


def _is_own(file: Path, own: Mapping[str, str]) -> bool:
    return file.name in own and file.exists() and _digest(file) == own[file.name]


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
