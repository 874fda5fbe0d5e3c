"""The estimate `joint` of a whole capture."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Pose
from schemas.capture.estimate import CaptureEstimate, ViewEstimate
from workers.capture.poses.evidence import Evidence
from workers.capture.poses.findings import noise_notes, scale_note
from workers.capture.poses.from_markers import judged
from workers.capture.poses.joint import Joint, Views, gather, solve_jointly
from workers.capture.poses.markers import AMBIGUOUS, MarkerPose, focal_lengths, is_ambiguous
from workers.capture.poses.moved import moved_after
from workers.capture.poses.observation import Observation, no_patches
from workers.capture.poses.reprojection import Fit
from workers.capture.poses.rows import POSE, SHARED
from workers.capture.poses.shared import Shared, identified
from workers.capture.poses.verdict import Judged, judge, median_reprojection
from workers.geometry.frames import transform

OFF_BOARD_MM = 10.0
"""A view whose depth lies farther off the board than this, after the correction, is flagged."""
MIN_PATCHES = 4
"""So many patches of the board tell its tilt."""
CERTAIN = 5.0
"""The object is said to have moved where it did so by this many times the sigma of a camera's place."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where a view begins: index among all views, pose, covariance by its markers, whether a rival pose remains possible."""

    index: int
    T_board_cam: Pose
    covariance: Array
    ambiguous: bool = False
    fixed: bool = False


def estimate_joint(evidence: Evidence) -> CaptureEstimate:
    """All views in one problem; a view that its markers do not fit stays as `markers` has it, and is flagged."""
    starts = [s for n in range(len(evidence.observations)) if (s := _start(n, evidence)) is not None]
    if not starts:
        views = [_outside(n, evidence, Shared()) for n in range(len(evidence.observations))]
        return CaptureEstimate("joint", tuple(views), notes=("no view has markers that fit the board",))
    problem = _problem(starts, evidence)
    joint = solve_jointly(problem, evidence.spec)
    patches, view = gather([o.object_patches for o in problem.observations])
    moved = moved_after(patches, view, joint.solution.poses, joint.solution.shared)
    if moved is None or moved[1] < CERTAIN * _sigma_m(joint, len(starts)):
        return _result(starts, problem, joint, evidence)
    still = tuple(dataclasses.replace(o, object_patches=no_patches()) for o in problem.observations)
    problem = dataclasses.replace(problem, observations=still)
    return _mark_moved(_result(starts, problem, solve_jointly(problem, evidence.spec), evidence), starts, *moved)


def _sigma_m(joint: Joint, views: int) -> float:
    """Median over the views of the sigma of a camera's place, metres, in the direction that is known worst."""
    blocks = [joint.covariance[POSE * n : POSE * n + 3, POSE * n : POSE * n + 3] for n in range(views)]
    return float(np.sqrt(np.median([max(0.0, np.linalg.eigvalsh(block)[-1]) for block in blocks])))


def _problem(starts: list[Start], evidence: Evidence) -> Views:
    return Views(
        tuple(evidence.observations[start.index] for start in starts),
        np.stack([start.T_board_cam for start in starts]),
        np.stack([start.covariance for start in starts]),
        np.array([start.fixed for start in starts]),
        focal_lengths(evidence.camera),
        evidence.corner_px,
    )


def _start(index: int, evidence: Evidence) -> Start | None:
    """None for a view without a pose, or whose corners its pose does not explain."""
    observation, found = evidence.observations[index], evidence.markers[index]
    if observation.manual_T_board_cam is not None:
        return Start(index, observation.manual_T_board_cam, np.zeros((POSE, POSE)), fixed=True)
    if found.fit is None:
        return None
    off = median_reprojection(observation, found.fit.T_board_cam, evidence.camera, 1.0)
    if off is None or off > evidence.spec.max_reprojection_px:
        return None
    fit, ambiguous = _told_apart(observation, found, evidence)
    covariance = evidence.corner_px**2 * np.linalg.pinv(fit.information, hermitian=True)
    return Start(index, fit.T_board_cam, np.asarray(covariance, np.float64), ambiguous)


