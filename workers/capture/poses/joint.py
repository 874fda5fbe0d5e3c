"""The joint estimate: all views, corners and depth in one problem, each weighed by its measured noise.

Errors of depth are alike over an image (the lens, the distance, the shutter). Hundreds of patches that err together
know no more than a few; so the variance of a term is inflated by what the misfit of whole views says over that of
independent patches.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky
from scipy.spatial import cKDTree

from schemas.base import Array
from schemas.capture import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.corners import CornerTerm, Rolling
from workers.capture.poses.markers import focal_lengths, moved
from workers.capture.poses.observation import DEPTH_SIGMA_M, Observation, Patches
from workers.capture.poses.terms import (
    GROW_M,
    GROW_PX,
    GROWTH_M,
    GROWTH_PX,
    MAD,
    POSE,
    SHARED,
    BoardTerm,
    ObjectTerm,
    Shared,
    median_of_chi_square,
    normal_equations,
    pose_halves,
    prior_sigma,
)
from workers.geometry.frames import add_up

REACH_M = 0.012
"""Patches of one surface lie at most so far apart: about their own width."""
MIN_COSINE = 0.87
"""And their normals at most 30 degrees."""
NEIGHBOURS = 10
PARTNERS = 3
"""Of the nearest patches of other views, so many are paired with each."""


@dataclass(frozen=True, eq=False)
class Matches:
    """pairs [N, 2]: indices of patches, of two views, the lower first; normal [N, 3]: unit, their mean, board axes."""

    pairs: NDArray[np.int64]
    normal: Array


def placed(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> tuple[Array, Array]:
    """(points [P, 3], normals [P, 3]) of patches in the board frame; the normal of depth that is stretched is kept."""
    R, t = poses[view, :3, :3], poses[view, :3, 3]
    points = np.einsum("pij,pj->pi", R, shared.corrected(patches)) + t
    return points, np.einsum("pij,pj->pi", R, patches.normal @ shared.T_cam_depth[:3, :3].T)


def match_patches(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> Matches:
    """The pairs at the present poses, each once, in order of index."""
    if len(patches) < 2:
        return Matches(np.zeros((0, 2), np.int64), np.zeros((0, 3)))
    points, normals = placed(patches, view, poses, shared)
    count = min(NEIGHBOURS + 1, len(points))
    distance, neighbour = cKDTree(points).query(points, k=count, distance_upper_bound=REACH_M)
    found = np.isfinite(distance)
    neighbour = np.where(found, neighbour, 0)
    alike = np.einsum("pi,pki->pk", normals, normals[neighbour]) > MIN_COSINE
    normals = _smoothed(normals, neighbour, found & alike)
    alike = np.einsum("pi,pki->pk", normals, normals[neighbour]) > MIN_COSINE
    good = found & alike & (view[neighbour] != view[:, None])
    good &= np.cumsum(good, axis=1) <= PARTNERS
    first, column = np.nonzero(good)
    pairs = np.sort(np.stack([first, neighbour[first, column]], axis=1), axis=1).astype(np.int64)
    pairs = np.unique(pairs, axis=0)
    normal = normals[pairs[:, 0]] + normals[pairs[:, 1]]
    return Matches(pairs, normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _smoothed(normals: Array, neighbour: NDArray[np.intp], chosen: NDArray[np.bool_]) -> Array:
    """[P, 3]: the mean of the normals around each patch: the surface bends less over a patch than its noise."""
    total = (normals[neighbour] * chosen[..., None]).sum(axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0.5, total / np.maximum(length, 1e-9), normals)


FLOOR_M = 2e-4
"""No patch is taken to be better than this at 1 m: stored depth has a step of 1 mm, and its errors are not all seen."""
FEW_VIEWS = 4
INFLATION_OF_FEW = 30.0
"""Inflation where fewer views than this can tell: about as if a view's patches erred as one."""
VIEW_FLOOR_M = 5e-4
"""All the patches of a view together are not taken to be better than this: errors of depth that change with place and
distance, and that no correction of the capture has, do not average out. Good corners place a camera to 0.1 mm."""


def patch_sigma(residual_m: Array, growth: Array) -> float:
    """Sigma of a patch at 1 m, metres, from residuals [P] that grow as `growth` [P] (the distance squared)."""
    return max(FLOOR_M, MAD * float(np.median(np.abs(residual_m / growth)))) if len(residual_m) else FLOOR_M


