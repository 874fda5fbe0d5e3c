"""Poses and surface of a capture from its folder: three estimates, the user's own corrections, and the merged views.

What the user wrote into the folder wins over every estimate.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from schemas.base import Pose
from schemas.capture import CapturedView, CaptureEstimate, Estimates, Reconstruction
from schemas.errors import CaptureError
from schemas.job.captures import ESTIMATES, Captures, Estimate, Estimation, Fusion
from schemas.scene.shape import Mesh
from workers.capture.board import frame_in_board, open_dictionary
from workers.capture.detect import SEVERAL, detect_markers
from workers.capture.folder import CaptureFolder, read_pose, read_view
from workers.capture.poses.causes import compare_cameras
from workers.capture.poses.estimates import estimate_article, estimate_joint, estimate_markers
from workers.capture.poses.markers import Evidence, MarkerPose, check_depth, choose_prints, fits_board, observe_view
from workers.capture.poses.observation import Observation, Setup
from workers.capture.poses.solve_board import other_board
from workers.capture.poses.standing import check_moments
from workers.capture.results import written_files
from workers.capture.surface.coverage import describe_grazing
from workers.capture.surface.fusion import fuse_views
from workers.capture.surface.object_mask import ObjectRegion, down_to_board, find_object
from workers.capture.surface.posed_view import PosedView, pose_view
from workers.geometry.frames import invert
from workers.geometry.mesh import face_areas
from workers.stopwatch import Stopwatch

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
    views: dict[int, CapturedView] = field(init=False, default_factory=dict)
    """Images that were read for their markers and are not posed yet, without masks; merging holds as many."""

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
    given = Given(folder, written_files(folder.path))
    if spec is None or not spec.calibrate:
        return given
    for _ in range(CALIBRATIONS):
        camera = estimate_joint(_observe(given, spec, processor_clock())).camera
        if camera is None:
            break
        note = f"the camera is the markers' in place of camera.json's: {compare_cameras(camera, folder.camera)}"
        given = replace(given, folder=replace(folder, camera=camera), notes=(note,))
    return given


CALIBRATIONS = 3
"""How often the markers' camera is found: corners are refined by the camera before, whose lens bends their edges."""


def corrections_of(given: Given, estimates: Estimates) -> dict[int, tuple[Pose, Pose]]:
    """(board, correction) of each view with a pose in the chosen estimate: T_board_cam = correction · board.

    `board` is the user's, else that of the markers, else the pose itself.
    """
    pairs = {}
    for view in estimates.estimate.views:
        if view.T_board_cam is not None:
            markers = estimates.by_markers.get(view.number, view)
            known = (given.pose("board", view.number), markers.T_board_cam, view.T_board_cam)
            board = next(T for T in known if T is not None)
            pairs[view.number] = board, view.T_board_cam @ invert(board)
    return pairs


@dataclass(frozen=True, eq=False)
class Merged:
    """The object of a capture: where it stands, its surface, and that surface continued down to the board, for masks."""

    region: ObjectRegion
    surface: Reconstruction
    body: Mesh
    notes: tuple[str, ...] = ()

    @property
    def hidden_share(self) -> float:
        """Share of the body's area between the board and the clearance: nobody measured it, and it is in no cloud."""
        areas = face_areas(self.body.vertices, self.body.faces)
        return float(areas[len(self.surface.faces) :].sum() / areas.sum())


def read_posed(given: Given, estimate: CaptureEstimate, number: int) -> PosedView:
    """One view with its pose in an estimate; the mask is the user's. Raises CaptureError where it has no pose or no depth."""
    view = estimate.view(number)
    if view.T_board_cam is None:
        raise CaptureError("no_pose", f"view {number} has no pose: {'; '.join(view.reasons)}")
    stored, masked = given.views.pop(number, None), given.has_mask(number)
    if stored is None or masked:
        stored = read_view(given.folder, number, masked)
    return pose_view(stored, given.folder.camera, view.T_board_cam, estimate.depth)


