"""The three estimates of a whole capture: by markers, by the article's method, and by all views in one problem."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, CaptureEstimate, DepthCorrection, ViewEstimate
from schemas.job.captures import Board, Estimation
from workers.capture.poses.joint import MIN_COSINE, CameraFit, Joint, Views, fit_camera, gather, placed, solve_jointly
from workers.capture.poses.markers import (
    AMBIGUOUS,
    Evidence,
    Fit,
    Judged,
    MarkerPose,
    cross_matrix,
    exponential,
    is_ambiguous,
    judge,
    median_reprojection,
    moved,
)
from workers.capture.poses.observation import Corners, Observation, Patches, no_patches
from workers.capture.poses.terms import NAMES, POSE, PRINT_SCALE, SHARED, BoardTerm, ObjectTerm, Shared, identified
from workers.geometry.camera import spread_evenly
from workers.geometry.frames import transform

MIN_CORNERS = 4
ARTICLE_SCALE_M = 0.02
"""Distance from which on a corner's loss grows linearly and no longer with the square: depth at an edge may be the floor's."""


@dataclass(frozen=True, eq=False)
class _Fitted:
    T_board_cam: Pose
    covariance: Array
    iterations: int
    converged: bool


def estimate_article(evidence: Evidence) -> CaptureEstimate:
    """Each view by itself, begun at its pose from markers."""
    views: list[ViewEstimate] = []
    most, converged = 0, True
    for observation, found in zip(evidence.observations, evidence.markers, strict=True):
        pose = Judged(None, faults=(found.reason,))
        if observation.manual_T_board_cam is not None:
            pose = Judged(observation.manual_T_board_cam, remarks=(observation.given_by,))
        elif found.fit is not None:
            fitted = fit_article(observation.corners, found.fit.T_board_cam, evidence.spec.max_iterations)
            lifted = int((observation.corners.depth_m > 0).sum())
            pose = Judged(None, faults=(f"{lifted} corners have depth, and {MIN_CORNERS} are needed",))
            if fitted is not None:
                pose = Judged(fitted.T_board_cam, fitted.covariance, by_corners=False)
                most, converged = max(most, fitted.iterations), converged and fitted.converged
        views.append(judge(observation, pose, evidence, DepthCorrection()))
    return CaptureEstimate("article", tuple(views), iterations=most, converged=converged)


def fit_article(corners: Corners, start: Pose, max_iterations: int = 100) -> _Fitted | None:
    """The pose of least robust distance between lifted corners and their places on the board; None without enough depth."""
    lifted = corners.depth_m > 0
    if lifted.sum() < MIN_CORNERS:
        return None
    z = corners.depth_m[lifted]
    points = np.column_stack([corners.rays[lifted] * z[:, None], z])
    board = corners.board[lifted]
    result = minimize(
        lambda motion: loss(motion, start, points, board),
        np.zeros(6),
        jac=True,
        method="BFGS",
        options={"maxiter": max_iterations, "gtol": 1e-7},
    )
    T = moved(start, result.x)
    # A line search that finds no further decrease has met the limit of float64: the gradient tells whether it is the end.
    converged = bool(result.success or np.abs(result.jac).max() < 1e-4)
    return _Fitted(T, _covariance(T, points, board), int(result.nit), converged)


def loss(motion: Array, start: Pose, points: Array, board: Array) -> tuple[float, Array]:
    """(mean of 2 (sqrt(1 + (d / scale)^2) - 1), its gradient [6]) after a motion (metres, radians) of `start`.

    d is the distance of a lifted corner (points [K, 3], camera axes) from its place (board [K, 3]). The gradient by the
    rotation vector goes through the right Jacobian of SO(3): exp(w + dw) = exp(w) exp(J(w) dw).
    """
    rotation = exponential(motion[3:])
    turned = points @ rotation.T
    R = start[:3, :3]
    difference = (turned + motion[:3]) @ R.T + start[:3, 3] - board
    squares = (difference**2).sum(axis=1) / ARTICLE_SCALE_M**2
    root = np.sqrt(1.0 + squares)
    pull = (
        (2.0 / ARTICLE_SCALE_M**2) * difference / root[:, None] / len(points)
    )  # derivative by the moved points, board axes
    in_camera = pull @ R
    by_turn = np.cross(points, in_camera @ rotation).sum(axis=0)
    gradient = np.concatenate([in_camera.sum(axis=0), right_jacobian(motion[3:]).T @ by_turn])
    return float((2.0 * (root - 1.0)).mean()), gradient


def right_jacobian(rotation_vector: Array) -> Array:
    """[3, 3]: J(w) of exp(w + dw) = exp(w) exp(J(w) dw) to first order (Chirikjian 2012, equation 10.86)."""
    angle = float(np.linalg.norm(rotation_vector))
    W = cross_matrix(rotation_vector)
    if angle < 1e-5:
        return np.eye(3) - 0.5 * W + W @ W / 6.0
    return np.eye(3) - (1 - math.cos(angle)) / angle**2 * W + (angle - math.sin(angle)) / angle**3 * (W @ W)


def _covariance(T: Pose, points: Array, board: Array) -> Array:
    """[6, 6] by the spread of the distances themselves; a bias that all corners share does not show in it."""
    difference = points @ T[:3, :3].T + T[:3, 3] - board
    jacobian = np.concatenate(
        [np.broadcast_to(T[:3, :3], (len(points), 3, 3)), -T[:3, :3] @ cross_matrix(points)], axis=2
    )
    free = max(1, difference.size - 6)
    information = np.einsum("kij,kil->jl", jacobian, jacobian)
    variance = float((difference**2).sum()) / free
    return np.asarray(variance * np.linalg.pinv(information, hermitian=True), np.float64)


def estimate_markers(evidence: Evidence) -> CaptureEstimate:
    """Each view by itself; the sigma of a corner, which tells how certain a pose is, is measured over all of them."""
    views = [
        judge(observation, judged(found, evidence.corner_px), evidence, DepthCorrection())
        for observation, found in zip(evidence.observations, evidence.markers, strict=True)
    ]
    return CaptureEstimate("markers", tuple(views), notes=(f"sigma of a corner: {evidence.corner_px:.3f} px",))


def judged(found: MarkerPose, corner_px: float) -> Judged:
    """The pose from markers with its covariance, and whether it is ambiguous."""
    if found.fit is None:
        return Judged(None, faults=(found.reason,))
    faults = []
    if is_ambiguous(found, corner_px):
        faults.append("ambiguous: a pose of another tilt fits the markers as well (planar target)")
    covariance = np.asarray(corner_px**2 * np.linalg.pinv(found.fit.information, hermitian=True), np.float64)
    return Judged(found.fit.T_board_cam, covariance, tuple(faults))


SCALES_DIFFER = 0.01
"""Print and depth disagree: smaller differences may be errors of depth that change with distance, within specification."""
SIGNIFICANT = 3.0


def scale_note(joint: Joint, board: Board, spec: Estimation) -> str:
    """Whether print and depth disagree about the scale, which no capture can decide; empty where they agree."""
    shared = joint.solution.shared
    index = PRINT_SCALE if spec.trust == "depth" else NAMES.index("scale")
    # The scale of depth turns a measured length into a true one; the print's does so for a length of board.json.
    excess = (shared.print_scale if spec.trust == "depth" else 1.0 / shared.scale) - 1.0
    sigma = math.sqrt(max(0.0, float(joint.covariance[index - SHARED, index - SHARED])))
    if joint.prior[index] == 0 or abs(excess) < max(SCALES_DIFFER, SIGNIFICANT * sigma):
        return ""
    larger = "larger" if excess > 0 else "smaller"
    start = (
        "print and depth disagree about the scale: "
        f"by depth the print is {100 * abs(excess):.1f} % {larger} than board.json says"
    )
    if board.measured_ruler_m is not None:
        return f"{start}, although its ruler was measured; the ruler was believed" if spec.trust == "print" else start
    believed = "the print" if spec.trust == "print" else "depth"
    return (
        f"{start}. Which is right cannot be identified from the capture alone; {believed} was believed. "
        f"Measure the printed ruler ({1000 * board.ruler_m:g} mm) and write its length into board.json as measured_ruler_m"
    )


MATERIAL = 5e-4
"""Another camera is told of where it moves a pose by more than this share of its distance: a calibration is no better."""


def camera_note(fitted: CameraFit, camera: CaptureCamera, poses: Array) -> str:
    """That camera.json does not fit, with what the markers say instead; empty where it hardly matters to any pose."""
    moved_by = fitted.shift_m()
    if float(np.max(moved_by / np.linalg.norm(poses[:, :3, 3], axis=1))) < MATERIAL:
        return ""
    sure = np.abs(fitted.numbers) > SIGNIFICANT * fitted.sigma
    if not sure.any():
        return (
            "camera.json does not fit the markers, and the views are too few or too alike to say which of its numbers is "
            "wrong: calibrate the camera at this size of image, or take views from more sides"
        )
    return (
        f"camera.json does not fit: the markers say {compare_cameras(fitted.camera, camera, sure)}, which moves the poses by "
        f"{1000 * float(np.median(moved_by)):.1f} mm. Calibrate the camera at this size of image, or use --calibrate "
        "(estimation.calibrate), which takes what the markers say"
    )


def compare_cameras(found: CaptureCamera, given: CaptureCamera, chosen: NDArray[np.bool_] | None = None) -> str:
    """Numbers of two cameras in words, as camera.json has them with pixel_centre 0: all five, or those chosen."""
    k, of = found.intrinsics, given.intrinsics
    pairs = [(k.fx, of.fx), (k.fy, of.fy), (k.cx_opencv, of.cx_opencv), (k.cy_opencv, of.cy_opencv)]
    words = [f"{name} = {a:.1f} ({b:.1f} given)" for name, (a, b) in zip(("fx", "fy", "cx", "cy"), pairs, strict=True)]
    words.append(f"k1 = {found.lens[0]:.4f} ({given.lens[0]:.4f} given)")
    return ", ".join(word for n, word in enumerate(words) if chosen is None or chosen[n])


def _less_certain(view: ViewEstimate, fitted: CameraFit, place: int) -> ViewEstimate:
    """The view with the uncertainty of the camera in its covariance, whether it is used or not."""
    if view.covariance is None:
        return view
    by_camera = np.outer(fitted.motion[place], fitted.motion[place]) + fitted.covariance[place]
    return dataclasses.replace(view, covariance=view.covariance + by_camera)


def noise_notes(joint: Joint, views: Views) -> list[str]:
    """The sigmas that the terms were weighed with."""
    notes = [f"sigma of a corner: {views.corner_px:.3f} px"]
    if joint.board is not None:
        growth = joint.board.patches.ray_z[:, 2] ** 2
        notes.append(f"depth of the board: {_weights(joint.board, joint.board.view, growth)}")
    if joint.surface is not None:
        first, second = joint.surface.pairs.T
        z = joint.surface.patches.ray_z[:, 2]
        notes.append(
            f"depth of the object: {_weights(joint.surface, joint.surface.view[first], np.hypot(z[first] ** 2, z[second] ** 2))}"
        )
    if joint.board is None and joint.surface is None:
        notes.append("no depth on the board or the object: the joint estimate has corners alone")
    return notes


def _weights(term: BoardTerm | ObjectTerm, view: NDArray[np.int64], growth: Array) -> str:
    """The sigma of a patch, and of all that the patches of one view tell together."""
    together = np.bincount(view, 1.0 / (term.sigma_m**2 * term.inflation))
    patch, whole = np.median(term.sigma_m / growth), np.median(1.0 / np.sqrt(together[together > 0]))
    return f"sigma of a patch {1000 * patch:.2f} mm at 1 m, of all patches of a view together {1000 * whole:.2f} mm"


REACH_M = 0.05
"""Movements up to this are seen."""
PER_VIEW = 40
"""Patches of a view that are looked at."""
NORMAL_M = 0.03
"""A turned normal counts as so many metres a radian in the search for the nearest patch."""
MOVED_M = 0.004
"""A shift of more than this between the views before and after is a move: errors of depth are smaller once corrected."""
ROBUST_M = 0.01
"""Distance at which a pair of patches has half its weight."""
MIN_PAIRS = 40
FLAT = 0.02
"""A shift is known only in directions that this share of the normals tells of."""


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Two patches each, on surface of one direction: the views of both, the first before the second.

    first, second [N]; normal [N, 3]: their mean; distance_m [N]: of the second from the first along it.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    normal: Array
    distance_m: Array


def moved_after(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> tuple[int, float] | None:
    """(index of the last view before the move, metres that the object was shifted by), or None where nothing moved.

    Of all cuts of the sequence, the one across which a common shift of the object explains most.
    """
    of_view = [np.flatnonzero(view == number) for number in range(len(poses))]
    chosen = np.concatenate([own[spread_evenly(len(own), PER_VIEW)] for own in of_view])
    points, normals = (values[chosen] for values in placed(patches, view, poses, shared))
    pairs = _pairs(points, normals, view[chosen], len(poses))
    best: tuple[int, float] | None = None
    most = 0.0
    for cut in range(len(poses) - 1):
        across = (pairs.first <= cut) & (pairs.second > cut)
        if across.sum() < MIN_PAIRS:
            continue
        shift, explained = _shift(pairs.normal[across], pairs.distance_m[across])
        if explained > most:
            best, most = (cut, float(np.linalg.norm(shift))), explained
    return best if best is not None and best[1] > MOVED_M else None


def _pairs(points: Array, normals: Array, view: NDArray[np.int64], views: int) -> _Pairs:
    """Each patch with the nearest of every other view, where that lies on surface of the same direction."""
    places = np.column_stack([points, NORMAL_M * normals])
    of_view = [np.flatnonzero(view == number) for number in range(views)]
    trees = [cKDTree(places[own]) if len(own) else None for own in of_view]
    parts = []
    for number, own in enumerate(of_view):
        for other, tree in enumerate(trees):
            if tree is None or other == number or not len(own):
                continue
            distance, nearest = tree.query(places[own])
            there = of_view[other][nearest]
            near = (distance < REACH_M) & ((normals[own] * normals[there]).sum(axis=1) > MIN_COSINE)
            a, b = (own[near], there[near]) if number < other else (there[near], own[near])
            parts.append(np.stack([a, b], axis=1))
    a, b = np.concatenate(parts or [np.zeros((0, 2), np.int64)]).T
    mean = normals[a] + normals[b]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return _Pairs(view[a], view[b], mean, ((points[b] - points[a]) * mean).sum(axis=1))


def _shift(normal: Array, distance_m: Array) -> tuple[Array, float]:
    """(the shift [3] that explains the distances along the normals best; by how much it lowers their robust cost)."""
    shift = np.zeros(3)
    for _ in range(5):
        weight = 1.0 / (1.0 + ((distance_m - normal @ shift) / ROBUST_M) ** 2)
        matrix = (normal * weight[:, None]).T @ normal
        strength, directions = np.linalg.eigh(matrix)
        known = strength > FLAT * weight.sum()
        along = directions[:, known].T @ ((normal * weight[:, None]).T @ distance_m)
        shift = directions[:, known] @ (along / strength[known])
    return shift, _cost(distance_m) - _cost(distance_m - normal @ shift)


def _cost(distance_m: Array) -> float:
    return float(np.log1p((distance_m / ROBUST_M) ** 2).sum())


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
        evidence.camera,
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
    solution, fitted = joint.solution, fit_camera(problem, joint.solution, evidence.spec.max_iterations)
    asked = fitted if fitted is not None and (fitted.significant or evidence.spec.calibrate) else None
    misfit = fitted is not None and fitted.significant
    told = camera_note(fitted, evidence.camera, solution.poses) if fitted is not None and misfit else ""
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
        if view.depth_mm is not None and view.depth_mm > OFF_BOARD_MM:
            reason = f"depth lies {view.depth_mm:.1f} mm off the board, after the correction"
            view = dataclasses.replace(view, status="flagged", reasons=(*view.reasons, reason))
        views[start.index] = view if asked is None else _less_certain(view, asked, place)
    for index in set(range(len(evidence.observations))) - set(views):
        views[index] = _outside(index, evidence, shared)
    # A wrong focal length changes the scale of depth: the print is blamed only where the camera is not.
    notes = [told or scale_note(joint, evidence.board, evidence.spec), *noise_notes(joint, problem)]
    return CaptureEstimate(
        "joint",
        tuple(views[index] for index in sorted(views)),
        correction,
        shared.print_scale,
        solution.iterations,
        solution.converged,
        tuple(note for note in notes if note),
        fitted.camera if fitted is not None and fitted.is_known() else None,
    )


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
