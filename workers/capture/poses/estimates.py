"""The three estimates of a whole capture: by markers, by the article's method, and by all views in one problem."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.capture import CaptureEstimate, DepthCorrection, ViewEstimate
from schemas.job.captures import Board, Estimation
from workers.capture.poses.camera_fit import CameraFit, camera_note, fit_camera
from workers.capture.poses.joint import Joint, Views, gather, measure_corners, solve_jointly
from workers.capture.poses.markers import (
    AMBIGUOUS,
    MOST_REPROJECTION_PX,
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
from workers.capture.poses.observation import DEPTH_SIGMA_M, Corners, Observation, no_patches
from workers.capture.poses.terms import (
    NAMES,
    POSE,
    PRINT_SCALE,
    SHARED,
    SIGNIFICANT,
    BoardTerm,
    ObjectTerm,
    Shared,
    identified,
)
from workers.geometry.frames import invert, transform

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


def _less_certain(view: ViewEstimate, motion: Array, covariance: Array) -> ViewEstimate:
    """The view with a motion [6] that it may need, and the covariance [6, 6] of that, in its own, whether it is used or not."""
    if view.covariance is None:
        return view
    return dataclasses.replace(view, covariance=view.covariance + np.outer(motion, motion) + covariance)


def noise_notes(joint: Joint, views: Views) -> list[str]:
    """The sigmas that the terms were weighed with."""
    notes = [f"sigma of a corner: {views.sigma_px[0]:.3f} px"]
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


WITHIN_RAD = 0.008
"""A point is compared with the patch of another view whose middle is at most so far from its direction: within the patch."""
GRAZING = 0.15
"""A patch whose plane a ray meets at a smaller cosine does not tell a depth there."""
SEEN_THROUGH_M = 0.004
"""A view that sees so much farther than a patch of another, beyond their noise, sees the object elsewhere. Depth of captures
whose object rests is within 3 mm in 99 of 100 comparisons."""
MOVED_SHARE = 0.032
"""More than this share of two groups' patches is seen through where the object moved between them. Measured on simulated
captures: of an object at rest up to 0.014 are (a mug's handle), of one that moved 3 cm 0.06 (a box, which slides within its
faces) to 0.8."""
FEW_PATCHES = 50.0
"""So many patches more count in the share by which groups are merged: a few that agree say little."""
LEVEL = 0.95
NEAR_BOARD_M = 0.01
"""A patch of the board has at least this cosine to its normal, and lies within this of its plane."""
NEAREST_M = 0.05
"""What is nearer to a camera is not seen by it."""
FEWEST_VIEWS = 3
"""Fewer views of an object at rest are no capture where others disagree with them."""


def object_groups(
    seen: Sequence[Observation], poses: Array, shared: Shared, sigma_m: float, unsure_m: Array
) -> list[list[int]]:
    """Indices of the views, ascending, in groups within which the object stands still; the largest group first.

    A patch of the object that another view looks through stands there no longer. Groups are merged, those that see through
    the smallest share of each other first, up to MOVED_SHARE. sigma_m is that of a patch at 1 m, unsure_m [V] that of what
    each pose does to a point of the object. A view that was compared with no other stays in the first group.
    """
    agree, through = _compare(seen, poses, shared, sigma_m, unsure_m)
    groups = [[number] for number in range(len(seen))]

    def share(one: list[int], other: list[int], more: float) -> float:
        place = np.ix_(one, other)
        count = float(agree[place].sum() + through[place].sum())
        return float(through[place].sum()) / (count + more) if count else 1.0

    while pairs := [
        (share(one, other, FEW_PATCHES) + 1 / (agree[np.ix_(one, other)].sum() + FEW_PATCHES), i, j)
        for j, other in enumerate(groups)
        for i, one in enumerate(groups[:j])
        if share(one, other, 0.0) <= MOVED_SHARE
    ]:
        _, i, j = min(pairs)
        groups[i] += groups.pop(j)
    groups.sort(key=lambda group: (-len(group), min(group)))
    first = groups[0]
    alone = [
        group for group in groups[1:] if not (agree[np.ix_(group, first)].sum() + through[np.ix_(group, first)].sum())
    ]
    apart = [sorted(group) for group in groups[1:] if group not in alone]
    return [sorted([*first, *(number for group in alone for number in group)]), *apart]


def _compare(
    seen: Sequence[Observation], poses: Array, shared: Shared, sigma_m: float, unsure_m: Array
) -> tuple[Array, Array]:
    """(agree, through), each [V, V] symmetric: patches by which two views agree, and those that one sees through."""
    points, normals = [], []
    for own, T in zip(seen, poses, strict=True):
        patches, _ = gather([own.object_patches, own.board_patches])
        p, normal = shared.corrected(patches), patches.normal @ shared.T_cam_depth[:3, :3].T
        # What hides a part of a gap between markers bends its plane.
        kept = (normal @ T[2, :3] > LEVEL) & (np.abs(transform(T, p)[:, 2]) < NEAR_BOARD_M)
        kept[: len(own.object_patches)] = True
        points.append(p[kept])
        normals.append(normal[kept])
    trees = [cKDTree(p[:, :2] / p[:, 2:]) if len(p) else None for p in points]
    counts = np.zeros((2, len(seen), len(seen)))
    for number, own in enumerate(seen):
        on_board = transform(poses[number], points[number][: len(own.object_patches)])
        for other, tree in enumerate(trees):
            if other == number or tree is None or not len(on_board):
                continue
            p = transform(invert(poses[other]), on_board)
            p = p[p[:, 2] > NEAREST_M]
            distance, nearest = tree.query(p[:, :2] / p[:, 2:])
            plane, ray = normals[other][nearest], p / p[:, 2:]
            along = (plane * ray).sum(axis=1)
            met = (distance < WITHIN_RAD) & (np.abs(along) > GRAZING)
            beyond = (plane * points[other][nearest]).sum(axis=1)[met] / along[met] - p[met, 2]
            sigma = np.hypot(sigma_m * p[met, 2] ** 2, np.hypot(unsure_m[number], unsure_m[other]))
            limit = SEEN_THROUGH_M + SIGNIFICANT * sigma
            counts[:, number, other] = (np.abs(beyond) <= limit).sum(), (beyond > limit).sum()
    agree, through = counts + counts.transpose(0, 2, 1)
    return agree, through


OFF_BOARD_MM = 10.0
"""A view whose depth lies farther off the board than this, after the correction, is flagged."""
MIN_PATCHES = 4
"""So many patches of the board tell its tilt."""


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
    problem = measure_corners(_problem(starts, evidence), evidence.spec)
    joint = solve_jointly(problem, evidence.spec)
    fitted = fit_camera(problem, joint.solution, evidence.spec)
    # Poses of another camera see the object elsewhere although it rests.
    doubtful = fitted is not None and fitted.significant and camera_note(fitted, evidence.camera, joint.solution.poses)
    groups = [] if doubtful or problem.rolling(joint.solution) else _groups(problem, joint, list(range(len(starts))))
    if len(groups) < 2:
        return _result(starts, problem, joint, fitted, evidence)
    elsewhere = {number for group in groups[1:] for number in group}
    still = tuple(
        dataclasses.replace(o, object_patches=no_patches()) if n in elsewhere else o
        for n, o in enumerate(problem.observations)
    )
    problem = dataclasses.replace(problem, observations=still)
    joint = solve_jointly(problem, evidence.spec)
    numbers = [[problem.observations[n].number for n in group] for group in groups]
    settled = len(_groups(problem, joint, groups[0])) == 1
    return _mark_moved(_result(starts, problem, joint, fitted, evidence), numbers, settled)


def _groups(problem: Views, joint: Joint, among: list[int]) -> list[list[int]]:
    """The views among these by where the object stands; poses that were given by hand are nobody's to doubt."""
    if problem.fixed.any():
        return [among]
    term, sigma_m = joint.surface, 0.0
    if term is not None:
        z = term.patches.ray_z[term.pairs, 2]
        sigma_m = float(np.median(term.sigma_m / np.hypot(z[:, 0] ** 2, z[:, 1] ** 2)))
    # An object that moved pulls the poses after it: those by the board alone do not know of it.
    solution, seen = joint.by_board, [problem.observations[n] for n in among]
    own = solution.of_views()
    lever = np.array([np.linalg.norm(T[:3, 3]) ** 2 for T in solution.poses])
    unsure_m = np.sqrt(np.trace(own[:, :3, :3], axis1=1, axis2=2) + lever * np.trace(own[:, 3:, 3:], axis1=1, axis2=2))
    groups = object_groups(seen, solution.poses[among], solution.shared, sigma_m, unsure_m[among])
    return [[among[n] for n in group] for group in groups]