def _told_apart(observation: Observation, found: MarkerPose, evidence: Evidence) -> tuple[Fit, bool]:
    """(the fit that corners and the tilt of the board in depth together prefer, whether they leave it open)."""
    fit, rival = found.fit, found.rival
    assert fit is not None
    if rival is None or not is_ambiguous(found, evidence.corner_px):
        return fit, False
    scores = [
        one.cost / evidence.corner_px**2 + _tilt_misfit(observation, one.T_board_cam, evidence) for one in (fit, rival)
    ]
    return (rival if scores[1] < scores[0] else fit), abs(scores[0] - scores[1]) < AMBIGUOUS


def _tilt_misfit(observation: Observation, T: Pose, evidence: Evidence) -> float:
    """Misfit, in sigma squared, of the board's depth against the plane of the pose, its height left open."""
    patches = observation.board_patches
    if len(patches) < MIN_PATCHES:
        return 0.0
    height = transform(T, patches.ray_z)[:, 2]
    sigma = evidence.spec.depth_sigma_m * patches.ray_z[:, 2] ** 2
    return float((np.minimum(np.abs(height - np.median(height)) / sigma, 5.0) ** 2).sum())


def _outside(index: int, evidence: Evidence, shared: Shared) -> ViewEstimate:
    """A view that is no part of the problem."""
    observation, found = evidence.observations[index], evidence.markers[index]
    return judge(observation, judged(found, evidence.corner_px), evidence, shared.correction(()))


def _result(starts: list[Start], problem: Views, joint: Joint, evidence: Evidence) -> CaptureEstimate:
    solution = joint.solution
    shared, sigma = solution.shared, np.sqrt(np.maximum(np.diag(joint.covariance)[-SHARED:], 0.0))
    correction = shared.correction(identified(sigma, joint.prior))
    views = {}
    for place, start in enumerate(starts):
        block = slice(POSE * place, POSE * (place + 1))
        pose = Judged(
            solution.poses[place],
            joint.covariance[block, block],
            ("ambiguous: a pose of another tilt fits markers and depth as well",) if start.ambiguous else (),
            (evidence.observations[start.index].given_by,) if start.fixed else (),
        )
        view = judge(evidence.observations[start.index], pose, evidence, correction, shared.print_scale)
        views[start.index] = _flag_depth(view)
    for index in set(range(len(evidence.observations))) - set(views):
        views[index] = _outside(index, evidence, shared)
    notes = [scale_note(joint, evidence.board, evidence.spec), *noise_notes(joint, problem)]
    return CaptureEstimate(
        "joint",
        tuple(views[index] for index in sorted(views)),
        correction,
        shared.print_scale,
        solution.iterations,
        solution.converged,
        tuple(note for note in notes if note),
    )


def _flag_depth(view: ViewEstimate) -> ViewEstimate:
    if view.depth_mm is None or view.depth_mm <= OFF_BOARD_MM or math.isnan(view.depth_mm):
        return view
    reason = f"depth lies {view.depth_mm:.1f} mm off the board, after the correction"
    return dataclasses.replace(view, status="flagged", reasons=(*view.reasons, reason))


def _mark_moved(estimate: CaptureEstimate, starts: list[Start], last: int, apart_m: float) -> CaptureEstimate:
    """The smaller part of the views is flagged: the cloud must not hold the object twice."""
    number = estimate.views[starts[last].index].number
    before = [view for view in estimate.views if view.number <= number]
    late = 2 * len(before) >= len(estimate.views)
    reason = f"the object moved on the board after view {number}, by about {1000 * apart_m:.0f} mm"
    views = [
        dataclasses.replace(view, status="flagged", reasons=(*view.reasons, reason))
        if view.status != "refused" and (view.number > number) == late
        else view
        for view in estimate.views
    ]
    return dataclasses.replace(estimate, views=tuple(views), notes=(reason, *estimate.notes))
