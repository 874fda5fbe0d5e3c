"""Poses and surface of a capture from its folder: three estimates, the user's own corrections, and the merged views.

What the user wrote into the folder wins over every estimate.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.capture import CaptureEstimate, Detection, Estimates, Reconstruction, ViewEstimate
from schemas.errors import CaptureError
from schemas.job.captures import ESTIMATES, Captures, Estimate, Estimation, Fusion
from schemas.scene.shape import Mesh
from workers.capture.board import frame_in_board, open_dictionary
from workers.capture.detect import detect_markers, other_dictionaries
from workers.capture.folder import CaptureFolder, read_pose, read_view
from workers.capture.poses.corners import compare_cameras
from workers.capture.poses.estimates import estimate_article, estimate_joint, estimate_markers
from workers.capture.poses.markers import Evidence, MarkerPose, check_depth, observe_view
from workers.capture.poses.observation import Observation, Setup
from workers.capture.results import own_files
from workers.capture.surface.fusion import fuse_views
from workers.capture.surface.object_mask import ObjectRegion, down_to_board, find_object
from workers.capture.surface.posed_view import PosedView, pose_view
from workers.geometry.frames import invert
from workers.geometry.mesh import face_areas
from workers.scene.context import Stopwatch

MANUAL = "its pose is that of the manual correction"
FEW_POINTS = 500
"""The user is told of a cloud with fewer."""

MUCH_HIDDEN = 0.05
"""The user is told where more of the surface lies below the clearance: as much as a good capture may miss."""


@dataclass(frozen=True)
class Given:
    """The files of a folder that the user gave: which masks and poses are not ours."""

    folder: CaptureFolder
    ours: frozenset[str]
    notes: tuple[str, ...] = ()
    """What was changed before anything was estimated."""

    def pose(self, prefix: str, number: int) -> Pose | None:
        """[4, 4] of the user's file `prefix`_00000.txt in our board frame, None where there is none or it is ours.

        Raises CaptureError for a file that is no rigid transform.
        """
        name = f"{prefix}_{number:05d}.txt"
        if name in self.ours or (T := read_pose(self.folder.path / name)) is None:
            return None
        T_board_frame = frame_in_board(self.folder.board, self.folder.about.frame)
        T = T_board_frame @ T
        return T if prefix == "board" else T @ invert(T_board_frame)

    def has_mask(self, number: int) -> bool:
        """Whether the user gave a mask of this view."""
        name = f"mask_{number:05d}.png"
        return name not in self.ours and (self.folder.path / name).exists()


def given_files(folder: CaptureFolder, spec: Estimation | None = None) -> Given:
    """What the user gave; with `calibrate` the camera is the markers' where camera.json does not fit them.

    Raises CaptureError where process.json or an image cannot be read.
    """
    given = Given(folder, own_files(folder.path))
    if spec is None or not spec.calibrate:
        return given
    camera = estimate_joint(_observe(given, spec, ProcessorClock())[1]).camera
    if camera is None:
        return given
    note = f"the camera is the markers' in place of camera.json's: {compare_cameras(camera, folder.camera)}"
    return replace(given, folder=replace(folder, camera=camera), notes=(note,))


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

    def corrected(view: ViewEstimate) -> ViewEstimate:
        if view.number not in corrections:
            return view
        T = frozen_array(corrections[view.number] @ boards[view.number])
        return replace(view, status="used", T_board_cam=T, covariance=None, reasons=(*view.reasons, MANUAL))

    views = tuple(corrected(view) for view in chosen.views)
    note = f"{len(corrections)} pose{'s' * (len(corrections) > 1)} from manual corrections"
    made: CaptureEstimate = replace(chosen, views=views, notes=(*chosen.notes, note))
    return replace(estimates, by_name={**estimates.by_name, estimates.chosen: made})


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

    @property
    def hidden_share(self) -> float:
        """Share of the body's area between the board and the clearance: nobody measured it, and it is in no cloud."""
        areas = face_areas(self.body.vertices, self.body.faces)
        return float(areas[len(self.surface.faces) :].sum() / areas.sum())


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
        if given.folder.file("depth", view.number) is not None:
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
    notes, missing, points = [*region.notes], len(estimate.used) - len(views), surface.points
    if missing:
        notes.append(f"{missing} used views have no depth")
    if len(points) < FEW_POINTS:
        extent = 1e3 * np.ptp(points, axis=0).max(initial=0.0) if len(points) else 0.0
        notes.append(
            f"the cloud has {len(points)} points over {extent:.0f} mm: the object is small, or has little depth"
        )
    body = down_to_board(Mesh(surface.vertices, surface.faces), region)
    merged = Merged(region, surface, body, tuple(notes))
    if merged.hidden_share <= MUCH_HIDDEN:
        return merged
    told = (
        f"{merged.hidden_share:.0%} of the surface lies within {region.clearance_m * 1e3:.1f} mm of the board and is not in the "
        f"cloud: fusion.board_clearance_m may be as little as {region.floor_m * 1e3:.1f} mm here"
    )
    return replace(merged, notes=(*notes, told))


