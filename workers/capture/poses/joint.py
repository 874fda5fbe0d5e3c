"""The joint estimate: all views, corners and depth in one problem, each weighed by its measured noise.

Errors of depth are alike over an image (the lens, the distance, the shutter). Hundreds of patches that err together
know no more than a few; so the variance of a term is inflated by what the misfit of whole views says over that of
independent patches.
"""

import dataclasses
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.base import Array
from schemas.capture import CaptureCamera
from schemas.job.captures import Estimation
from workers.capture.poses.corners import CornerTerm
from workers.capture.poses.observation import DEPTH_SIGMA_M, Observation, Patches
from workers.capture.poses.terms import (
    DEPTH_SCALE,
    GROW_M,
    GROW_PX,
    GROWTH_M,
    GROWTH_PX,
    MAD,
    SHARED,
    Problem,
    Rows,
    Shared,
    Solution,
    Term,
    median_of_chi_square,
    minimise,
    pose_halves,
    prior_sigma,
    robust,
)

# ---------------------------------------------------------------------------------------------- depth


@dataclass(frozen=True, eq=False)
class BoardTerm:
    """Depth of the board: patches of all views lie on its plane. view, sigma_m, inflation of their variance: each [P]."""

    view: NDArray[np.int64]
    patches: Patches
    sigma_m: Array
    inflation: Array

    @property
    def growth(self) -> Array:
        """[P]: sigma of each row over that at 1 m: the distance squared."""
        return np.asarray(self.patches.ray_z[:, 2] ** 2)

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """One row a patch: its height over the board."""
        p, sigma_m = shared.corrected(self.patches), self.sigma_m * shared.scale
        up = poses[self.view, 2, :3]
        residual = ((p * up).sum(axis=1) + poses[self.view, 2, 3]) / sigma_m
        by_point = up / sigma_m[:, None]
        by_shared = np.einsum("pi,pij->pj", by_point, shared.derivative(self.patches))
        by_shared[:, DEPTH_SCALE] -= residual / shared.scale
        weight, cost = robust(residual**2, 1.0 / self.inflation)
        return Rows(residual, self.view[:, None], by_motion(by_point, p)[:, None], by_shared, weight, cost)


@dataclass(frozen=True, eq=False)
class ObjectTerm:
    """Depth of the object: patches of two views lie on one surface. view [P].

    pairs [N, 2] of patches, the lower first; normal [N, 3]: unit, their mean, board axes; sigma_m, inflation [N].
    """

    view: NDArray[np.int64]
    patches: Patches
    pairs: NDArray[np.int64]
    normal: Array
    sigma_m: Array
    inflation: Array

    @property
    def growth(self) -> Array:
        """[N]: sigma of each row over that of a patch at 1 m."""
        return np.asarray(np.linalg.norm(self.patches.ray_z[self.pairs, 2] ** 2, axis=1))

    def rows(self, poses: Array, shared: Shared) -> Rows:
        """One row a pair: the distance between the two along their common normal."""
        p, by = shared.corrected(self.patches)[self.pairs], shared.derivative(self.patches)[self.pairs]
        view = self.view[self.pairs]
        R, t = poses[view, :3, :3], poses[view, :3, 3]
        placed = np.einsum("nkij,nkj->nki", R, p) + t
        sigma_m = self.sigma_m * shared.scale
        residual = ((placed[:, 0] - placed[:, 1]) * self.normal).sum(axis=1) / sigma_m
        along = np.einsum("nkji,nj->nki", R, self.normal / sigma_m[:, None]) * np.array([[1.0], [-1.0]])
        by_shared = np.einsum("nki,nkij->nj", along, by)
        by_shared[:, DEPTH_SCALE] -= residual / shared.scale
        weight, cost = robust(residual**2, 1.0 / self.inflation)
        return Rows(residual, view, by_motion(along, p), by_shared, weight, cost)


Depth = TypeVar("Depth", BoardTerm, ObjectTerm)


def by_motion(along: Array, points: Array) -> Array:
    """[..., 6]: derivative, by a small motion of the camera, of the coordinate of its points [..., 3] along [..., 3]."""
    return np.concatenate([along, np.cross(points, along)], axis=-1)


REACH_M = 0.012
"""Patches of one surface lie at most so far apart: about their own width."""
MIN_COSINE = 0.87
"""And their normals at most 30 degrees."""
NEIGHBOURS = 10
PARTNERS = 3
"""Of the nearest patches of other views, so many are paired with each."""


