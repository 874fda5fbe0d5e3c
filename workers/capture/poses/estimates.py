"""The three estimates of a whole capture: by markers, by the article's method, and by all views in one problem."""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from schemas.base import Array, Pose
from schemas.capture import CaptureEstimate, DepthCorrection, ViewEstimate
from schemas.job.captures import Estimation
from workers.capture.poses.causes import Doubt, find_doubt
from workers.capture.poses.joint import BoardTerm, Joint, Views, measure_corners, solve_jointly
from workers.capture.poses.markers import AMBIGUOUS, MIN_CORNERS, Evidence, Judged, fits_board, judge
from workers.capture.poses.observation import DEPTH_SIGMA_M, Corners, Observation, no_patches, side_of_patch
from workers.capture.poses.standing import Moment, find_moment, object_groups
from workers.capture.poses.terms import (
    NAMES,
    POSE,
    PRINT_SCALE,
    SHARED,
    SIGNIFICANT,
    Shared,
    correct_depth,
    cross_matrix,
    motion_between,
)
from workers.geometry.frames import pose, transform

ARTICLE_SCALE_M = 0.02
"""Distance from which on a corner's loss grows linearly and no longer with the square: depth at an edge may be the floor's."""
ARTICLE_SETTLED = 1e-8
"""A step of fewer metres and radians ends a fit."""


def estimate_article(evidence: Evidence) -> CaptureEstimate:
    """Each view by itself, begun at its pose from markers."""
    views: list[ViewEstimate] = []
    most, converged = 0, True
    for seen, view in zip(evidence.observations, evidence.markers, strict=True):
        judgement, count = Judged(None, faults=(view.reason,)), int((seen.corners.depth_m > 0).sum())
        if seen.manual_T_board_cam is not None:
            judgement = Judged(seen.manual_T_board_cam, remarks=(seen.given_by,))
        elif view.fit is not None and count < MIN_CORNERS:
            judgement = Judged(None, faults=(f"{count} corners have depth, and {MIN_CORNERS} are needed",))
        elif view.fit is not None:
            T, covariance, steps = fit_article(seen.corners, view.fit.T_board_cam, evidence.spec.max_iterations)
            judgement = Judged(T, covariance, by_corners=False)
            most, converged = max(most, steps), converged and steps < evidence.spec.max_iterations
        views.append(judge(seen, judgement, evidence, DepthCorrection()))
    return CaptureEstimate("article", tuple(views), iterations=most, converged=converged)


def fit_article(corners: Corners, start: Pose, max_iterations: int = 100) -> tuple[Pose, Array, int]:
    """(the pose of least robust distance between lifted corners and their places on the board, its covariance, iterations).

    The loss of a corner is 2 (sqrt(1 + (d / scale)^2) - 1), d its distance. Each step is the closed solution of weighted
    least squares (Umeyama 1991) with the weights that the loss has at the step before, which never makes it larger.
    The covariance [6, 6] is by the spread of the distances; a bias that all corners share does not show in it.
    """
    lifted = corners.depth_m > 0
    z, board = corners.depth_m[lifted], corners.board[lifted]
    points = np.column_stack([corners.rays[lifted] * z[:, None], z])
    T, iterations, settled = start, 0, False
    while iterations < max_iterations and not settled:
        squares = ((transform(T, points) - board) ** 2).sum(axis=1) / ARTICLE_SCALE_M**2
        before, T = T, _align(points, board, 1.0 / np.sqrt(1.0 + squares))
        iterations += 1
        settled = float(np.abs(motion_between(before, T)).max()) < ARTICLE_SETTLED
    difference, R = transform(T, points) - board, np.broadcast_to(T[:3, :3], (len(points), 3, 3))
    jacobian = np.concatenate([R, -R @ cross_matrix(points)], axis=2).reshape(-1, POSE)
    variance = float((difference**2).sum()) / max(1, difference.size - POSE)
    return T, np.asarray(variance * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True), np.float64), iterations


