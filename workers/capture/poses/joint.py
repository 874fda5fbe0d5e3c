"""The joint problem of a capture: corners, the board's depth and the object's, each weighed by its measured noise."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.captures import Estimation
from workers.capture.poses.matches import Matches, match_patches
from workers.capture.poses.noise import inflation, patch_sigma
from workers.capture.poses.observation import Observation, Patches
from workers.capture.poses.rows import POSE, SHARED
from workers.capture.poses.shared import Shared, prior_sigma
from workers.capture.poses.solve import Problem, Solution, Term, minimise
from workers.capture.poses.terms import BoardTerm, CornerTerm, ObjectTerm

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
    focal: Array
    corner_px: float

    def corner_term(self) -> CornerTerm:
        """All corners."""
        corners = [o.corners for o in self.observations]
        view = np.repeat(np.arange(len(corners)), [len(c.board) for c in corners])
        board, rays = np.concatenate([c.board for c in corners]), np.concatenate([c.rays for c in corners])
        return CornerTerm(view, board, rays, self.focal, self.corner_px)

    def sure(self) -> NDArray[np.bool_]:
        """[V]: views by which the noise of depth is measured."""
        many = np.array([o.markers >= SURE_MARKERS for o in self.observations])
        return many if many.sum() >= 4 else np.ones(len(many), bool)


@dataclass(frozen=True, eq=False)
class Joint:
    """The solution, the noise of depth that it was weighed with (sigma at 1 m, metres; inflation), and the pairs."""

    solution: Solution
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
        board = BoardTerm(board_view, on_board, spec.depth_sigma_m * on_board.ray_z[:, 2] ** 2, 1.0)
        start = Problem([corners, board] if spec.trust == "depth" else [board], prior, held)
        if spec.trust == "depth":  # a print of another size moves the cameras: they must be free
            start = dataclasses.replace(start, fixed=views.fixed)
        first = minimise(start, views.poses, shared, 30)
        shared = first.shared
        board = _measured_board(board, views, first)
    terms: list[Term] = [corners, *([board] if board else [])]
    solution = minimise(Problem(terms, prior, views.fixed), views.poses, shared, spec.max_iterations)
    surface, iterations = None, solution.iterations
    for _ in range(ROUNDS if len(on_object) else 0):
        if iterations >= spec.max_iterations:
            break
        matches = match_patches(on_object, object_view, solution.poses, solution.shared)
        measured = _measured_object(on_object, object_view, matches, views, solution)
        if measured is None:
            break
        # Poses that have followed the object's depth no longer show how far it had pulled them: the first rounds tell.
        most = max(measured.inflation, surface.inflation if surface else 1.0)
        surface = dataclasses.replace(measured, inflation=most)
        problem = Problem([*terms, surface], prior, views.fixed)
        before = solution
        solution = minimise(problem, before.poses, before.shared, spec.max_iterations - iterations)
        iterations += solution.iterations
    solution = dataclasses.replace(solution, iterations=iterations)
    return Joint(solution, solution.covariance(), prior, board, surface)


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
    return dataclasses.replace(term, sigma_m=sigma_m, inflation=factor)


def _plane_covariance(views: Views, poses: Array) -> Array:
    """[V, 4, 4]: of (height over the board along its normal, turn of the camera)."""
    take = np.zeros((len(poses), 4, POSE))
    take[:, 0, :3] = poses[:, 2, :3]
    take[:, 1:, 3:] = np.eye(3)
    return np.einsum("vij,vjk,vlk->vil", take, views.covariance, take)


def _measured_object(
    patches: Patches, view: NDArray[np.int64], matches: Matches, views: Views, found: Solution
) -> ObjectTerm | None:
    """The term of the pairs, weighed by their own residuals; None where there are none."""
    if not len(matches.pairs):
        return None
    a, b = matches.pairs.T
    growth = np.hypot(patches.ray_z[a, 2] ** 2, patches.ray_z[b, 2] ** 2)
    term = ObjectTerm(view, patches, matches.pairs, matches.normal, growth, 1.0)
    residual = term.rows(found.poses, found.shared).residual
    chosen = views.sure()[view[a]] & views.sure()[view[b]]
    chosen = chosen if chosen.any() else np.ones_like(chosen)
    sigma_m = patch_sigma(residual[chosen] * growth[chosen], growth[chosen]) * growth
    rows = dataclasses.replace(term, sigma_m=sigma_m).rows(found.poses, found.shared)
    # Each pair tells of both of its views.
    both = np.concatenate([rows.first[chosen], rows.second[chosen]])
    by = np.concatenate([rows.by_first[chosen], rows.by_second[chosen]])
    covariance = found.covariance()[:-SHARED, :-SHARED].reshape(len(views.poses), POSE, -1, POSE)
    own = covariance[range(len(views.poses)), :, range(len(views.poses))]
    factor = inflation(np.tile(rows.residual[chosen], 2), by, both, own)
    return dataclasses.replace(term, sigma_m=sigma_m, inflation=factor)