def read_used(given: Given, estimate: CaptureEstimate) -> Iterator[PosedView]:
    """The used views that have a depth image with anything in it, in order."""
    for view in estimate.used:
        if given.folder.file("depth", view.number) is not None:
            posed = read_posed(given, estimate, view.number)
            if posed.depth_m.any():
                yield posed
    given.views.clear()


def reconstruct(given: Given, estimate: CaptureEstimate, spec: Fusion, watch: Stopwatch) -> Merged:
    """Merge the used views. Raises CaptureError where no view has depth, or no object is found or confirmed."""
    with watch.stage("read"):
        views = list(read_used(given, estimate))
    if not views:
        raise CaptureError(
            "no_depth",
            f"none of the {len(estimate.used)} used views of {given.folder.path} has depth: depth_00000.png and so on are "
            "missing or empty, and without depth there is no surface",
        )
    left_out = [view for view in estimate.views if view.status != "used"]
    if left_out and len(views) < spec.min_views:
        raise CaptureError(
            "too_few_views",
            f"{len(left_out)} of {len(estimate.views)} views are left out, and fusion.min_views is {spec.min_views}; "
            f"view {left_out[0].number}: {'; '.join(left_out[0].reasons)}",
        )
    with watch.stage("find_object"):
        region = find_object(views, given.folder.board, spec)
    with watch.stage("fuse"):
        surface = fuse_views(views, region, spec)
    mesh = Mesh(surface.vertices, surface.faces)
    merged = Merged(region, surface, down_to_board(mesh, region))
    with watch.stage("coverage"):
        grazing = describe_grazing(mesh, {view.number: view.depth_camera for view in views})
    notes = (*region.notes, *_notes(merged, len(estimate.used) - len(views)), *([grazing] if grazing else ()))
    return replace(merged, notes=notes)


def _notes(merged: Merged, missing: int) -> Iterator[str]:
    """What the user must know of a surface; `missing` used views have no depth."""
    points, region = merged.surface.points, merged.region
    if missing:
        yield f"{missing} used views have no depth"
    if len(points) < FEW_POINTS:
        extent = 1e3 * np.ptp(points, axis=0).max() if len(points) else 0.0
        yield f"the cloud has {len(points)} points over {extent:.0f} mm: the object is small, or has little depth"
    if merged.hidden_share > MUCH_HIDDEN:
        yield (
            f"{merged.hidden_share:.0%} of the surface lies within {region.clearance_m * 1e3:.1f} mm of the board and is not "
            f"in the cloud: fusion.board_clearance_m may be as little as {region.floor_m * 1e3:.1f} mm here"
        )


def processor_clock() -> Stopwatch:
    """A stopwatch that counts this process's own time."""
    return Stopwatch(now=time.process_time)


MAKE: dict[Estimate, Callable[[Evidence], CaptureEstimate]] = {
    "markers": estimate_markers,
    "article": estimate_article,
    "joint": estimate_joint,
}


def estimate_poses(given: Given, spec: Estimation) -> Estimates:
    """The estimate that is asked for and, with `compare`, the other two, of a folder and what the user gave in it.

    Raises CaptureError where a file cannot be read or the estimate that is asked for has no usable view.
    """
    clock = processor_clock()
    if not given.notes:  # camera.json fits, and is nobody's to doubt
        spec = spec.model_copy(update={"calibrate": False})
    evidence = _observe(given, spec, clock)
    if not any(seen.markers or seen.manual_T_board_cam is not None for seen in evidence.observations):
        what = f"no marker of {given.folder.board.dictionary} was found in any of {len(given.folder.numbers)} views"
        remedy = other_board(given.folder) or "check that they are sharp, some twenty pixels wide and not over-exposed"
        raise CaptureError("markers", f"{given.folder.path}: {what}; {remedy}")
    check_moments(evidence)
    check_depth(evidence)
    by_name: dict[Estimate, CaptureEstimate] = {}
    for name in ESTIMATES if spec.compare else (spec.estimate,):
        stages = processor_clock()
        with stages.stage(name):
            made = MAKE[name](evidence)
        by_name[name] = replace(made, seconds=stages.seconds)
    corrected = _corrected(by_name[spec.estimate], evidence)
    by_name[spec.estimate] = replace(corrected, notes=(*evidence.notes, *corrected.notes))
    if not by_name[spec.estimate].used:
        raise CaptureError("poses", _no_pose(by_name[spec.estimate], evidence, given.folder))
    return Estimates(spec.estimate, by_name, clock.seconds)