def _align(points: Array, goals: Array, weight: Array) -> Pose:
    """[4, 4]: the rigid transform of points [N, 3] with the least weighted squares of distance to goals [N, 3]."""
    share = weight / weight.sum()
    middle, goal = share @ points, share @ goals
    R = Rotation.align_vectors(goals - goal, points - middle, weights=share)[0].as_matrix()
    return pose(R, goal - R @ middle)


def estimate_markers(evidence: Evidence) -> CaptureEstimate:
    """Each view by itself; the sigma of a corner, which tells how certain a pose is, is measured over all of them."""
    views = tuple(_by_markers(n, evidence, DepthCorrection()) for n in range(len(evidence.observations)))
    return CaptureEstimate("markers", views, notes=(f"sigma of a corner: {evidence.corner_px:.3f} px",))


def _by_markers(index: int, evidence: Evidence, depth: DepthCorrection) -> ViewEstimate:
    """The pose from markers with its covariance, and whether it is ambiguous."""
    view, judgement = evidence.markers[index], Judged(None, faults=(evidence.markers[index].reason,))
    if view.fit is not None:
        doubt = "ambiguous: a pose of another tilt fits the markers as well (planar target)"
        faults = (doubt,) if view.is_ambiguous(evidence.corner_px) else ()
        judgement = Judged(view.fit.T_board_cam, view.fit.covariance(evidence.corner_px), faults)
    return judge(evidence.observations[index], judgement, evidence, depth)


# ---------------------------------------------------------------------------------------------- all views in one problem

FEWEST_VIEWS = 3
"""Fewer views of an object at rest are no capture where others disagree with them."""
OFF_BOARD_MM = 10.0
"""A view whose depth lies farther off the board than this, after the correction, is flagged."""
MIN_PATCHES = 4
"""So many patches of the board tell its tilt."""
SCALES_DIFFER = 0.01
"""Print and depth disagree: smaller differences may be errors of depth that change with distance, within specification."""
UNMEASURED = 0.005
"""Printers scale to the page, and paper stretches, by about this share."""


def estimate_joint(evidence: Evidence) -> CaptureEstimate:
    """All views in one problem; a view that its markers do not fit stays as `markers` has it, and is flagged."""
    problem = _pose_problem(evidence)
    if problem is None:
        views = tuple(_by_markers(n, evidence, DepthCorrection()) for n in range(len(evidence.observations)))
        return CaptureEstimate("joint", views, notes=("no view has markers that fit the board",))
    problem = measure_corners(problem, evidence.spec)
    joint = solve_jointly(problem, evidence.spec)
    pixels = np.concatenate([o.corners.pixels for o in problem.observations])
    doubt = find_doubt(problem.corner_term(), (pixels, problem.camera), problem.fixed, joint.solution, evidence.spec)
    explained = _explained(problem, joint, doubt, evidence.spec)
    moment = None if explained[1].board is None else find_moment(explained[1].board, explained[1].by_board)
    groups, clutter = _groups(*explained, moment, list(range(len(problem.index))))
    if clutter or len(groups) > 1:
        still = [o.without(clutter[n]) if n in clutter else o for n, o in enumerate(problem.observations)]
        for n in (n for group in groups[1:] for n in group):
            still[n] = dataclasses.replace(still[n], object_patches=no_patches())
        problem = dataclasses.replace(problem, observations=tuple(still))
        joint = solve_jointly(problem, evidence.spec)
    estimate = _result(problem, joint, (doubt, explained[1]), moment, evidence)
    if len(groups) > 1:
        numbers = [[problem.observations[n].number for n in group] for group in groups]
        settled, _ = _groups(*_explained(problem, joint, doubt, evidence.spec), moment, groups[0])
        estimate = _mark_moved(estimate, numbers, len(settled) == 1)
    return dataclasses.replace(estimate, camera=doubt.camera if doubt is not None and doubt.is_known else None)