def match_patches(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> ObjectTerm:
    """The pairs at the present poses, each once, in order of index; as noisy as patches at 1 m are, times their growth."""
    none = np.zeros(0)
    if len(patches) < 2:
        return ObjectTerm(view, patches, np.zeros((0, 2), np.int64), np.zeros((0, 3)), none, none)
    R, t = poses[view, :3, :3], poses[view, :3, 3]
    points = np.einsum("pij,pj->pi", R, shared.corrected(patches)) + t
    normals = np.einsum("pij,pj->pi", R, patches.normal @ shared.T_cam_depth[:3, :3].T)  # kept where depth is stretched
    count = min(NEIGHBOURS + 1, len(points))
    distance, neighbour = cKDTree(points).query(points, k=count, distance_upper_bound=REACH_M)
    near = np.isfinite(distance)
    neighbour = np.where(near, neighbour, 0)

    def are_alike() -> NDArray[np.bool_]:
        return near & (np.einsum("pi,pki->pk", normals, normals[neighbour]) > MIN_COSINE)

    # The surface bends less over a patch than its normal's noise: the mean of the normals around it is taken.
    total = (normals[neighbour] * are_alike()[..., None]).sum(axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 0.5, total / np.maximum(length, 1e-9), normals)
    good = are_alike() & (view[neighbour] != view[:, None])
    good &= np.cumsum(good, axis=1) <= PARTNERS
    first, column = np.nonzero(good)
    pairs = np.unique(np.sort(np.stack([first, neighbour[first, column]], axis=1), axis=1), axis=0).astype(np.int64)
    normal = normals[pairs].sum(axis=1)
    term = ObjectTerm(view, patches, pairs, normal / np.linalg.norm(normal, axis=1, keepdims=True), none, none)
    return dataclasses.replace(term, sigma_m=term.growth, inflation=np.ones(len(pairs)))


# ---------------------------------------------------------------------------------------------- noise

FLOOR_M = 2e-4
"""No patch is taken to be better than this at 1 m: stored depth has a step of 1 mm, and its errors are not all seen."""
FEW_VIEWS = 4
INFLATION_OF_FEW = 30.0
"""Inflation where fewer views than this can tell: about as if a view's patches erred as one."""
VIEW_FLOOR_M = 5e-4
"""All the patches of a view together are not taken to be better than this: errors of depth that change with place and
distance, and that no correction of the capture has, do not average out. Good corners place a camera to 0.1 mm."""


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
        along = directions[:, kept].T @ (J.T @ (r * robust(r**2)[0]))
        misfit = float((along**2 / strength[kept]).sum())
        known = float(np.trace(J.T @ J @ pose_covariance[number]))
        ratios.append((misfit - known) / (rank * median_of_chi_square(rank)))
    if len(ratios) < FEW_VIEWS:
        return INFLATION_OF_FEW
    return max(1.0, float(np.median(ratios))) ** 2


def row_inflation(factor: float, sigma_m: Array, view: NDArray[np.int64]) -> Array:
    """[N]: inflation of each row of sigma_m [N], at least `factor`, so that no view's rows come to less than VIEW_FLOOR_M.

    view [N, k]: the views of each row.
    """
    count = np.max([np.bincount(column)[column] for column in view.T], axis=0)
    return np.maximum(factor, count * (VIEW_FLOOR_M / sigma_m) ** 2)


# ---------------------------------------------------------------------------------------------- all views

ROUNDS = 4
"""How often the object's patches are paired anew."""
NOISE_ROUNDS = 3
"""How often poses and the noise of corners are found one by the other: the second round changes sigma by a few percent."""
SURE_MARKERS = 12
"""Views of at least so many markers tell how noisy depth is, where there are a few of them."""


@dataclass(frozen=True, eq=False)
class Views:
    """The views of the problem in order: poses [V, 4, 4] to begin with, covariance [V, 6, 6] by their markers.

    index [V]: among all views of the capture; fixed [V]: a pose that was given by hand does not move; ambiguous [V]: a rival
    pose remains possible.
    """

    index: tuple[int, ...]
    observations: tuple[Observation, ...]
    poses: Array
    covariance: Array
    fixed: NDArray[np.bool_]
    ambiguous: tuple[bool, ...]
    camera: CaptureCamera
    sigma_px: Array

    def corner_term(self) -> CornerTerm:
        """All corners, with the camera held."""
        return CornerTerm.of([o.corners for o in self.observations], self.camera, self.sigma_px)

    def widening(self, place: int, single_px: float) -> float:
        """Factor of a view's covariance: whole markers are less noisy than corners (single_px); one marker has but its four."""
        single = (single_px / self.sigma_px[0]) ** 2
        return float(1.0 + max(0.0, single - 1.0) / max(1, self.observations[place].markers) ** 2)

    def sure(self, view: NDArray[np.int64]) -> NDArray[np.bool_]:
        """[N]: rows of views [N, k] by which the noise of depth is measured: those of many markers, or else all."""
        many = np.array([o.markers >= SURE_MARKERS for o in self.observations])
        chosen = np.all((many if many.sum() >= 4 else np.ones_like(many))[view], axis=1)
        return chosen if chosen.any() else np.ones_like(chosen)


def measure_corners(views: Views, spec: Estimation) -> Views:
    """The views with the poses and the noise of corners that are left once the growth of the printed squares is estimated.

    Sharpening, tone curves and spread ink move all edges of a marker alike: a view by itself takes that for a shorter distance.
    """
    corners, prior, poses, shared = views.corner_term(), np.zeros(SHARED), views.poses, Shared()
    prior[[GROWTH_M, GROWTH_PX]] = GROW_M, GROW_PX
    for _ in range(NOISE_ROUNDS):
        solution = minimise(Problem([corners], prior, np.zeros_like(views.fixed)), poses, shared, spec.max_iterations)
        poses, shared = solution.poses, solution.shared
        corners = corners.measured(corners.rows(poses, shared), spec)
    halves = pose_halves(corners.rows(poses, shared), len(poses))
    poses = np.where(views.fixed[:, None, None], views.poses, poses)
    covariance = halves @ halves.transpose(0, 2, 1)
    return dataclasses.replace(views, poses=poses, covariance=covariance, sigma_px=corners.sigma_px)


@dataclass(frozen=True, eq=False)
class Joint:
    """The solution with its covariance [D, D], that without the object, the prior [S], and the terms of depth as weighed."""

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
    terms: list[Term] = [views.corner_term()]
    shared, board, surface = Shared(), None, None
    if len(on_board):
        term = BoardTerm(board_view, on_board, DEPTH_SIGMA_M * on_board.ray_z[:, 2] ** 2, np.ones(len(on_board)))
        start = Problem([term], prior, np.ones_like(views.fixed))
        if spec.trust == "depth":  # a print of another size moves the cameras: they must be free
            start = Problem([*terms, term], prior, views.fixed)
        first = minimise(start, views.poses, shared, 30)
        shared, board = first.shared, _measured_board(term, views, first)
        terms.append(board)
    by_board = solution = minimise(Problem(terms, prior, views.fixed), views.poses, shared, spec.max_iterations)
    iterations, alike = solution.iterations, 1.0
    for _ in range(ROUNDS if len(on_object) else 0):
        pairs = match_patches(on_object, object_view, solution.poses, solution.shared)
        if iterations >= spec.max_iterations or not len(pairs.pairs):
            break
        surface, factor = _measured_object(pairs, views, solution)
        # Poses that have followed the object's depth no longer show how far it had pulled them: the first rounds tell.
        alike = max(alike, factor)
        surface = dataclasses.replace(
            surface, inflation=row_inflation(alike, surface.sigma_m, object_view[pairs.pairs])
        )
        problem = Problem([*terms, surface], prior, views.fixed)
        solution = minimise(problem, solution.poses, solution.shared, spec.max_iterations - iterations)
        iterations += solution.iterations
    solution = dataclasses.replace(solution, iterations=iterations)
    return Joint(solution, by_board, solution.covariance(), prior, board, surface)


def gather(patches: list[Patches]) -> tuple[Patches, NDArray[np.int64]]:
    """(the patches of all views in one piece, [P] index of the view of each)."""
    view = np.repeat(np.arange(len(patches)), [len(p) for p in patches])
    names = [field.name for field in dataclasses.fields(Patches)]
    return Patches(*[np.concatenate([getattr(p, name) for p in patches]) for name in names]), view


def _with_sigma(term: Depth, views: Views, solution: Solution) -> tuple[Depth, Rows, NDArray[np.bool_]]:
    """The term with the sigma of its patches by its own residuals, its rows, and which of them the noise is measured by."""
    growth = term.growth
    rows = dataclasses.replace(term, sigma_m=growth).rows(solution.poses, solution.shared)
    chosen = views.sure(rows.view)
    sigma = max(FLOOR_M, MAD * float(np.median(np.abs(rows.residual[chosen]))))  # of a patch at 1 m
    term = dataclasses.replace(term, sigma_m=sigma * growth)
    return term, term.rows(solution.poses, solution.shared), chosen


def _measured_board(term: BoardTerm, views: Views, solution: Solution) -> BoardTerm:
    """The term with the sigma of its patches and their inflation as this capture's own residuals have them."""
    term, rows, chosen = _with_sigma(term, views, solution)
    # What a plane tells: its height, along its normal, and the turn of the camera.
    up = solution.poses[:, 2, :3]
    by_plane = np.concatenate([1.0 / term.sigma_m[:, None], rows.by_view[:, 0, 3:]], axis=1)
    take = np.zeros((len(up), 4, 6))
    take[:, 0, :3], take[:, 1:, 3:] = up, np.eye(3)
    covariance = take @ views.covariance @ take.transpose(0, 2, 1)
    factor = inflation(rows.residual[chosen], by_plane[chosen], term.view[chosen], covariance)
    return dataclasses.replace(term, inflation=row_inflation(factor, term.sigma_m, rows.view))


def _measured_object(term: ObjectTerm, views: Views, solution: Solution) -> tuple[ObjectTerm, float]:
    """(the pairs with their sigma by their own residuals, inflation by both views of each)."""
    term, rows, chosen = _with_sigma(term, views, solution)
    view, by = rows.view[chosen].T.ravel(), rows.by_view[chosen].swapaxes(0, 1).reshape(-1, 6)
    return term, inflation(np.tile(rows.residual[chosen], 2), by, view, solution.of_views())