@dataclass(frozen=True)
class ProcessorClock(Stopwatch):
    """A stopwatch that counts this process's own time, all its threads together."""

    @contextmanager
    def _time(self, *entries: tuple[dict[str, float], str | None]) -> Iterator[None]:
        begun = time.process_time()
        try:
            yield
        finally:
            elapsed = time.process_time() - begun
            for clock, name in entries:
                if name is not None:
                    clock[name] = clock.get(name, 0.0) + elapsed


FEW_MARKERS = 4
"""Where no view has as many, other markers than the board's may have been found by chance."""
MAKE: dict[Estimate, Callable[[Evidence], CaptureEstimate]] = {
    "markers": estimate_markers,
    "article": estimate_article,
    "joint": estimate_joint,
}


def estimate_poses(given: Given, spec: Estimation) -> Estimates:
    """The estimate that is asked for and, with `compare`, the other two, of a folder and what the user gave in it.

    Raises CaptureError where a file cannot be read or the estimate that is asked for has no usable view.
    """
    folder, clock = given.folder, ProcessorClock()
    detections, evidence = _observe(given, spec, clock)
    given_poses = any(seen.manual_T_board_cam is not None for seen in evidence.observations)
    if not given_poses and not any(len(found.ids) for found in detections):
        raise CaptureError("markers", _no_markers(folder))
    check_depth(evidence)
    by_name: dict[Estimate, CaptureEstimate] = {}
    for name in ESTIMATES if spec.compare else (spec.estimate,):
        own = ProcessorClock()
        with own.stage(name):
            made = MAKE[name](evidence)
        by_name[name] = dataclasses.replace(made, seconds=own.seconds)
    estimates = Estimates(spec.estimate, by_name, tuple(detections), clock.seconds)
    if not estimates.estimate.used:
        raise CaptureError("poses", _no_pose(estimates.estimate, folder))
    return estimates


def _observe(given: Given, spec: Estimation, clock: ProcessorClock) -> tuple[list[Detection], Evidence]:
    """What is found in each view, in order of number; no two views' images are held at once."""
    folder = given.folder
    setup = Setup(folder.camera, folder.board, spec)
    dictionary = open_dictionary(folder.board, folder.path)
    detections, observations, poses = [], [], []
    for number in folder.numbers:
        with clock.stage("read"):
            view = read_view(folder, number)
        with clock.stage("detect"):
            detection = detect_markers(view.rgb, folder.board, dictionary, number)
        with clock.stage("sample"):
            observation, found = observe_view(detection, view.depth, setup)
        observation = _with_given_pose(observation, found, given)
        detections.append(detection)
        observations.append(observation)
        poses.append(found)
    return detections, Evidence.of(setup, observations, poses)


def _with_given_pose(seen: Observation, found: MarkerPose, given: Given) -> Observation:
    """The view with the pose that others gave it: correction · board, or the board pose of a view without markers."""
    T, correction = (given.pose(prefix, seen.number) for prefix in ("board", "correction"))
    name = f"board_{seen.number:05d}.txt"
    if correction is not None:
        name = f"correction_{seen.number:05d}.txt"
        T = found.fit.T_board_cam if T is None and found.fit is not None else T
        if T is None:
            raise CaptureError(
                "correction", f"{given.folder.path / name} corrects nothing: the view has no markers and no board_"
            )
        T = correction @ T
    elif found.fit is not None or T is None:
        return seen
    return dataclasses.replace(seen, manual_T_board_cam=T, given_by=f"the pose of {name} is kept as it was given")


def _other_markers(folder: CaptureFolder) -> str:
    return other_dictionaries(read_view(folder, folder.numbers[len(folder.numbers) // 2]).rgb)


def _no_markers(folder: CaptureFolder) -> str:
    what = f"{folder.path}: no marker of {folder.board.dictionary} was found in any of {len(folder.numbers)} views"
    seen = _other_markers(folder)
    return f"{what}; {seen}: correct board.json" if seen else f"{what}: check that they are sharp, and not over-exposed"


def _no_pose(estimate: CaptureEstimate, folder: CaptureFolder) -> str:
    first = next((f"view {view.number}: {'; '.join(view.reasons)}" for view in estimate.views if view.reasons), "")
    few = max(view.markers for view in estimate.views) < FEW_MARKERS
    seen = _other_markers(folder) if few else ""
    what = f"none of {len(estimate.views)} views has a usable pose by {estimate.estimate}; {first}"
    return f"{what}; {seen}" if seen else what


def estimate_surface(given: Given, captures: Captures, watch: Stopwatch) -> tuple[Estimates, Merged]:
    """The estimates with the user's corrections, and the merged views, whose notes the chosen estimate has too.

    Raises CaptureError where the capture cannot be used.
    """
    with watch.stage("estimate"):
        estimates = correct_manually(given, estimate_poses(given, captures.estimation))
    merged = reconstruct(given, estimates.estimate, captures.fusion, watch)
    return with_notes(estimates, (*given.notes, *merged.notes)), merged


def with_notes(estimates: Estimates, notes: tuple[str, ...]) -> Estimates:
    """The estimates with further notes in the chosen one, each once."""
    chosen = estimates.estimate
    told = replace(chosen, notes=tuple(dict.fromkeys((*chosen.notes, *notes))))
    return replace(estimates, by_name={**estimates.by_name, estimates.chosen: told})