def inflation(residual: Array, by_view: Array, view: NDArray[np.int64], pose_covariance: Array) -> float:
    """How many times larger the variance of a term is than its patches' sigma says, at least 1.

    residual [N] in sigma, by_view [N, k] derivatives by what a view's patches tell (k numbers), view [N] index;
    pose_covariance [V, k, k]: what is not known of each view beforehand, which makes residuals too. The misfit of a view,
    g^T H^-1 g, is k on average where the patches are independent; the median over the views resists a bad one. It is
    squared: what errs alike within a view does so between views too, of which the misfit of single views shows nothing.
    """
    ratios = []
    for number in np.unique(view):
        J, r = by_view[view == number], residual[view == number]
        strength, directions = np.linalg.eigh(J.T @ J)
        kept = strength > 1e-6 * max(float(strength[-1]), 1e-12)
        rank = int(kept.sum())
        if len(r) < 2 * rank or not rank:
            continue
        weighted = 1.0 / (1.0 + (r / 3.0) ** 2)
        along = directions[:, kept].T @ (J.T @ (weighted * r))
        misfit = float((along**2 / strength[kept]).sum())
        known = float(np.trace(J.T @ J @ pose_covariance[number]))
        ratios.append((misfit - known) / (rank * median_of_chi_square(rank)))
    if len(ratios) < FEW_VIEWS:
        return INFLATION_OF_FEW
    return max(1.0, float(np.median(ratios))) ** 2


def row_inflation(factor: float, sigma_m: Array, *views: NDArray[np.int64]) -> Array:
    """[N]: inflation of each row of sigma_m [N], at least `factor`, so that no view's rows come to less than VIEW_FLOOR_M."""
    count = np.max([np.bincount(view)[view] for view in views], axis=0)
    return np.maximum(factor, count * (VIEW_FLOOR_M / sigma_m) ** 2)


SETTLED = 1e-7
"""A step of fewer metres and radians ends the iteration: a tenth of a micrometre."""


Term = CornerTerm | BoardTerm | ObjectTerm


@dataclass(frozen=True, eq=False)
class Problem:
    """The terms; prior [S] sigma of the shared parameters, 0 for those that are fixed; fixed [V] poses that do not move."""

    terms: Sequence[Term]
    prior: Array
    fixed: np.ndarray


@dataclass(frozen=True, eq=False)
class Solution:
    """poses [V, 4, 4], the shared parameters, and the covariance [D, D], D = 6 V + S, zero where nothing moves."""

    poses: Array
    shared: Shared
    matrix: Array
    iterations: int
    converged: bool

    def of_views(self) -> Array:
        """[V, 6, 6]: the covariance of each pose."""
        count = len(self.poses)
        blocks = self.covariance()[:-SHARED, :-SHARED].reshape(count, POSE, count, POSE)
        return blocks[range(count), :, range(count)]

    def covariance(self) -> Array:
        """[D, D]: the inverse of the normal equations at the solution."""
        free = np.diag(self.matrix) > 0
        found = np.zeros_like(self.matrix)
        upper = cholesky(_regular(self.matrix[np.ix_(free, free)]))
        half = np.linalg.inv(upper)
        found[np.ix_(free, free)] = half @ half.T
        return found


def minimise(problem: Problem, poses: Array, shared: Shared, most: int) -> Solution:
    """The poses and shared parameters of least robust cost near a start, in at most `most` steps."""
    damping, converged, iterations = 1e-6, False, 0
    matrix, gradient, cost = _linearise(problem, poses, shared)
    while iterations < most and not converged:
        iterations += 1
        step = _step(matrix, gradient, damping)
        new_poses = np.stack(
            [moved(T, motion) for T, motion in zip(poses, step[:-SHARED].reshape(-1, POSE), strict=True)]
        )
        new_shared = shared.moved(step[-SHARED:])
        new_matrix, new_gradient, new_cost = _linearise(problem, new_poses, new_shared)
        small = float(np.abs(step).max()) < SETTLED
        if new_cost <= cost:
            poses, shared, matrix, gradient, cost = new_poses, new_shared, new_matrix, new_gradient, new_cost
            damping *= 0.1
            converged = small
        else:
            damping = max(damping, 1e-6) * 10
            converged = small or damping > 1e6
    return Solution(poses, shared, matrix, iterations, converged)


def _step(matrix: Array, gradient: Array, damping: float) -> Array:
    free = np.diag(matrix) > 0
    part = matrix[np.ix_(free, free)]
    step = np.zeros(len(gradient))
    step[free] = cho_solve(cho_factor(_regular(part + damping * np.diag(np.diag(part)))), -gradient[free])
    return step


def _regular(matrix: Array) -> Array:
    """The matrix with so little on its diagonal that directions without any information (10 m or rad) can be factored."""
    return matrix + 1e-2 * np.eye(len(matrix))