def _corrected(estimate: CaptureEstimate, evidence: Evidence) -> CaptureEstimate:
    """The chosen estimate with the user's poses where correction_ files are the user's, also that of the markers."""
    manual = {seen.number: seen for seen in evidence.observations if "correction_" in seen.given_by}
    if not manual:
        return estimate
    views = []
    for view in estimate.views:
        if (seen := manual.get(view.number)) is not None:
            reasons = tuple(dict.fromkeys((*view.reasons, seen.given_by)))
            view = replace(view, status="used", T_board_cam=seen.manual_T_board_cam, covariance=None, reasons=reasons)
        views.append(view)
    note = f"{len(manual)} pose{'s' * (len(manual) > 1)} from manual corrections"
    return replace(estimate, views=tuple(views), notes=(*estimate.notes, note))


def _observe(given: Given, spec: Estimation, clock: Stopwatch) -> Evidence:
    """What is seen in each view, in order of number."""
    folder = given.folder
    setup = Setup(folder.camera, folder.board, spec)
    dictionary = open_dictionary(folder.board, folder.path)
    views = []
    for number in folder.numbers:
        with clock.stage("read"):
            view = given.views.get(number) or read_view(folder, number, False)
            given.views[number] = view
        with clock.stage("detect"):
            detection = detect_markers(view.rgb, folder.board, dictionary, folder.camera, number)
        with clock.stage("sample"):
            views.append([observe_view(seen, view.depth, setup) for seen in (detection, *detection.others)])
    chosen, notes = choose_prints(views)
    observations = [_with_given_pose(observation, pose, given) for observation, pose in chosen]
    return Evidence.of(setup, observations, [pose for _, pose in chosen], notes)


def _with_given_pose(seen: Observation, markers: MarkerPose, given: Given) -> Observation:
    """The view with the pose that others gave it: correction · board, or the board pose of a view without markers."""
    T, correction = (given.pose(prefix, seen.number) for prefix in ("board", "correction"))
    name = f"board_{seen.number:05d}.txt"
    if correction is not None:
        name = f"correction_{seen.number:05d}.txt"
        T = markers.fit.T_board_cam if T is None and markers.fit is not None else T
        if T is None:
            raise CaptureError(
                "correction", f"{given.folder.path / name} corrects nothing: the view has no markers and no board_"
            )
        T = correction @ T
    elif markers.fit is not None or T is None:
        return seen
    return replace(seen, manual_T_board_cam=T, given_by=f"the pose of {name} is kept as it was given")


def _no_pose(estimate: CaptureEstimate, evidence: Evidence, folder: CaptureFolder) -> str:
    first = next((f"view {view.number}: {'; '.join(view.reasons)}" for view in estimate.views if view.reasons), "")
    fits = any(
        seen.markers >= SEVERAL and view.fit is not None and fits_board(seen, view.fit.T_board_cam, folder.camera)
        for seen, view in zip(evidence.observations, evidence.markers, strict=True)
    )
    what = f"none of {len(estimate.views)} views has a usable pose by {estimate.estimate}"
    return f"{what}; {first if fits else other_board(folder) or first}"


def estimate_surface(given: Given, captures: Captures, watch: Stopwatch) -> tuple[Estimates, Merged]:
    """The estimates, and the merged views; the chosen estimate has the notes of all, each once.

    Raises CaptureError where the capture cannot be used.
    """
    with watch.stage("estimate"):
        estimates = estimate_poses(given, captures.estimation)
    chosen = estimates.estimate
    merged = reconstruct(given, chosen, captures.fusion, watch)
    noted = replace(chosen, notes=tuple(dict.fromkeys((*chosen.notes, *given.notes, *merged.notes))))
    return replace(estimates, by_name={**estimates.by_name, estimates.chosen: noted}), merged
