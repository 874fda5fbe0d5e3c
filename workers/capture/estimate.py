"""The poses of a capture: images are read one view at a time, and what is found in them goes to the three estimates.

- Processor time by stage: what a busy machine does not change.
- Poses and surface of a capture: the same steps whether results are written into its folder or not.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from schemas.capture import CaptureEstimate, Detection, Estimates
from schemas.errors import CaptureError
from schemas.job.captures import ESTIMATES, Captures, Estimate, Estimation
from workers.capture.board.detect import detect_markers, other_dictionaries
from workers.capture.board.layout import open_dictionary
from workers.capture.folder import CaptureFolder, read_view
from workers.capture.poses.article import estimate_article
from workers.capture.poses.estimates import estimate_joint, estimate_markers
from workers.capture.poses.markers import MarkerPose
from workers.capture.poses.observation import Observation, Setup
from workers.capture.poses.patches import observe_view
from workers.capture.poses.verdict import Evidence
from workers.capture.reconstruct import Given, Merged, correct_manually, reconstruct
from workers.scene.context import Stopwatch


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
    if not any(len(found.ids) for found in detections) and not _any_given(evidence):
        raise CaptureError("markers", _no_markers(folder))
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


def _no_markers(folder: CaptureFolder) -> str:
    board = folder.board
    seen = _other_markers(folder)
    what = f"{folder.path}: no marker of {board.dictionary} was found in any of {len(folder.numbers)} views"
    return f"{what}; {seen}: correct board.json" if seen else f"{what}: check that they are sharp, and not over-exposed"


def _other_markers(folder: CaptureFolder) -> str:
    return other_dictionaries(read_view(folder, folder.numbers[len(folder.numbers) // 2]).rgb)


def _any_given(evidence: Evidence) -> bool:
    return any(seen.manual_T_board_cam is not None for seen in evidence.observations)


def _no_pose(estimate: CaptureEstimate, folder: CaptureFolder) -> str:
    first = next((f"view {view.number}: {'; '.join(view.reasons)}" for view in estimate.views if view.reasons), "")
    what = f"none of {len(estimate.views)} views has a usable pose by {estimate.estimate}; {first}"
    few = max(view.markers for view in estimate.views) < FEW_MARKERS
    seen = _other_markers(folder) if few else ""
    return f"{what}; {seen}" if seen else what


def estimate_surface(given: Given, captures: Captures, watch: Stopwatch) -> tuple[Estimates, Merged]:
    """The estimates with the user's corrections, and the merged views, whose notes the chosen estimate has too.

    Raises CaptureError where the capture cannot be used.
    """
    with watch.stage("estimate"):
        estimates = correct_manually(given, estimate_poses(given, captures.estimation))
    merged = reconstruct(given, estimates.estimate, captures.fusion, watch)
    return with_notes(estimates, merged.notes), merged


def with_notes(estimates: Estimates, notes: tuple[str, ...]) -> Estimates:
    """The estimates with further notes in the chosen one, each once."""
    chosen = estimates.estimate
    told = replace(chosen, notes=tuple(dict.fromkeys((*chosen.notes, *notes))))
    return replace(estimates, by_name={**estimates.by_name, estimates.chosen: told})