def _linearise(problem: Problem, poses: Array, shared: Shared) -> tuple[Array, Array, float]:
    """(matrix, gradient, cost); rows and columns of what is fixed are zero."""
    rows = [term.rows(poses, shared) for term in problem.terms]
    matrix, gradient = normal_equations(rows, len(poses))
    free = problem.prior > 0
    sigma = np.where(free, problem.prior, 1.0)
    deviation = shared.deviation()
    first = len(gradient) - SHARED
    matrix[range(first, len(gradient)), range(first, len(gradient))] += 1.0 / sigma**2
    gradient[first:] += deviation / sigma**2
    held = np.concatenate([np.repeat(problem.fixed, POSE), ~free])
    matrix[held], matrix[:, held], gradient[held] = 0.0, 0.0, 0.0
    return matrix, gradient, add_up(r.cost for r in rows) + float(((deviation / sigma)[free] ** 2).sum())


ROUNDS = 4
"""How often the object's patches are paired anew."""
SURE_MARKERS = 12
"""Views of at least so many markers tell how noisy depth is, where there are a few of them."""


@dataclass(frozen=True, eq=False)
class Views:
    """The views of the problem in order, with their depth in one piece: poses [V, 4, 4] to begin with, covariance [V, 6, 6].

    fixed [V]: a pose that was given by hand does not move.
    """

    observations: tuple[Observation, ...]
    poses: Array
    covariance: Array
    fixed: NDArray[np.bool_]
    camera: CaptureCamera
    sigma_px: Array

    def corner_term(self) -> CornerTerm:
        """All corners, with the camera held."""
        corners = [o.corners for o in self.observations]
        view = np.repeat(np.arange(len(corners)), [len(c.board) for c in corners])
        board, rays = np.concatenate([c.board for c in corners]), np.concatenate([c.rays for c in corners])
        square = np.concatenate([c.markers for c in corners]) >= 0
        return CornerTerm(view, board, rays, focal_lengths(self.camera), self.sigma_px, square)

    def rolling(self, found: Solution) -> Rolling | None:
        """What a rolling shutter does to the poses, where the corners ask for one."""
        return self.corner_term().rolling(found.poses, found.shared, self.camera.intrinsics.height)

    def widening(self, place: int, single_px: float) -> float:
        """Factor of a view's covariance: whole markers are less noisy than corners (single_px); one marker has but its four."""
        single = (single_px / self.sigma_px[0]) ** 2
        return float(1.0 + max(0.0, single - 1.0) / max(1, self.observations[place].markers) ** 2)

    def sure(self) -> NDArray[np.bool_]:
        """[V]: views by which the noise of depth is measured."""
        many = np.array([o.markers >= SURE_MARKERS for o in self.observations])
        return many if many.sum() >= 4 else np.ones(len(many), bool)


NOISE_ROUNDS = 3
"""How often poses and the noise of corners are found one by the other: the second round changes sigma by a few percent."""


def measure_corners(views: Views, spec: Estimation) -> Views:
    """The views with the poses and the noise of corners that are left once the growth of the printed squares is estimated.

    Sharpening, tone curves and spread ink move all edges of a marker alike: a view by itself takes that for a shorter distance.
    """
    corners, prior, poses, shared = views.corner_term(), np.zeros(SHARED), views.poses, Shared()
    prior[[GROWTH_M, GROWTH_PX]] = GROW_M, GROW_PX
    free = np.zeros_like(views.fixed)
    for _ in range(NOISE_ROUNDS):
        found = minimise(Problem([corners], prior, free), poses, shared, spec.max_iterations)
        poses, shared = found.poses, found.shared
        corners = corners.measured(poses, shared, spec)
    halves = pose_halves(corners.rows(poses, shared), len(poses))
    covariance = halves @ halves.transpose(0, 2, 1)
    poses = np.where(views.fixed[:, None, None], views.poses, poses)
    return dataclasses.replace(views, poses=poses, covariance=covariance, sigma_px=corners.sigma_px)


@dataclass(frozen=True, eq=False)
class Joint:
    """The solution, that without the object, the noise of depth that it was weighed with (sigma at 1 m), and the pairs."""

    solution: Solution
    by_board: Solution
    covariance: Array
    prior: Array
    board: BoardTerm | None
    surface: ObjectTerm | None


