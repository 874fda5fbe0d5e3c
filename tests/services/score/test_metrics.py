"""Metrics of predictions against what is not ours: exact arithmetic, skimage, trimesh, published formulas, geometry of boxes."""

import math

import flip_evaluator
import numpy as np
import pytest
import trimesh
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from schemas.errors import InputError
from schemas.scene.shape import Mesh
from services.score import images
from services.score.images import align_depth, score_colour, score_depth
from services.score.items import Asked, check_depth
from services.score.items import _read_volume as read_volume
from services.score.pose import check_distance, score_pose, score_volume, symmetries_of
from services.score.shape import align_shape, score_shape
from tests.kit.contacts import mesh_of
from tests.kit.tiers import first_of
from workers.geometry.frames import transform

CASES = 100
cases_each = pytest.mark.parametrize("cases", [25, pytest.param(CASES, marks=pytest.mark.slow)])
"""Of what agrees case by case; shares of many cases need them all."""
EXACT = 1e-6
WORST_M = 0.5
K = np.array([[525.0, 0.0, 320.0], [0.0, 520.0, 240.0], [0.0, 0.0, 1.0]])


def agree(ours, theirs):
    assert ours == pytest.approx(theirs, rel=EXACT, abs=1e-12, nan_ok=True)


def rigid(rng, turn_rad, shift_m):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * turn_rad).as_matrix()
    T[:3, 3] = rng.normal(size=3) * shift_m
    return T


# ---------------------------------------------------------------------------------------------- images


def test_depth_is_exact_arithmetic_in_stored_units(monkeypatch):
    monkeypatch.setattr(images, "BLOCK", 50)
    rng = np.random.default_rng(1)
    for _ in range(CASES):
        true = rng.integers(500, 9000, (12, 17)) * (rng.random((12, 17)) > 0.1)
        off = rng.choice([0, 1, 4, 5, 6, 10, 11, 25, 26, 50, 51, 400, 3000], true.shape)
        units = np.where(rng.random(true.shape) > 0.2, true + off * rng.choice([-1, 1], true.shape), 0)
        no_depth = rng.choice([math.nan, math.inf, -1.0], true.shape)
        shown = np.where(rng.random(true.shape) < 0.1, no_depth, units / 5000)
        predicted = np.where(shown == units / 5000, units.clip(0), 0)
        parts = {
            name: rng.random(true.shape) < share for name, share in {"object": 0.3, "scene": 1.0, "seen": 0.02}.items()
        }
        ours = score_depth(shown, true / 5000, parts, WORST_M)
        for name, part in parts.items():
            pairs = [(int(d), int(t)) for d, t in zip(predicted[part], true[part], strict=True) if t > 0]
            agree({key: value for key, value in ours.items() if key.startswith(name)}, depth_by_hand(name, pairs))


def depth_by_hand(name, pairs):
    kept = [(d, t) for d, t in pairs if d]
    n, worst = len(pairs) or math.nan, round(5000 * WORST_M)
    errors = [min(abs(d - t), worst) if d else worst for d, t in pairs]
    found = {"mae_m": sum(errors) / n / 5000, "rmse_m": math.sqrt(sum(e * e for e in errors) / n) / 5000}
    found |= {"abs_rel": sum(min(abs(d - t) / t, 1) if d else 1 for d, t in pairs) / n}
    found |= {"holes": (n - len(kept)) / n, "pixels": len(pairs)}
    found |= {f"within_{limit}mm": sum(e <= 5 * limit for e in errors) / n for limit in (1, 2, 5, 10)}
    found["auc_50mm"] = sum(max(250 - e, 0) for e in errors) / 250 / n
    found |= {f"delta{k}": sum(4**k * max(each) < 5**k * min(each) for each in kept) / n for k in (1, 2, 3)}
    return {f"{name}.{metric}": value for metric, value in found.items()}


