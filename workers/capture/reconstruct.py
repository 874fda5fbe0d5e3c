"""The surface of a capture's object from its folder and the estimated poses, and the user's own corrections of poses.

- Manual corrections of a capture's poses: what the user wrote into the folder wins over every estimate.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.capture import CaptureEstimate, Estimates, Reconstruction, ViewEstimate
from schemas.errors import CaptureError
from schemas.job.captures import Fusion
from schemas.scene.shape import Mesh
from workers.capture.board.layout import correction_in_board, in_board
from workers.capture.folder import CaptureFolder, read_pose, read_view
from workers.capture.results import own_files
from workers.capture.surface.fusion import fuse_views
from workers.capture.surface.object_mask import ObjectRegion, down_to_board, find_object
from workers.capture.surface.posed_view import PosedView, pose_view
from workers.geometry.frames import invert
from workers.scene.context import Stopwatch

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


@dataclass(frozen=True, eq=False)
class Merged:
    """The object of a capture: where it stands, its surface, and that surface continued down to the board, for masks."""

    region: ObjectRegion
    surface: Reconstruction
    body: Mesh
    notes: tuple[str, ...]


def read_posed(given: Given, estimate: CaptureEstimate, number: int) -> PosedView:
    """One view with its pose in an estimate; the mask is the user's. Raises CaptureError where it has no pose or no depth."""
    own = next(view for view in estimate.views if view.number == number)
    if own.T_board_cam is None:
        raise CaptureError("no_pose", f"view {number} has no pose: {'; '.join(own.reasons)}")
    stored = read_view(given.folder, number)
    if not given.has_mask(number):
        stored = replace(stored, mask=None)
    return pose_view(stored, given.folder.camera, own.T_board_cam, estimate.depth)


def read_used(given: Given, estimate: CaptureEstimate) -> Iterator[PosedView]:
    """The used views that have a depth image with anything in it, in order."""
    for view in estimate.used:
        if (given.folder.path / f"depth_{view.number:05d}.png").exists():
            posed = read_posed(given, estimate, view.number)
            if posed.depth_m.any():
                yield posed


def reconstruct(given: Given, estimate: CaptureEstimate, spec: Fusion, watch: Stopwatch | None = None) -> Merged:
    """Merge the used views. Raises CaptureError where no view has depth, or no object is found or confirmed."""
    watch = watch or Stopwatch()
    with watch.stage("read"):
        views = list(read_used(given, estimate))
    if not views:
        raise CaptureError(
            "no_depth",
            f"none of the {len(estimate.used)} used views of {given.folder.path} has depth: depth_00000.png and so on are "
            "missing or empty, and without depth there is no surface",
        )
    with watch.stage("find_object"):
        region = find_object(views, given.folder.board, spec)
    with watch.stage("fuse"):
        surface = fuse_views(views, region, spec)
    missing = len(estimate.used) - len(views)
    notes = (*region.notes, *((f"{missing} used views have no depth",) if missing else ()), *_holes(surface))
    body = down_to_board(Mesh(surface.vertices, surface.faces), region)
    return Merged(region, surface, body, notes)


def _holes(surface: Reconstruction) -> tuple[str, ...]:
    """What is to be said of a surface with few points."""
    if len(surface.points) >= 500:
        return ()
    extent = 1e3 * np.ptp(surface.points, axis=0).max(initial=0.0) if len(surface.points) else 0.0
    return (
        f"the cloud has {len(surface.points)} points over {extent:.0f} mm: the object is small, or has little depth",
    )