def solve_jointly(views: Views, spec: Estimation) -> Joint:
    """The poses of all views, first with the board alone, then with the object, whose patches are paired in rounds."""
    on_board, board_view = gather([o.board_patches for o in views.observations])
    on_object, object_view = gather([o.object_patches for o in views.observations])
    prior = prior_sigma(spec, bool(len(on_board)) or bool(len(on_object)))
    corners, held = views.corner_term(), np.ones(len(views.poses), bool)
    shared, board = Shared(), None
    if len(on_board):
        board = BoardTerm(board_view, on_board, DEPTH_SIGMA_M * on_board.ray_z[:, 2] ** 2, np.ones(len(on_board)))
        start = Problem([corners, board] if spec.trust == "depth" else [board], prior, held)
        if spec.trust == "depth":  # a print of another size moves the cameras: they must be free
            start = dataclasses.replace(start, fixed=views.fixed)
        first = minimise(start, views.poses, shared, 30)
        shared = first.shared
        board = _measured_board(board, views, first)
    terms: list[Term] = [corners, *([board] if board else [])]
    solution = minimise(Problem(terms, prior, views.fixed), views.poses, shared, spec.max_iterations)
    by_board, surface, iterations, alike = solution, None, solution.iterations, 1.0
    for _ in range(ROUNDS if len(on_object) else 0):
        if iterations >= spec.max_iterations:
            break
        matches = match_patches(on_object, object_view, solution.poses, solution.shared)
        measured = _measured_object(on_object, object_view, matches, views, solution)
        if measured is None:
            break
        # Poses that have followed the object's depth no longer show how far it had pulled them: the first rounds tell.
        alike, surface = max(alike, measured[1]), measured[0]
        first, second = object_view[matches.pairs].T
        surface = dataclasses.replace(surface, inflation=row_inflation(alike, surface.sigma_m, first, second))
        problem = Problem([*terms, surface], prior, views.fixed)
        before = solution
        solution = minimise(problem, before.poses, before.shared, spec.max_iterations - iterations)
        iterations += solution.iterations
    solution = dataclasses.replace(solution, iterations=iterations)
    return Joint(solution, by_board, solution.covariance(), prior, board, surface)


def gather(patches: list[Patches]) -> tuple[Patches, NDArray[np.int64]]:
    """(the patches of all views in one piece, [P] index of the view of each)."""
    view = np.repeat(np.arange(len(patches)), [len(p) for p in patches])
    parts = zip(*[(p.ray_z, p.ray, p.normal, p.pixels, p.sigma_m) for p in patches], strict=True)
    return Patches(*[np.concatenate(part) for part in parts]), view


def _measured_board(term: BoardTerm, views: Views, found: Solution) -> BoardTerm:
    """The term with the sigma of its patches and their inflation as this capture's own residuals have them."""
    growth = term.patches.ray_z[:, 2] ** 2
    rows = dataclasses.replace(term, sigma_m=growth).rows(found.poses, found.shared)
    chosen = views.sure()[term.view]
    chosen = chosen if chosen.any() else np.ones_like(chosen)
    sigma_m = patch_sigma(rows.residual[chosen] * growth[chosen], growth[chosen]) * growth
    rows = dataclasses.replace(term, sigma_m=sigma_m).rows(found.poses, found.shared)
    # Three numbers are what a plane tells: its height (z of the camera in the board frame) and its tilts.
    up = found.poses[term.view, 2, :3]
    by_plane = np.concatenate([np.full((len(up), 1), 1.0) / sigma_m[:, None], rows.by_first[:, 3:]], axis=1)
    by_plane = np.where(np.isfinite(by_plane), by_plane, 0.0)
    covariance = _plane_covariance(views, found.poses)
    factor = inflation(rows.residual[chosen], by_plane[chosen], term.view[chosen], covariance)
    return dataclasses.replace(term, sigma_m=sigma_m, inflation=row_inflation(factor, sigma_m, term.view))


def _plane_covariance(views: Views, poses: Array) -> Array:
    """[V, 4, 4]: of (height over the board along its normal, turn of the camera)."""
    take = np.zeros((len(poses), 4, POSE))
    take[:, 0, :3] = poses[:, 2, :3]
    take[:, 1:, 3:] = np.eye(3)
    return np.einsum("vij,vjk,vlk->vil", take, views.covariance, take)


def _measured_object(
    patches: Patches, view: NDArray[np.int64], matches: Matches, views: Views, found: Solution
) -> tuple[ObjectTerm, float] | None:
    """(the term of the pairs with their sigma by their own residuals, inflation); None where there are none."""
    if not len(matches.pairs):
        return None
    a, b = matches.pairs.T
    growth = np.hypot(patches.ray_z[a, 2] ** 2, patches.ray_z[b, 2] ** 2)
    term = ObjectTerm(view, patches, matches.pairs, matches.normal, growth, np.ones(len(growth)))
    residual = term.rows(found.poses, found.shared).residual
    chosen = views.sure()[view[a]] & views.sure()[view[b]]
    chosen = chosen if chosen.any() else np.ones_like(chosen)
    sigma_m = patch_sigma(residual[chosen] * growth[chosen], growth[chosen]) * growth
    rows = dataclasses.replace(term, sigma_m=sigma_m).rows(found.poses, found.shared)
    # Each pair tells of both of its views.
    assert rows.second is not None and rows.by_second is not None
    both = np.concatenate([rows.first[chosen], rows.second[chosen]])
    by = np.concatenate([rows.by_first[chosen], rows.by_second[chosen]])
    factor = inflation(np.tile(rows.residual[chosen], 2), by, both, found.of_views())
    return dataclasses.replace(term, sigma_m=sigma_m), factor