def noisy_images(rng, low, high):
    height, width = rng.integers(low, high, 2)
    true = rng.integers(0, 256, (height // 8 + 1, width // 8 + 1, 3)).repeat(8, 0).repeat(8, 1)[:height, :width]
    predicted = true + rng.normal(0.0, rng.uniform(1.0, 60.0), true.shape)
    return np.clip(predicted, 0, 255).astype(np.uint8), true.astype(np.uint8)


@cases_each
def test_colour_agrees_with_skimage_and_with_the_package_of_flip(cases):
    rng = np.random.default_rng(2)
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    for _ in range(cases):
        predicted, true = noisy_images(rng, 11, 60)
        part = rng.random(true.shape[:2]) < 0.2
        ours = score_colour(predicted, true, {"object": part, "none": part & ~part})
        agree(ours["image.psnr_db"], peak_signal_noise_ratio(true, predicted))
        agree(ours["object.psnr_db"], peak_signal_noise_ratio(true[part], predicted[part]))
        ssim, likeness = structural_similarity(true, predicted, data_range=255, channel_axis=2, full=True, **window)
        agree([ours["image.ssim"], ours["object.ssim"]], [ssim, likeness[part].mean()])
        residuals = ((image[part] - image[part].mean(axis=0)).ravel() for image in (predicted, true))
        agree(ours["object.ncc"], np.corrcoef(*residuals)[0, 1])
        assert all(math.isnan(ours[f"none.{name}"]) for name in ("ncc", "psnr_db", "ssim"))
        floats = (image.astype(np.float32) / np.float32(255.0) for image in (true, predicted))
        agree(ours["image.flip"], np.float64(flip_evaluator.evaluate(*floats, "LDR", applyMagma=False)[0]).mean())
        assert math.isnan(ours["image.ms_ssim"])
        assert score_colour(predicted, true, {}, flip=False)["image.flip"] is None


@pytest.mark.minute
@cases_each
def test_ms_ssim_is_the_published_product_of_five_scales(cases):
    rng = np.random.default_rng(3)
    for _ in range(cases):
        predicted, true = noisy_images(rng, 176, 200)
        ours = score_colour(predicted, true, {})["image.ms_ssim"]
        agree(ours, ms_ssim_by_hand(predicted.astype(float), true.astype(float)))


def ms_ssim_by_hand(a, b):
    """Wang, Simoncelli and Bovik 2003 with one two-dimensional window, about the windows' means by deviations from 128."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = (np.outer(line, line) / line.sum() ** 2)[:, :, None]
    product = 1.0
    for scale, power in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        x, y = a - 128.0, b - 128.0
        m, n, xx, yy, xy = (fftconvolve(each, window, "valid", axes=(0, 1)) for each in (x, y, x * x, y * y, x * y))
        contrast = (2 * (xy - m * n) + 58.5225) / (xx - m * m + yy - n * n + 58.5225)
        m, n = m + 128.0, n + 128.0
        light = (2 * m * n + 6.5025) / (m * m + n * n + 6.5025) if scale == 4 else 1.0
        product *= max(np.mean(light * contrast), 0.0) ** power
        rows, columns = (size // 2 for size in a.shape[:2])
        a, b = (x[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 3).mean((1, 3)) for x in (a, b))
    return product


# ---------------------------------------------------------------------------------------------- poses and volumes


@cases_each
def test_pose_errors_are_those_of_the_bop_toolkit(cases):
    rng = np.random.default_rng(4)
    for case in range(cases):
        points, symmetries = rng.normal(size=(40, 3)) * 0.05, [rigid(rng, 2.0, 0.01) for _ in range(case % 4)]
        true = rigid(rng, 2.0, 0.1)
        true[2, 3] += 1.5
        predicted = true @ rigid(rng, 0.3, 0.02)
        ours = score_pose(predicted, true, points, symmetries, K)

        def place(T, points=points):
            return np.array([T[:3, :3] @ p + T[:3, 3] for p in points])

        def image(T, place=place):
            return np.array([(K @ p)[:2] / p[2] for p in place(T)])

        same = [true @ S for S in (np.eye(4), *symmetries)]
        apart = np.linalg.norm(place(predicted)[:, None] - place(true)[None], axis=2)
        theirs = {
            "add_m": np.diag(apart).mean(),
            "add_s_m": apart.min(axis=0).mean(),
            "mssd_m": min(np.linalg.norm(place(predicted) - place(T), axis=1).max() for T in same),
            "mspd_px": min(np.linalg.norm(image(predicted) - image(T), axis=1).max() for T in same),
            "rotation_deg": min(Rotation.from_matrix(T[:3, :3].T @ predicted[:3, :3]).magnitude() for T in same)
            * 180
            / math.pi,
            "translation_m": math.dist(predicted[:3, 3], true[:3, 3]),
        }
        agree(ours, theirs)


def prism(sides, radius, height):
    return mesh_of(trimesh.creation.cylinder(radius, height, sections=sides))


TURNS = {
    "a box of three lengths": (mesh_of(trimesh.creation.box((0.1, 0.2, 0.05))), 4),
    "a box on a square": (mesh_of(trimesh.creation.box((0.1, 0.1, 0.05))), 8),
    "a cube off the origin": (mesh_of(trimesh.creation.box((0.1,) * 3, rigid(np.random.default_rng(0), 0.0, 0.1))), 24),
    "a prism on a triangle": (prism(3, 0.05, 0.1), 6),
    "a can": (prism(128, 0.03, 0.1), 2 * 180),
    "a cone": (mesh_of(trimesh.creation.cone(0.04, 0.1, sections=128)), 180),
    "two boxes": (
        mesh_of(trimesh.util.concatenate([trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box(
            bounds=[[0.05, -0.05, 0.02], [0.1, 0.03, 0.05]])])), 1),
}  # fmt: skip
"""A body, and how many turns of its group are told, any turn counting as 180."""


@pytest.mark.parametrize(("body", "count"), TURNS.values(), ids=TURNS)
def test_a_body_looks_the_same_after_as_many_turns_as_its_group_has_and_those_cost_no_error(body, count):
    turns = symmetries_of(body)
    assert len(turns) == count
    true = rigid(np.random.default_rng(1), 2.0, 0.1)
    true[2, 3] += 1.0
    for turn in turns[:: max(1, count // 20)]:
        scores = score_pose(true @ turn, true, body.vertices, turns, K)
        assert max(scores["mssd_m"], scores["rotation_deg"], scores["mspd_px"]) < 1e-6
        assert scores["add_s_m"] < 0.002


@pytest.mark.minute
def test_what_is_aligned_is_what_was_asked_for():
    rng = np.random.default_rng(6)
    true = rng.uniform(1.0, 3.0, (40, 50))
    holes = rng.random(true.shape) < 0.1
    for how, predicted in (("scale", true / 3.0), ("similarity", (true - 0.4) / 3.0)):
        aligned = align_depth(np.where(holes, 0.0, predicted), true, how)
        assert (aligned[holes] == 0.0).all()
        np.testing.assert_allclose(aligned[~holes], true[~holes], rtol=1e-12)
    body = TURNS["two boxes"][0]
    for seed in range(10):
        T = rigid(np.random.default_rng(seed), 0.3, 0.02)
        T[:3] *= 0.5 + 0.2 * seed
        _, found = align_shape(Mesh(transform(T, body.vertices), body.faces), body, "similarity", seed)
        np.testing.assert_allclose(found @ T, np.eye(4), atol=2e-5)
        grown = Mesh(body.vertices * (0.5 + 0.2 * seed), body.faces)
        moved, found = align_shape(grown, body, "scale", seed)
        np.testing.assert_allclose(moved.vertices, body.vertices, atol=1e-6)


def test_volume_counts_points_one_by_one():
    rng = np.random.default_rng(5)
    for case in range(CASES):
        true, distance = rng.normal(size=50), case % 2 == 0
        predicted = np.where(rng.random(50) < 0.1, math.nan, true + rng.normal(size=50) * 0.5)
        sign, level = (-1.0, 0.0) if distance else (1.0, 0.5)
        rows = [(sign * (d - level) > 0, sign * (t - level) > 0, d, t) for d, t in zip(predicted, true, strict=True)]
        either = [row for row in rows if row[0] or row[1] or math.isnan(row[2])]
        ours = score_volume(predicted, true, distance)
        agree(ours["iou"], sum(d and t for d, t, _, _ in either) / len(either))
        agree(ours["accuracy"], sum(d == t and not math.isnan(value) for d, t, value, _ in rows) / 50)
        errors = [abs(d - t) for _, _, d, t in rows if not math.isnan(d)]
        assert ours["distance_mae_m"] == (pytest.approx(sum(errors) / len(errors)) if distance else None)


# ---------------------------------------------------------------------------------------------- surfaces


def test_a_cloud_s_distances_are_those_of_trimesh():
    rng, off = np.random.default_rng(6), []
    for _ in range(CASES):
        hull = trimesh.PointCloud(rng.normal(size=(12, 3)) * 0.05).convex_hull
        cloud = rng.normal(size=(30, 3)) * 0.06
        ours = score_shape(cloud, mesh_of(hull), hull.scale, 2000)
        away = trimesh.proximity.closest_point(hull, cloud)[1]
        agree((ours["accuracy_m"], ours["accuracy_m.sampling"]), (away.mean(), 0.0))
        points = surface_samples(hull, 8000, rng)
        back = np.linalg.norm(points[:, None] - cloud[None], axis=2).min(axis=1)
        theirs = surface_by_hand(away, back, hull.scale)
        off.append([abs(ours[name] - value) / (ours[f"{name}.sampling"] + 1e-9) for name, value in theirs.items()])
    assert np.mean(np.array(off) > 1.0) < 0.01 and np.max(off) < 1.5


def surface_samples(mesh, count, rng):
    """Points uniform by area by the weights of a Dirichlet distribution."""
    corners = np.asarray(mesh.triangles)
    face = rng.choice(len(corners), count, p=mesh.area_faces / mesh.area)
    return np.einsum("nk,nkd->nd", rng.dirichlet((1, 1, 1), count), corners[face])


def surface_by_hand(there, back, diagonal):
    def f(limit):
        p, r = np.mean(there < limit), np.mean(back < limit)
        return 2 * p * r / (p + r) if p + r else 0.0

    chamfer = (there.mean() + back.mean()) / 2
    return {
        "accuracy_m": there.mean(),
        "completeness_m": back.mean(),
        "chamfer_l1_m": chamfer,
        "chamfer_l1_rel": chamfer / diagonal,
        "chamfer_l2_m2": (np.square(there).mean() + np.square(back).mean()) / 2,
        **{f"fscore_{k}mm": f(k / 1000) for k in (1, 2, 5)},
        "fscore_1pct": f(diagonal / 100),
        "hausdorff95_m": max(np.percentile(there, 95), np.percentile(back, 95)),
    }


def box_distance(points, half):
    """(distance to the surface of a box about the origin, which axes the nearest sides have [N, 3])."""
    beyond = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    nearest = np.where(outside[:, None] > 0, beyond > 0, beyond == beyond.max(axis=1, keepdims=True))
    return np.where(outside > 0, outside, -beyond.max(axis=1)), nearest


def box_samples(half, count, rng):
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    points = rng.uniform(-1.0, 1.0, (count, 3)) * half
    points[np.arange(count), axis] = half[axis] * rng.choice([-1, 1], count)
    return points, axis


@pytest.mark.minute
def test_boxes_differ_as_their_geometry_says_within_the_stated_sampling_error():
    rng, off = np.random.default_rng(7), []
    for _ in range(CASES):
        (a, b), T = rng.uniform(0.02, 0.06, (2, 3)), rigid(rng, 0.1, 0.004)
        b = np.where(rng.random(3) < 0.5, a + rng.normal(size=3) * 0.002, b)
        diagonal = 2 * float(np.linalg.norm(b))
        predicted, true = mesh_of(trimesh.creation.box(2 * a), T), mesh_of(trimesh.creation.box(2 * b))
        ours = score_shape(predicted, true, diagonal, 2000)
        (own, own_axis), (points, axis) = box_samples(a, 40_000, rng), box_samples(b, 40_000, rng)
        there, met = box_distance(own @ T[:3, :3].T + T[:3, 3], b)
        back, met_back = box_distance((points - T[:3, 3]) @ T[:3, :3], a)
        dots = np.abs(T[:3, :3])[:, own_axis].T, np.abs(T[:3, :3])[axis]
        theirs = surface_by_hand(there, back, diagonal)
        least = np.where(np.vstack([met, met_back]), np.vstack(dots), 9.0).min(axis=1).mean()
        most = np.where(np.vstack([met, met_back]), np.vstack(dots), 0.0).max(axis=1).mean()
        theirs["normal_consistency"] = np.clip(
            ours["normal_consistency"], least, most
        )  # either side of an edge may be nearest
        off.append([abs(ours[name] - value) / ours[f"{name}.sampling"] for name, value in theirs.items()])
    assert np.mean(np.array(off) > 1.0) < 0.01 and np.max(off) < 1.5


@cases_each
def test_the_common_volume_of_closed_boxes_is_exact_however_they_are_wound_or_cut_up(cases):
    rng = np.random.default_rng(8)
    for case in range(cases):
        (a, b), shift, T = rng.uniform(0.02, 0.06, (2, 3)), rng.normal(size=3) * 0.01, rigid(rng, 2.0, 0.1)
        box = mesh_of(trimesh.creation.box(2 * a, np.vstack([np.c_[np.eye(3), shift], [0, 0, 0, 1]])), T)
        if case % 3 == 1:
            box = Mesh(box.vertices, np.ascontiguousarray(box.faces[:, ::-1]))
        if case % 3 == 2:  # two bodies that overlap
            halves = [trimesh.creation.box(2 * a * (0.6, 1, 1)) for _ in range(2)]
            for side, half in zip((-0.4, 0.4), halves, strict=True):
                half.apply_translation(shift + np.array([side * a[0], 0, 0]))
            box = mesh_of(trimesh.util.concatenate(halves), T)
        common = np.prod(np.maximum(np.minimum(a + shift, b) - np.maximum(shift - a, -b), 0.0))
        ours = score_shape(box, mesh_of(trimesh.creation.box(2 * b), T), 0.1, 40)
        agree((ours["iou"], ours["iou.sampling"]), (common / (8 * a.prod() + 8 * b.prod() - common), 0.0))


@pytest.mark.minute
def test_the_common_volume_of_open_shapes_is_where_solid_angles_say_inside():
    rng, off = np.random.default_rng(9), []
    for _ in range(CASES):
        shape = trimesh.PointCloud(rng.normal(size=(10, 3)) * 0.05).convex_hull
        whole, T = mesh_of(shape), rigid(rng, 0.2, 0.01)
        opened = Mesh(mesh_of(shape, T).vertices, whole.faces[2:])
        ours = score_shape(opened, whole, 0.1, 2000)
        corners = np.concatenate([opened.vertices, whole.vertices])
        points = rng.uniform(corners.min(axis=0), corners.max(axis=0), (8000, 3))
        one, other = (np.abs(turns(points, mesh.vertices[mesh.faces])) > 0.5 for mesh in (opened, whole))
        off.append(abs(ours["iou"] - (one & other).sum() / (one | other).sum()) / ours["iou.sampling"])
    assert np.mean(np.array(off) > 1.0) < 0.02 and max(off) < 1.5


def turns(points, triangles):
    """The winding number by the solid angles of triangles (van Oosterom and Strackee 1983)."""
    total = np.zeros(len(points))
    for corners in triangles:
        a, b, c = (corner - points for corner in corners)
        la, lb, lc = (np.linalg.norm(each, axis=1) for each in (a, b, c))
        ab, bc, ca = ((x * y).sum(axis=1) for x, y in ((a, b), (b, c), (c, a)))
        total += np.arctan2((a * np.cross(b, c)).sum(axis=1), la * lb * lc + ab * lc + bc * la + ca * lb)
    return total / (2 * np.pi)


def bumpy(seed, size=0.1):
    sphere = trimesh.creation.icosphere(2, size)
    sphere.vertices *= 1.0 + np.random.default_rng(seed).normal(size=(len(sphere.vertices), 1)) * 0.03
    return sphere


OPEN = Mesh(mesh_of(bumpy(2)).vertices, mesh_of(bumpy(2)).faces[40:])


@pytest.mark.parametrize("predicted", first_of([mesh_of(bumpy(1)), mesh_of(bumpy(1)).vertices, OPEN], 1))
def test_ten_seeds_lie_within_the_stated_sampling_error_and_it_is_not_overstated(predicted):
    truth = mesh_of(bumpy(3))
    best = score_shape(predicted, truth, 0.34, 400_000, 99)
    seeds = [score_shape(predicted, truth, 0.34, 8000, seed) for seed in range(10)]
    for name in (name for name in best if f"{name}.sampling" in best and best[name] is not None):
        values, stated = (np.array([each[key] for each in seeds]) for key in (name, f"{name}.sampling"))
        assert (abs(values - best[name]) <= stated + best[f"{name}.sampling"]).all(), name
        assert name.startswith("fscore") or 3 * values.std() >= 0.3 * stated.mean(), name


# ---------------------------------------------------------------------------------------------- truth, and nothing

TORUS, BOX = trimesh.creation.torus(0.05, 0.02), trimesh.creation.box((0.1, 0.2, 0.05))
MOVED = trimesh.creation.box((0.1, 0.1, 0.1), rigid(np.random.default_rng(0), 1.0, 0.03))
SHAPES = {
    "torus": mesh_of(TORUS),
    "ring": mesh_of(trimesh.creation.annulus(0.03, 0.05, 0.1)),
    "overlapping": mesh_of(trimesh.util.concatenate([BOX, MOVED])),
    "open": OPEN,
    "seams": Mesh(TORUS.triangles.reshape(-1, 3), np.arange(TORUS.faces.size, dtype=np.int32).reshape(-1, 3)),
    "inside out": Mesh(mesh_of(BOX).vertices, mesh_of(BOX).faces[:, ::-1].copy()),
    "sliver": Mesh(mesh_of(BOX).vertices, np.vstack([mesh_of(BOX).faces, [[0, 0, 1]]]).astype(np.int32)),
}


@pytest.mark.parametrize("mesh", SHAPES.values(), ids=SHAPES.keys())
def test_a_true_shape_scores_nothing_but_full_marks(mesh):
    ours = score_shape(mesh, mesh, 0.2, 4000)
    for name in (name for name in ours if not name.endswith(".sampling")):
        full = name.startswith(("fscore", "iou", "normal"))
        assert ours[name] == pytest.approx(1.0 if full else 0.0, abs=1e-9), name


def test_true_images_volumes_and_poses_score_nothing_but_full_marks():
    rng = np.random.default_rng(10)
    depth, image = rng.uniform(0.5, 3.0, (180, 200)), rng.integers(0, 256, (180, 200, 3), dtype=np.uint8)
    ours = score_depth(depth, depth, {"scene": depth > 0}, WORST_M)
    assert [ours.pop(f"scene.{name}") for name in ("mae_m", "rmse_m", "abs_rel", "holes")] == [0.0] * 4
    assert set(ours.values()) == {1.0, depth.size}
    for same in (image, image * 0, image * 0 + 255):
        ours = score_colour(same, same, {"object": depth > 1.0})
        assert [ours.pop(f"{part}.psnr_db") for part in ("image", "object")] == [math.inf] * 2
        assert ours.pop("image.flip") == 0.0 and list(ours.values()) == pytest.approx([1.0] * 4, abs=1e-12)
    T = rigid(rng, 1.0, 0.1)
    T[2, 3] = 1.0
    assert max(score_pose(T, T, rng.normal(size=(9, 3)) * 0.1, [], K).values()) < 1e-9
    assert score_volume(depth[0] - 1, depth[0] - 1, True) == {"iou": 1.0, "accuracy": 1.0, "distance_mae_m": 0.0}


def test_what_cannot_be_scored_is_nan_or_none_and_counts_of_misses_stay():
    none, ones = np.zeros((4, 5)), np.ones((4, 5))
    everywhere = {"scene": ones > 0, "empty": none > 0}
    for holes in (none, ones * math.nan, -ones, ones * math.inf):
        ours = score_depth(holes, ones, everywhere, WORST_M)
        assert ours["scene.mae_m"] == WORST_M and ours["scene.holes"] == 1.0 and ours["scene.within_10mm"] == 0.0
        blind = score_depth(ones, holes, everywhere, WORST_M)
        for part, found in (("scene", blind), ("empty", ours)):
            values = {name: value for name, value in found.items() if name.startswith(part)}
            assert values.pop(f"{part}.pixels") == 0.0 and np.isnan(list(values.values())).all()
    image = np.zeros((20, 20, 3), np.uint8)
    assert np.isnan(list(score_colour(image[:0], image[:0], {}).values())).all()
    grey = score_colour(image + 128, image + np.arange(20, dtype=np.uint8)[:, None], {"object": image[..., 0] == 0})
    assert grey["object.ncc"] == 0.0
    box = SHAPES["torus"]
    bad = box.vertices * np.where(np.arange(len(box.vertices)) == 3, math.nan, 1.0)[:, None]
    flat, gone = Mesh(box.vertices * 0, box.faces), Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    wild = Mesh(box.vertices, box.faces + 9999)
    pairs = [(each, box) for each in (Mesh(bad, box.faces), bad, flat, gone, wild, gone.vertices)]
    for predicted, true in [*pairs, (box, flat), (box, gone)]:
        assert {str(value) for value in score_shape(predicted, true, 0.2, 40).values()} == {"nan", "None"}
    assert {str(value) for value in score_shape(box, box, 0.0, 40).values()} == {"nan", "None"}
    sheet = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]) * 0.1, np.array([[0, 1, 2]], np.int32))
    assert score_shape(sheet, box, 0.2, 40)["iou"] is None and score_shape(sheet, box, 0.2, 40)["accuracy_m"] > 0.0
    nothing = score_volume([], [], True)
    assert nothing["iou"] is None and np.isnan([nothing["accuracy"], nothing["distance_mae_m"]]).all()
    lost = score_volume([math.nan] * 2, [-1.0, 1.0], True)
    assert lost["iou"] == lost["accuracy"] == 0.0 and math.isnan(lost["distance_mae_m"])
    T, behind = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3], behind[2, 3] = 1.0, -1.0
    points = np.eye(3) * 0.1
    for wrong in (T * math.nan, T * 2.0, np.diag([1.0, 1.0, -1.0, 1.0]), T[:3]):
        assert np.isnan(list(score_pose(wrong, T, points, [], K).values())).all()
    assert score_pose(behind, T, points, [], K)["mspd_px"] == math.inf
    assert math.isnan(score_pose(T, behind, points, [], K)["mspd_px"])
    blank = score_pose(T, T, points[:0], [], K)
    assert blank.pop("rotation_deg") == blank.pop("translation_m") == 0.0 and np.isnan(list(blank.values())).all()


def test_depth_is_inverted_only_where_that_of_the_object_is_too():
    true = np.random.default_rng(13).uniform(1.0, 3.0, (20, 30))
    mask = np.zeros(true.shape, np.bool_)
    mask[5:15, 5:15] = True
    with pytest.raises(InputError, match="inverted"):
        check_depth(1.0 / true, true, None, mask)
    check_depth(np.where(mask, true, 1.0 / true), true, None, mask)  # of what is about the object nothing is known


@pytest.mark.parametrize("volume", ["auto", "occupancy", "logits", "sdf", "sdf-positive-inside"])
def test_values_of_a_volume_are_what_the_command_says(volume, tmp_path):
    true = np.random.default_rng(14).normal(size=500) * 0.02
    stored = {"volume_points": np.zeros((500, 3)), "volume_distance": true, "volume_occupancy": true < 0.0}
    values = {"logits": -500.0 * true, "sdf-positive-inside": -true, "occupancy": true < 0.0}
    np.save(tmp_path / "1.npy", values.get(volume, true))
    scores, _ = read_volume(tmp_path / "1.npy", 3, stored, None, Asked(("volume",), volume=volume))()
    assert scores["iou"] == scores["accuracy"] == 1.0
    assert scores["distance_mae_m"] == (None if volume in ("logits", "occupancy") else pytest.approx(0.0))


def test_distances_of_another_unit_or_sign_and_logits_are_told_and_a_poor_guess_is_not():
    true = np.random.default_rng(11).normal(size=1000) * 0.02
    noise = np.random.default_rng(12).normal(size=1000) * 0.02
    for predicted, told in ((1e3 * true, "millimetres"), (60.0 * true, "logits"), (0.2 * noise - true, "other sign")):
        with pytest.raises(InputError, match=told):
            check_distance(predicted, true)
    check_distance(noise, true)
    check_distance(true, true)