def _pose_problem(evidence: Evidence) -> Views | None:
    """The views with a pose that explains their corners, or that was given; None where there are none."""
    chosen = []
    for n, (seen, view) in enumerate(zip(evidence.observations, evidence.markers, strict=True)):
        if seen.manual_T_board_cam is not None:
            chosen.append((n, seen, seen.manual_T_board_cam, np.zeros((POSE, POSE)), True, False))
        elif view.fit is not None and fits_board(seen, view.fit.T_board_cam, evidence.camera):
            fit, is_open = view.fit, False
            if view.rival is not None and view.is_ambiguous(evidence.corner_px):
                scores = [
                    option.cost / evidence.corner_px**2 + _tilt_misfit(seen, option.T_board_cam)
                    for option in (fit, view.rival)
                ]
                fit, is_open = view.rival if scores[1] < scores[0] else fit, abs(scores[0] - scores[1]) < AMBIGUOUS
            chosen.append((n, seen, fit.T_board_cam, fit.covariance(evidence.corner_px), False, is_open))
    if not chosen:
        return None
    index, views, poses, covariance, fixed, ambiguous = zip(*chosen, strict=True)
    sigma_px = np.full(4, evidence.corner_px)
    pose_arrays = np.stack(poses), np.stack(covariance), np.array(fixed)
    return Views(index, views, *pose_arrays, ambiguous, evidence.camera, sigma_px)


def _tilt_misfit(seen: Observation, T: Pose) -> float:
    """Misfit, in sigma squared, of the board's depth against the plane of the pose, its height left open."""
    patches = seen.board_patches
    if len(patches) < MIN_PATCHES:
        return 0.0
    height = transform(T, patches.ray_z)[:, 2]
    sigma = DEPTH_SIGMA_M * patches.ray_z[:, 2] ** 2
    return float((np.minimum(np.abs(height - np.median(height)) / sigma, 5.0) ** 2).sum())


def _explained(
    problem: Views, joint: Joint, doubt: Doubt | None, spec: Estimation
) -> tuple[Views, Joint, Array | None]:
    """The problem and its solution as the explanation of the corners has them, which moves poses and depth; its covariance."""
    if doubt is None:
        return problem, joint, None
    camera, fixed = problem.camera, np.ones_like(problem.fixed)
    reread = [
        dataclasses.replace(
            o,
            board_patches=doubt.reread(o.board_patches, camera),
            object_patches=doubt.reread(o.object_patches, camera),
        )
        for o in problem.observations
    ]
    poses = np.where(problem.fixed[:, None, None], problem.poses, doubt.poses)
    other = dataclasses.replace(problem, observations=tuple(reread), poses=poses, fixed=fixed)
    covariance = doubt.covariance
    if not doubt.fits:
        covariance = covariance + doubt.motion[:, :, None] * doubt.motion[:, None]
    return dataclasses.replace(other, fixed=problem.fixed), solve_jointly(other, spec), covariance


def _groups(
    problem: Views, joint: Joint, covariance: Array | None, moment: Moment | None, among: list[int]
) -> tuple[list[list[int]], dict[int, NDArray[np.bool_]]]:
    """(the views among these by where the object stands; which patches are clutter, of views that have any).

    Poses that were given by hand are nobody's to doubt.
    """
    if problem.fixed.any():
        return [among], {}
    term = joint.surface
    sigma_m = 0.0 if term is None else float(np.median(term.sigma_m / term.growth))
    # An object that moved pulls the poses after it: those by the board alone do not know of it.
    solution, seen = joint.by_board, [problem.observations[n] for n in among]
    covariance = solution.of_views() if covariance is None else covariance
    place, turn = (np.trace(covariance[:, block, block], axis1=1, axis2=2) for block in (slice(3), slice(3, 6)))
    unsure_m = np.sqrt(place + (solution.poses[:, :3, 3] ** 2).sum(axis=1) * turn)
    poses, shared = solution.poses, solution.shared
    if moment is not None:
        shared = Shared()
        poses, unsure_m = moment.T_board_depth @ poses, np.hypot(unsure_m, moment.unsure_m)
    within_rad = side_of_patch(problem.camera) / problem.camera.intrinsics.fx / 2
    groups, clutter = object_groups(seen, poses[among], shared, sigma_m, unsure_m[among], within_rad)
    if moment is None and len(groups) > 1:
        # The board tells little of a registration that shifts depth along it: one by which all views agree on the object is true.
        agreed = object_groups(seen, poses[among], joint.solution.shared, sigma_m, unsure_m[among], within_rad)
        groups, clutter = agreed if len(agreed[0]) == 1 else (groups, clutter)
    return [[among[n] for n in group] for group in groups], {
        among[n]: out for n, out in enumerate(clutter) if out.any()
    }