def _problem(starts: list[Start], evidence: Evidence) -> Views:
    return Views(
        tuple(evidence.observations[start.index] for start in starts),
        np.stack([start.T_board_cam for start in starts]),
        np.stack([start.covariance for start in starts]),
        np.array([start.fixed for start in starts]),
        evidence.camera,
        np.full(4, evidence.corner_px),
    )


def _start(index: int, evidence: Evidence) -> Start | None:
    """None for a view without a pose, or whose corners its pose does not explain."""
    observation, found = evidence.observations[index], evidence.markers[index]
    if observation.manual_T_board_cam is not None:
        return Start(index, observation.manual_T_board_cam, np.zeros((POSE, POSE)), fixed=True)
    if found.fit is None:
        return None
    off = median_reprojection(observation, found.fit.T_board_cam, evidence.camera, 1.0)
    if off is None or off > MOST_REPROJECTION_PX:
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
    sigma = DEPTH_SIGMA_M * patches.ray_z[:, 2] ** 2
    return float((np.minimum(np.abs(height - np.median(height)) / sigma, 5.0) ** 2).sum())


def _outside(index: int, evidence: Evidence, shared: Shared) -> ViewEstimate:
    """A view that is no part of the problem."""
    observation, found = evidence.observations[index], evidence.markers[index]
    return judge(observation, judged(found, evidence.corner_px), evidence, shared.correction(()))


