"""Manual corrections of a capture's poses: what the user wrote into the folder wins over every estimate."""

from dataclasses import dataclass, replace

from schemas.base import Pose, frozen_array
from schemas.capture.estimate import CaptureEstimate, Estimates, ViewEstimate
from schemas.errors import CaptureError
from workers.capture.board.frames import correction_in_board, in_board
from workers.geometry.frames import invert
from workers.store.capture_folder import CaptureFolder, read_pose
from workers.store.capture_results import own_files

MANUAL = "its pose is that of the manual correction"


@dataclass(frozen=True)
class Given:
    """The files of a folder that the user gave: which masks and poses are not ours."""

    folder: CaptureFolder
    ours: frozenset[str]

    def pose(self, prefix: str, number: int) -> Pose | None:
        """[4, 4] of the user's file `prefix`_00000.txt in our board frame, None where there is none or it is ours.

        Raises CaptureError for a file that is no rigid transform.
        """
        name = f"{prefix}_{number:05d}.txt"
        if name in self.ours or (T := read_pose(self.folder.path / name)) is None:
            return None
        convert = in_board if prefix == "board" else correction_in_board
        return convert(T, self.folder.board, self.folder.about.frame)

    def has_mask(self, number: int) -> bool:
        """Whether the user gave a mask of this view."""
        name = f"mask_{number:05d}.png"
        return name not in self.ours and (self.folder.path / name).exists()


def given_files(folder: CaptureFolder) -> Given:
    """What the user gave. Raises CaptureError where process.json cannot be read."""
    return Given(folder, own_files(folder.path))


def board_poses(given: Given, estimates: Estimates) -> dict[int, Pose]:
    """T_board_cam of `board_` files by view: the user's, else that of the markers, else of the chosen estimate."""
    views = (*estimates.estimate.views, *estimates.by_markers.values())
    poses: dict[int, Pose] = {view.number: view.T_board_cam for view in views if view.T_board_cam is not None}
    for number in given.folder.numbers:
        if (T := given.pose("board", number)) is not None:
            poses[number] = T
    return poses


def correct_manually(given: Given, estimates: Estimates) -> Estimates:
    """The estimates, whose chosen one has the user's poses where correction_ files are the user's: correction · board.

    Raises CaptureError for a correction of a view that has no pose to be corrected.
    """
    corrections = {n: T for n in given.folder.numbers if (T := given.pose("correction", n)) is not None}
    if not corrections:
        return estimates
    boards = board_poses(given, estimates)
    if lost := sorted(set(corrections) - set(boards)):
        name = f"correction_{lost[0]:05d}.txt"
        raise CaptureError(
            "correction", f"{name} corrects a pose that is not known: write board_{lost[0]:05d}.txt, or delete {name}"
        )
    chosen = estimates.estimate
    views = tuple(
        _moved(view, corrections[view.number] @ boards[view.number]) if view.number in corrections else view
        for view in chosen.views
    )
    note = f"{len(corrections)} pose{'s' * (len(corrections) > 1)} from manual corrections"
    made: CaptureEstimate = replace(chosen, views=views, notes=(*chosen.notes, note))
    return replace(estimates, by_name={**estimates.by_name, estimates.chosen: made})


def _moved(view: ViewEstimate, T: Pose) -> ViewEstimate:
    return replace(view, status="used", T_board_cam=frozen_array(T), covariance=None, reasons=(*view.reasons, MANUAL))


def corrections_of(given: Given, estimates: Estimates) -> dict[int, tuple[Pose, Pose]]:
    """(board, correction) of each view with a pose in the chosen estimate: T_board_cam = correction · board."""
    boards = board_poses(given, estimates)
    return {
        view.number: (boards[view.number], view.T_board_cam @ invert(boards[view.number]))
        for view in estimates.estimate.views
        if view.T_board_cam is not None
    }
