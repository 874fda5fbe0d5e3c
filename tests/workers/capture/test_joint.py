"""The pieces of the joint problem: derivatives by finite differences, noise by its own residuals, pairs of patches."""

import numpy as np
import pytest

from schemas.base import Pose
from tests.kit.tiers import first_of
from tests.workers.capture.drawn import (
    HALF,
    LENS,
    Virtual,
    evidence_of,
    hand_held,
    make,
    observe,
    with_pixels,
)
from workers.capture.poses.corners import CornerTerm
from workers.capture.poses.estimates import estimate_joint
from workers.capture.poses.joint import (
    INFLATION_OF_FEW,
    BoardTerm,
    ObjectTerm,
    inflation,
)
from workers.capture.poses.observation import Observation, Patches
from workers.capture.poses.standing import object_groups
from workers.capture.poses.terms import (
    Shared,
    motion_between,
    moved,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import transform, translation

RNG = np.random.default_rng(0)
STEP = np.array([0.01, -0.02, 0.01, 0.02, -0.01, 0.03, -0.02, 0.01, 0.005, 2e-4, 0.1])
SIZE = len(STEP)
SHARED = Shared().moved(STEP)
POSES = np.stack(hand_held(RNG, 3))
VIEW = RNG.integers(0, 3, 12)
RAY = np.column_stack([RNG.uniform(-0.3, 0.3, (12, 2)), np.ones(12)])
PATCHES = Patches(RAY * RNG.uniform(0.5, 1.2, (12, 1)), RAY, -RAY, np.full(12, 0.001))
PAIRS = np.array([[0, 1], [2, 5], [3, 9]])
PAIRS = PAIRS[VIEW[PAIRS[:, 0]] != VIEW[PAIRS[:, 1]]]
SEEN = [observe(T, RNG, camera=LENS, ids=range(n, 35, 9)).corners for n, T in enumerate(POSES)]
FLAT, RAYS = (np.concatenate([getattr(c, name) for c in SEEN]) for name in ("board", "rays"))
NORMAL = np.tile(np.array([[0.6, 0, 0.8]]), (len(PAIRS), 1))
TERMS = {
    "corners": CornerTerm(
        np.repeat(range(3), [len(c.board) for c in SEEN]),
        FLAT,
        RAYS,
        np.array([912.37, 912.25]),
        np.array([0.2, 0.5, 0.9, 0.3]),
        np.ones(len(FLAT), bool),
    ),
    "board": BoardTerm(VIEW, PATCHES, np.full(12, 0.1), np.full(12, 2.0)),
    "object": ObjectTerm(VIEW, PATCHES, PAIRS, NORMAL, np.full(len(PAIRS), 0.1), np.ones(len(PAIRS))),
}


# ---------------------------------------------------------------------------------------------- terms


@pytest.mark.parametrize("name", TERMS)
def test_derivatives_of_each_term_equal_finite_differences(name):
    term = TERMS[name]
    rows = term.rows(POSES, SHARED)
    assert len(PAIRS) >= 2
    for axis, step in enumerate(1e-6 * np.eye(SIZE)):
        change = term.rows(POSES, SHARED.moved(step)).residual - term.rows(POSES, SHARED.moved(-step)).residual
        assert rows.by_shared[:, axis] == pytest.approx(change / 2e-6, rel=1e-4, abs=1e-3)
    for number in range(3):
        for axis, step in enumerate(1e-6 * np.eye(6)):
            ahead, back = POSES.copy(), POSES.copy()
            ahead[number], back[number] = moved(POSES[number], step), moved(POSES[number], -step)
            change = term.rows(ahead, SHARED).residual - term.rows(back, SHARED).residual
            own = np.where(rows.view == number, rows.by_view[:, :, axis], 0).sum(axis=1)
            assert own == pytest.approx(change / 2e-6, rel=1e-4, abs=2e-2)


def test_a_smaller_world_does_not_fit_better():
    """Depth and poses scaled alike leave residuals over sigma as they are: noise shrinks with the world."""
    small = POSES.copy()
    small[:, :3, 3] *= 0.9
    for name in ("board", "object"):
        before, after = TERMS[name].rows(POSES, Shared()), TERMS[name].rows(small, Shared(scale=0.9))
        assert after.residual == pytest.approx(before.residual)


SLOPES = np.array([1.0, -1.0, 1.0, -1.0])[:, None]
"""Two corners of each edge move against one another."""


# ---------------------------------------------------------------------------------------------- noise of corners


def grown(quads, by_px):
    """Corners [M, 4, 2] of quads whose edges all move outwards by half of by_px [M]: where the shifted lines meet."""
    after = np.roll(quads, -1, axis=1)
    lines = np.cross(*(np.concatenate([p, np.ones((*p.shape[:2], 1))], axis=2) for p in (quads, after)))
    lines /= np.linalg.norm(lines[..., :2], axis=2, keepdims=True)
    inwards = np.sign((lines[..., :2] * quads.mean(axis=1, keepdims=True)).sum(axis=2) + lines[..., 2])
    lines[..., 2] += inwards * 0.5 * by_px[:, None]
    met = np.cross(np.roll(lines, 1, axis=1), lines)
    return met[..., :2] / met[..., 2:]


@pytest.mark.parametrize("uneven_px", first_of([(0.3, 0.15), (0.0, 0.0), (0.3, 0.0), (0.0, 0.15)], 0, 2))
def test_markers_of_uneven_size_and_shape_move_no_camera_more_than_its_sigma_says(uneven_px):
    """Every marker is seen too small by 0.2 px and by a number of its own; slopes move the ends of its edges apart."""
    (growth_px, shape_px), off, noise = uneven_px, [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        seen, truth = [], hand_held(rng, 10)
        for number, T in enumerate(truth):
            one = observe(T, rng, number=number, corner_px=0.0)
            quads = one.corners.pixels.reshape(-1, 4, 2)
            quads = grown(quads, rng.normal(-0.2, growth_px, len(quads)))
            noisy = rng.normal(0, 0.05, quads.shape) + shape_px * rng.standard_normal((len(quads), 1, 2)) * SLOPES
            pixels = (quads + noisy).reshape(-1, 2)
            seen.append(with_pixels(one, pixels))
        evidence = evidence_of(seen)
        found = estimate_joint(evidence)
        assert found.camera is None and not any("camera.json" in note for note in found.notes)
        noise.append(float(next(note for note in found.notes if "corner" in note).split()[-2]))
        for view, T in zip(found.views, truth, strict=True):
            off.append(motion_between(view.T_board_cam, T)[:3] / np.sqrt(np.diag(view.covariance)[:3]))
    assert np.mean(noise) == pytest.approx(0.05, rel=0.1)
    assert 0.8 < np.sqrt(np.mean(np.square(off))) < 1.2


# ---------------------------------------------------------------------------------------------- noise of depth

V, N = 40, 60
OF_VIEW = np.repeat(np.arange(V), N)


def residuals(rng, together):
    """Residuals of planes in sigma: independent, and what a whole view has in common."""
    J = np.column_stack([np.ones(V * N), rng.uniform(-1, 1, (V * N, 2))])
    common = rng.normal(0, together, (V, 3))
    return rng.standard_normal(V * N) + (J * common[OF_VIEW]).sum(axis=1), J


def test_patches_that_err_alike_are_inflated_and_misfit_that_unknown_poses_explain_is_not():
    none = np.zeros((V, 3, 3))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        assert inflation(*residuals(rng, 0.0), OF_VIEW, none) < 1.5
        assert inflation(*residuals(rng, 0.5), OF_VIEW, none) > 8  # of 60 patches, a common error of half a sigma
    residual, J = residuals(np.random.default_rng(3), 0.3)
    assert inflation(residual, J, OF_VIEW, np.tile(0.3**2 * np.eye(3), (V, 1, 1))) < 3
    assert inflation(residual, J, OF_VIEW, none) > 6
    few = OF_VIEW < 3
    assert inflation(residual[few], J[few], OF_VIEW[few], none) == INFLATION_OF_FEW


# ---------------------------------------------------------------------------------------------- patches of the object


STOOD = {
    "still": [range(14)],
    "once": [range(9), range(9, 14)],
    "back and forth": [[0, 1, 2, 3, 7, 8, 9, 10, 11, 12, 13], [4, 5, 6]],
    "twice": [range(6), range(6, 11), range(11, 14)],
    "far away": [range(9), [], [], range(9, 14)],
    "one view": [[0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12, 13], [7]],
}


@pytest.mark.parametrize("how", first_of(STOOD, 0, 4))
def test_views_are_grouped_by_where_the_object_stood(how):
    for seed in range(3):
        truth, evidence = make(Virtual(views=14, k=HALF, seed=seed))
        shifts = [
            translation(0, 0, 0),
            translation(0.03, 0.01, 0),
            translation(-0.02, 0.025, 0),
            translation(0.15, 0, 0),
        ]
        place = [next(n for n, group in enumerate(STOOD[how]) if number in group) for number in range(14)]
        poses = np.stack([shifts[n] @ T for n, T in zip(place, truth, strict=True)])
        found, clutter = object_groups(evidence.observations, poses, Shared(), 0.001, np.zeros(14))
        assert found == [list(group) for group in STOOD[how] if len(group)], seed
        assert how == "far away" or not any(out.any() for out in clutter)


@pytest.mark.minute
def test_views_without_depth_or_too_unsure_of_their_poses_are_not_said_to_see_another_place():
    truth, evidence = make(Virtual(views=14, k=HALF))
    seen = [observe(T, np.random.default_rng(0)) for T in truth]
    assert object_groups(seen, truth, Shared(), 0.001, np.zeros(14))[0] == [list(range(14))]
    poses = np.stack([translation(0.01 * (n >= 7), 0, 0) @ T for n, T in enumerate(truth)])
    for unsure_m, groups in ((0.0, 2), (0.01, 1)):
        unsure = np.where(np.arange(14) >= 7, unsure_m, 0.0)
        assert len(object_groups(evidence.observations, poses, Shared(), 0.001, unsure)[0]) == groups


NOISE_M, RISEN = 4e-4, np.array([0.0, 0.75, 0.66])
"""Of a pixel; and the normal of a screen that leans back behind the x axis."""


def laptop(T: Pose, rng: np.random.Generator) -> Patches:
    """Patches 10 mm wide of an open laptop whose flat half is the board: those that face the camera and rise over it."""
    rays = np.stack(np.meshgrid(*[np.arange(-0.3, 0.3, 0.0024)] * 2, [1.0]), axis=-1).reshape(250, 250, 3)
    along, start = rays @ T[:3, :3].T, T[:3, 3]
    flat, risen = -start[2] / along[..., 2], -(start @ RISEN) / (along @ RISEN)
    x, _, height = np.moveaxis(start + risen[..., None] * along, 2, 0)
    on_screen = (np.abs(x) < 0.08) & (height > 0.0) & (height < 0.09) & (along @ RISEN < 0)
    z = np.where(on_screen, risen, flat) + rng.normal(0.0, NOISE_M, flat.shape)
    block = (z[..., None] * rays).reshape(50, 5, 50, 5, 3).swapaxes(1, 2).reshape(-1, 25, 3)
    middle = block.mean(axis=1)
    _, size, axes = np.linalg.svd(block - middle[:, None], full_matrices=False)
    normal = -np.sign((axes[:, 2] * middle).sum(axis=1))[:, None] * axes[:, 2]
    faces = -(normal * middle).sum(axis=1) > 0.35 * np.linalg.norm(middle, axis=1)
    kept = faces & (size[:, 2] / 5 < 3e-3) & (transform(T, middle)[:, 2] > 1e-3)
    return Patches(middle[kept], (middle / middle[:, 2:])[kept], normal[kept], size[kept, 2] / 5)


def test_patches_across_a_crease_do_not_tell_that_the_object_moved():
    """Of an open laptop two views see little but the crease: planes across it lie up to 5 mm beside either side of it."""
    views = [(1.0, 0.9), (0.4, 0.8), (-0.4, 1.0), (-1.2, 0.9), (0.0, 0.7), (3.1, 1.05), (2.5, 1.1)]
    rng, middle = np.random.default_rng(0), np.array([0.0, 0.0, 0.03])
    poses = np.stack([orbit_pose(middle, inclination, yaw + np.pi / 2, 0.75) for yaw, inclination in views])
    seen = [Observation(n, SEEN[0], object_patches=laptop(T, rng)) for n, T in enumerate(poses)]
    assert object_groups(seen, poses, Shared(), 3e-4, np.full(7, 1e-4))[0] == [list(range(7))]