def _result(
    problem: Views, joint: Joint, doubted: tuple[Doubt | None, Joint], moment: Moment | None, evidence: Evidence
) -> CaptureEstimate:
    """doubted: what the poses may need, which makes all but given ones less certain, and the solution as it has them."""
    solution, (doubt, explained) = joint.solution, doubted
    sigma = _sigma_shared(joint)
    correction = correct_depth(solution.shared, sigma, joint.prior)
    views = {
        n: _by_markers(n, evidence, correction) for n in set(range(len(evidence.observations))) - set(problem.index)
    }
    for place, wider in enumerate(problem.corner_term().misfit(solution.poses, solution.shared)):
        view = _joint_view(place, (problem, joint, evidence), float(wider), correction)
        if doubt is not None and not problem.fixed[place] and view.covariance is not None:
            motion = doubt.motion[place]
            covariance = view.covariance + np.outer(motion, motion) + doubt.covariance[place]
            view = dataclasses.replace(view, covariance=covariance)
        views[problem.index[place]] = view
    causes = [cause.note for cause in (doubt, moment) if cause is not None and cause.note]
    if not causes:
        causes = [print_note(joint, evidence)]
    elif moment is None and doubt is not None and doubt.fits:
        # A wrong focal length changes the scale of depth: what is left beside the explanation is the print's.
        causes.append(print_note(explained, evidence))
    cluttered = ", ".join(str(o.number) for o in problem.observations if o.is_cluttered)
    clutter = (
        f"what one view alone has on the board, such as a hand, is left out: views {cluttered}" if cluttered else ""
    )
    notes = tuple(note for note in (clutter, *causes, *noise_notes(joint, problem)) if note)
    ordered = tuple(views[index] for index in sorted(views))
    scale, steps = solution.shared.print_scale, solution.iterations
    return CaptureEstimate("joint", ordered, correction, scale, steps, solution.converged, notes)


CLUTTERED = "what it alone has on the board is left out"


def _joint_view(
    place: int, solved: tuple[Views, Joint, Evidence], wider: float, correction: DepthCorrection
) -> ViewEstimate:
    """The view at a place of the problem, judged; its covariance is at least `wider` times that of independent corners."""
    problem, joint, evidence = solved
    block, cluttered = slice(POSE * place, POSE * (place + 1)), problem.observations[place].is_cluttered
    widening = problem.widening(place, max(evidence.corner_px, evidence.spec.corner_px))
    seen = evidence.observations[problem.index[place]]
    judgement = Judged(
        joint.solution.poses[place],
        joint.covariance[block, block] * max(wider, widening),
        ("ambiguous: a pose of another tilt fits markers and depth as well",) * problem.ambiguous[place],
        (*(seen.given_by,) * bool(problem.fixed[place]), *(CLUTTERED,) * cluttered),
        by_corners=False,
    )
    view = judge(seen, judgement, evidence, correction, joint.solution.shared.print_scale)
    view = dataclasses.replace(view, is_cluttered=cluttered)
    if view.depth_mm is None or view.depth_mm <= OFF_BOARD_MM:
        return view
    return _flagged(view, f"depth lies {view.depth_mm:.1f} mm off the board, after the correction")