def _result(
    starts: list[Start], problem: Views, joint: Joint, fitted: CameraFit | None, evidence: Evidence
) -> CaptureEstimate:
    solution = joint.solution
    misfit = fitted is not None and fitted.significant
    told = camera_note(fitted, evidence.camera, solution.poses) if fitted is not None and misfit else ""
    rolled = None if told else problem.rolling(solution)
    asked = rolled or (fitted if misfit or evidence.spec.calibrate else None)
    shared, sigma = solution.shared, np.sqrt(np.maximum(np.diag(joint.covariance)[-SHARED:], 0.0))
    correction = shared.correction(identified(sigma, joint.prior))
    views, wider = {}, problem.corner_term().misfit(solution.poses, solution.shared)
    single_px = max(evidence.corner_px, evidence.spec.corner_px)
    for place, start in enumerate(starts):
        block = slice(POSE * place, POSE * (place + 1))
        pose = Judged(
            solution.poses[place],
            joint.covariance[block, block] * max(wider[place], problem.widening(place, single_px)),
            ("ambiguous: a pose of another tilt fits markers and depth as well",) if start.ambiguous else (),
            (evidence.observations[start.index].given_by,) if start.fixed else (),
            by_corners=False,
        )
        view = judge(evidence.observations[start.index], pose, evidence, correction, shared.print_scale)
        if view.depth_mm is not None and view.depth_mm > OFF_BOARD_MM:
            reason = f"depth lies {view.depth_mm:.1f} mm off the board, after the correction"
            view = dataclasses.replace(view, status="flagged", reasons=(*view.reasons, reason))
        if asked is not None and not start.fixed:
            view = _less_certain(view, asked.motion[place], asked.covariance[place])
        views[start.index] = view
    for index in set(range(len(evidence.observations))) - set(views):
        views[index] = _outside(index, evidence, shared)
    # A wrong focal length changes the scale of depth: the print is blamed only where the camera is not.
    told = rolled.note if rolled is not None else told
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


def _mark_moved(estimate: CaptureEstimate, groups: list[list[int]], settled: bool) -> CaptureEstimate:
    """The views of all groups but the largest are flagged, and all of them where no group is worth the name."""
    places = "; ".join(f"views {', '.join(map(str, group))}" for group in groups)
    told = f"the object moved on the board; it stands still within each of: {places}"
    few = len(groups[0]) < FEWEST_VIEWS or not settled
    told += ". No group is large enough to be used" if few else ". The first of these is used"
    flagged = {number for group in (groups if few else groups[1:]) for number in group}
    reason = "the object stands elsewhere on the board than in most views" if not few else told
    views = [
        dataclasses.replace(view, status="flagged", reasons=(*view.reasons, reason))
        if view.status != "refused" and view.number in flagged
        else view
        for view in estimate.views
    ]
    return dataclasses.replace(estimate, views=tuple(views), notes=(told, *estimate.notes))