def _flagged(view: ViewEstimate, reason: str) -> ViewEstimate:
    return dataclasses.replace(view, status="flagged", reasons=(*view.reasons, reason))


def _mark_moved(estimate: CaptureEstimate, groups: list[list[int]], settled: bool) -> CaptureEstimate:
    """The views of all groups but the largest are flagged, and all of them where no group is worth the name."""
    places = "; ".join(f"views {', '.join(map(str, group))}" for group in groups)
    note = f"the object moved on the board; it stands still within each of: {places}. "
    few = len(groups[0]) < FEWEST_VIEWS or not settled
    note += "No group is large enough to be used" if few else "The first of these is used"
    flagged = {number for group in groups[0 if few else 1 :] for number in group}
    reason = note if few else "the object stands elsewhere on the board than in most views"
    views = tuple(
        _flagged(view, reason) if view.status != "refused" and view.number in flagged else view
        for view in estimate.views
    )
    return dataclasses.replace(estimate, views=views, notes=(note, *estimate.notes))


def _sigma_shared(joint: Joint) -> Array:
    """[S]: of what all views share."""
    return np.asarray(np.sqrt(np.maximum(np.diag(joint.covariance)[-SHARED:], 0.0)))


def print_note(joint: Joint, evidence: Evidence) -> str:
    """Whether print and depth disagree about the scale, which no capture can decide; else what lengths are worth.

    Empty where somebody measured the board, or depth is metric truth, and they agree.
    """
    shared, board, by_print = joint.solution.shared, evidence.board, evidence.spec.trust == "print"
    index = NAMES.index("scale") if by_print else PRINT_SCALE
    # The scale of depth turns a measured length into a true one; the print's does so for a length of board.json.
    excess = (1.0 / shared.scale if by_print else shared.print_scale) - 1.0
    is_measured = board.measured_ruler_m is not None
    measure = f"Measure the printed ruler ({1000 * board.ruler_m:g} mm) and write its length into board.json as measured_ruler_m"
    least = max(SCALES_DIFFER if is_measured else UNMEASURED, SIGNIFICANT * _sigma_shared(joint)[index])
    if joint.prior[index] == 0 or abs(excess) < least:
        distance_m = float(np.median(np.linalg.norm(joint.solution.poses[:, :3, 3], axis=1)))
        unsure = f"all lengths are known to about {UNMEASURED:.1%}, {1000 * UNMEASURED * distance_m:.0f} mm at these distances"
        unsure = f"the board's ruler was not measured: {unsure}, beside what sigma_mm says. {measure}"
        return "" if is_measured or not by_print else unsure
    start = (
        "print and depth disagree about the scale: by depth the print is "
        f"{100 * abs(excess):.1f} % {'larger' if excess > 0 else 'smaller'} than board.json says"
    )
    if is_measured:
        return f"{start}, although its ruler was measured; the ruler was believed" if by_print else start
    believed = f"{'the print' if by_print else 'depth'} was believed"
    return f"{start}. Which is right cannot be identified from the capture alone; {believed}. {measure}"


def noise_notes(joint: Joint, views: Views) -> list[str]:
    """The sigmas that the terms were weighed with: of a corner, of a patch, and of all that a view's patches tell together."""
    notes = [f"sigma of a corner: {views.sigma_px[0]:.3f} px"]
    for name, term in (("board", joint.board), ("object", joint.surface)):
        if term is None:
            continue
        view = term.view if isinstance(term, BoardTerm) else term.view[term.pairs[:, 0]]
        together = np.bincount(view, 1.0 / (term.sigma_m**2 * term.inflation))
        patch, whole = np.median(term.sigma_m / term.growth), np.median(1.0 / np.sqrt(together[together > 0]))
        of_patch = f"sigma of a patch {1000 * patch:.2f} mm at 1 m"
        notes.append(f"depth of the {name}: {of_patch}, of all patches of a view together {1000 * whole:.2f} mm")
    return notes if notes[1:] else [*notes, "no depth on the board or the object: the joint estimate has corners alone"]
