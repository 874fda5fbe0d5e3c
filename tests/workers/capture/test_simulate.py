"""Virtual captures: path, device and effects by themselves, and photographs against OpenCV's projection and a ray caster."""

import hashlib
import math

import cv2
import numpy as np
import pytest
import trimesh

from schemas.base import Range
from schemas.errors import CaptureError, StartError, ViewError
from schemas.job.assets import CATEGORIES
from schemas.job.captures import Board, Simulate
from schemas.job.job import Job
from schemas.job.views import Distortion
from schemas.scene.scene import Placed
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Camera
from tests.workers.capture.drawn import project
from tests.workers.capture.simulated import Made, asset_of, corner_errors, made, take_one
from workers.assets.catalogue import open_catalogue
from workers.capture.board import marker_corners
from workers.capture.folder import open_folder, read_pose, read_view
from workers.capture.make_capture import load_object
from workers.capture.simulate.simulate import (
    AXIAL_M,
    AXIAL_PER_M,
    OFFSET_M,
    OFFSET_SHARE,
    VIEWS,
    develop,
    simulate_capture,
)
from workers.capture.simulate.studio import (
    COLOR,
    THICKNESS_M,
    make_rig,
    pinhole_lookup,
    place_object,
    plan_path,
    true_board,
)
from workers.capture.truth import read_receipt, read_truth
from workers.geometry.colour import encode_codes, encode_srgb
from workers.geometry.frames import invert, transform
from workers.geometry.pixels import opencv_lens, opencv_matrix, pixel_rays
from workers.geometry.raycast import cast_view
from workers.scene.chance import SceneChance
from workers.scene.effects import CAPTURE_EFFECTS, plan_capture

SMALL = {"views": 2, "image_scale": 0.25}
ON = {
    "hidden_markers": (0.5, {"rgb", "depth", "truth/held_out/rgb", "truth/held_out/depth"}),
    "print_scale": (1.02, {"rgb", "depth", "truth/held_out/rgb", "truth/held_out/depth"}),
    "motion_blur": (0.008, {"rgb"}),
    "rolling_shutter": (0.02, {"rgb"}),
    "distortion": ({"k1": 0.5}, {"rgb", "depth", "truth/mask", "camera.json"}),
    "exposure": ({"stops": [-1.0, -1.0]}, {"rgb"}),
    "tone_curve": ({}, {"rgb"}),
    "sharpen": (1.0, {"rgb"}),
    "jpeg": (85, {"rgb"}),
    "rgb_noise": ({}, {"rgb"}),
    "depth_noise": ({}, {"depth"}),
    "registration_error": ({}, {"depth"}),
}
"""What each effect is asked for by, and the kinds of files that it may change beside the receipt in truth.json."""


# ---------------------------------------------------------------------------------------------- the plan of effects


def test_what_is_asked_for_runs_and_everything_else_says_why_not():
    assert (
        set(ON)
        == set(CAPTURE_EFFECTS)
        == {name for name, field in Simulate.model_fields.items() if field.default is None}
    )
    plan = plan_capture(Simulate())
    assert not set(CAPTURE_EFFECTS) & set(plan.ran) and set(CAPTURE_EFFECTS) <= set(plan.skipped)
    for name in CAPTURE_EFFECTS:
        plan = plan_capture(Simulate(**{name: ON[name][0]}))
        assert [effect for effect in CAPTURE_EFFECTS if plan.runs(effect)] == [name] and name not in plan.skipped
    for tier, has, lacks in (("raster", "shadows", "glass"), ("pathtraced", "glass", "shadows")):
        assert plan_capture(Simulate(tier=tier)).runs(has) and not plan_capture(Simulate(tier=tier)).runs(lacks)


def test_a_camera_stores_light_by_its_curve_and_sharpens_and_compresses_what_it_stores():
    step = np.where(np.arange(64) < 29, 0.05, 0.4)
    light = np.repeat(np.tile(step, (64, 1))[..., None], 3, axis=2)

    def stored(**asked):
        return develop(light, Simulate(**asked)).astype(int)

    assert np.array_equal(stored(), encode_codes(light))
    assert np.array_equal(stored(tone_curve={"linear": True, "contrast": 0}), np.rint(255 * light))
    dark, grey = 255 * encode_srgb(step[[0, -1]])
    curve = stored(tone_curve={"contrast": 1.0})
    for code, before in ((curve[0, 0, 0], dark), (curve[0, -1, 0], grey)):
        assert code == pytest.approx(before - 255 * np.sin(2 * np.pi * before / 255) / (2 * np.pi), abs=0.51)
    sharp = stored(sharpen=1.0)[32, :, 1]
    assert sharp[[5, -5]] == pytest.approx([dark, grey], abs=0.51)  # far from the edge nothing changes
    # Half a pixel before a step, the blurred one has risen by the share of a normal law beyond half a sigma.
    beyond = 0.5 * math.erfc(0.5 / math.sqrt(2))
    assert sharp[28] - dark == pytest.approx(-beyond * (grey - dark), abs=2)
    assert 0 < np.abs(stored(jpeg=85) - stored()).max() < 30 < np.abs(stored(jpeg=1) - stored()).max()


# ---------------------------------------------------------------------------------------------- where the camera is

TARGET = np.array([0.0, 0.0, 0.1])


def path_of(seed, **keys):
    return plan_path(Simulate(**keys), TARGET, np.random.default_rng(seed))


def test_paths_go_around_the_object_at_several_heights_within_their_intervals():
    for views in (1, 2, 60):
        R = path_of(3, views=views)[:, :3, :3]
        assert R.shape == (views, 3, 3) and np.allclose(np.linalg.det(R), 1.0)
        assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    for seed in range(20):
        poses = path_of(seed, views=42, distance_m=Range(0.6, 1.0), inclination_rad=Range(0.5, 1.2))
        towards = TARGET - poses[:, :3, 3]
        away, below = np.linalg.norm(towards, axis=1), np.arcsin(-poses[:, 2, 2])
        assert ((away > 0.5) & (away < 1.1)).all()  # the aim moves by some centimetres
        assert ((below > 0.5 - 1e-9) & (below < 1.2 + 1e-9)).all()
        cosine = (towards * poses[:, :3, 2]).sum(axis=1) / away
        assert np.degrees(np.arccos(cosine)).max() < 10.0  # the image ends 30 degrees off its middle
        yaw = np.arctan2(poses[:, 1, 3], poses[:, 0, 3])
        assert np.histogram(yaw, bins=12, range=(-math.pi, math.pi))[0].min() >= 1
        low, middle, high = (np.median(third) for third in np.array_split(poses[:, 2, 3], 3))
        assert low < middle < high
        assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.7  # no jump across the object


# ---------------------------------------------------------------------------------------------- device, board and object


def test_the_device_is_the_articles_and_the_published_one():
    rig = make_rig(1.0)
    k, device = rig.color, rig.depth
    assert (k.width, k.height, k.fx, k.fy) == (1920, 1080, 912.37, 912.25)
    assert (k.cx_opencv, k.cy_opencv) == pytest.approx((961.44, 548.29))
    assert (device.intrinsics.width, device.intrinsics.height) == (640, 576)
    T, axis = device.T_color_depth, device.T_color_depth[:3, 2]
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(0.0323, abs=1e-3)
    assert axis[1] == pytest.approx(math.sin(math.radians(6.0))) and axis[0] == 0.0  # y runs down
    quarter = make_rig(0.25).color
    assert (quarter.width, quarter.height) == (480, 270)
    assert (270 - quarter.cy) / quarter.fy == pytest.approx((1080 - COLOR.cy) / COLOR.fy)


def test_objects_stand_exactly_on_the_print_and_a_print_scale_overrules_the_ruler():
    for index, category in enumerate(CATEGORIES):
        asset = asset_of(category, index)
        vertices = transform(place_object(asset, np.random.default_rng(index)), asset.shape.vertices)
        assert vertices[:, 2].min() == 0.0 and np.abs(vertices[:, :2]).max() < 0.2  # on the board
    board = Board(measured_ruler_m=0.21)
    assert true_board(board, Simulate()).scale == 1.0
    assert np.allclose(marker_corners(true_board(board, Simulate(print_scale=1.02))), 1.02 * marker_corners(Board()))


# ---------------------------------------------------------------------------------------------- samples and lens


def test_opencv_projects_each_looked_up_ray_to_its_stored_pixel():
    k = make_rig(0.1).color
    for lens in (Distortion(k1=-0.12, k2=0.05, p1=0.001, p2=-0.0007, k3=-0.01), Distortion(k1=0.08, p2=-4e-4, k3=0.02)):
        drawn, u, v = pinhole_lookup(lens, k)
        rays = np.stack([(u - drawn.cx) / drawn.fx, (v - drawn.cy) / drawn.fy, np.ones_like(u)], axis=-1).reshape(-1, 3)
        seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), opencv_matrix(k), opencv_lens(lens))[0]
        rows, columns = np.mgrid[0 : k.height, 0 : k.width]
        assert np.abs(seen.reshape(*u.shape, 2) - np.stack([columns, rows], axis=-1)).max() < 1e-6
        # All of it lies within the wider picture, with room for a sample beside a pixel's centre.
        assert min(u.min(), v.min()) > 1.0 and u.max() < drawn.width - 1.0 and v.max() < drawn.height - 1.0
    for lens in (Distortion(k1=-1.5), Distortion(k1=-0.45)):
        with pytest.raises(CaptureError, match="make its coefficients smaller"):
            pinhole_lookup(lens, k)
    assert opencv_lens(None).tolist() == [0.0] * 8


# ---------------------------------------------------------------------------------------------- photographs

NEAR = {"views": 1, "image_scale": 0.5, "distance_m": [0.4, 0.45]}
LENS = {"k1": 0.08, "k2": -0.05, "p1": 0.0005, "p2": -0.0004, "k3": 0.02}


@pytest.mark.parametrize(
    "settings", [{}, {"distortion": LENS, "rgb_noise": {}}, {"motion_blur": 0.008, "print_scale": 1.02}]
)
def test_corners_lie_where_opencv_projects_them(settings):
    """A pixel convention off by half a pixel would show as 0.5; a blur to one side or uneven samples as some hundredths."""
    printed = Board(measured_ruler_m=settings.get("print_scale", 1.0) * Board().ruler_m)
    errors, outwards = corner_errors(*take_one(**NEAR, **settings), printed)
    assert len(errors) >= 60 and np.median(np.abs(errors)) < 0.05
    assert np.abs(errors.mean(axis=0)).max() < 0.03 and abs(np.median(outwards)) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"distortion": LENS}])
def test_a_traced_photograph_has_its_corners_where_opencv_projects_them(settings):
    """Mitsuba shares nothing with the rasteriser: neither its camera nor its samples."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed: ./verso extra pathtraced")
    errors, outwards = corner_errors(*take_one(tier="pathtraced", **NEAR, **settings))
    assert len(errors) >= 60 and np.median(np.abs(errors)) < 0.06
    assert np.abs(errors.mean(axis=0)).max() < 0.03 and abs(np.median(outwards)) < 0.03


# ---------------------------------------------------------------------------------------------- depth


def board_depth(capture, number, shift=(0.0, 0.0, 0.0)):
    """(stored depth, depth of the print's plane moved by `shift` in camera axes), metres, at pixels well within the print."""
    k, T = capture.folder.camera.intrinsics, invert(capture.truth.T_board_cam[number])
    depth = read_view(capture.folder, number).depth / 1000.0
    v, u = np.mgrid[0 : k.height, 0 : k.width] + 0.5
    rays, normal = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1), T[:3, 2]
    plane = normal @ (T[:3, 3] + shift) / (rays @ normal)
    edges = np.array([[x, y, 0.0] for x, y in ((-0.27, -0.17), (0.27, -0.17), (0.27, 0.17), (-0.27, 0.17))])
    outline = project(edges, capture.truth.T_board_cam[number], capture.folder.camera)
    inside = cv2.fillConvexPoly(np.zeros(depth.shape, np.uint8), np.rint(outline).astype(np.int32), 1) > 0
    mask = cv2.imread(str(capture.folder.path / "truth" / f"mask_{number:05d}.png"), cv2.IMREAD_UNCHANGED)
    chosen = inside & (cv2.dilate(mask, np.ones((41, 41), np.uint8)) == 0) & (depth > 0.0)
    assert chosen.sum() > 500
    return depth[chosen], plane[chosen]


@pytest.mark.minute
def test_depth_of_the_board_is_that_of_its_plane_with_the_errors_that_were_asked_for():
    for number in (0, 1):
        found, expected = board_depth(made(**SMALL), number)
        assert np.abs(found - expected).max() < 0.001  # half a millimetre of rounding, and float32
    sigma = []
    for more in ({}, {"times": 2.0}, {"bias_m": 0.01}):
        found, expected = board_depth(made(**SMALL, depth_noise=more), 0)
        bias = OFFSET_M + OFFSET_SHARE * expected.mean() + more.get("bias_m", 0.0)
        assert np.mean(found - expected) == pytest.approx(bias, abs=5e-4)
        sigma.append(np.std(found - expected))
    assert sigma[1] / sigma[0] == pytest.approx(2.0, rel=0.15)
    stated = AXIAL_M + AXIAL_PER_M * np.mean(expected) ** 2
    assert 0.5 * stated < sigma[0] < 2.0 * stated  # registration averages neighbours, and the board is seen at an angle
    # A wrong registration moves what was measured: the plane that is stored is the true one moved by it.
    shift = [0.010, 0.004, -0.006]
    wrong = made(**SMALL, registration_error={"shift_m": shift})
    found, expected = board_depth(wrong, 0, np.array(shift))
    assert np.abs(found - expected).max() < 0.001 and np.abs(found - board_depth(wrong, 0)[1]).max() > 0.003


def test_depth_is_registered_to_the_image_that_the_lens_draws():
    """At a stored pixel, depth is that of the ray which OpenCV undistorts it to."""
    capture = made(**SMALL, distortion={"k1": 0.3, "p1": 0.002})
    k, T = capture.folder.camera.intrinsics, invert(capture.truth.T_board_cam[0])
    points = np.array([[x, y, 0.0] for x in np.linspace(-0.28, 0.28, 15) for y in (-0.18, -0.14, 0.14, 0.18)])
    pixels = np.rint(project(points, capture.truth.T_board_cam[0], capture.folder.camera) - 0.5)
    pixels = pixels[((pixels >= 0) & (pixels < [k.width, k.height])).all(axis=1)]
    stored = read_view(capture.folder, 0).depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] / 1000.0
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    rays = cv2.undistortPoints(pixels[:, None], opencv_matrix(k), capture.folder.camera.lens, criteria=stop)[:, 0]
    off = np.abs(stored - T[:3, 2] @ T[:3, 3] / (np.column_stack([rays, np.ones(len(rays))]) @ T[:3, 2]))[stored > 0.0]
    assert len(off) >= 15 and np.median(off) < 5e-4 and (off < 0.001).mean() > 0.8  # the can hides some of the points


# ---------------------------------------------------------------------------------------------- the folder and its truth


def changed(one: Made, other: Made) -> set[str]:
    """The kinds of files that differ: names up to their numbers."""

    def digests(capture: Made):
        path = capture.folder.path
        files = (file for file in path.rglob("*") if file.is_file())
        return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}

    a, b = digests(one), digests(other)
    assert a.keys() == b.keys()
    return {name.split("_0")[0] for name in a if a[name] != b[name]} - {"truth/truth.json"}


def test_the_folder_is_read_as_that_of_a_real_capture_and_its_truth_is_beside_it():
    capture = made(**SMALL)
    folder, view, truth = capture.folder, read_view(capture.folder, 1), read_truth(capture.folder.path)
    assert (folder.numbers, folder.about.category, folder.about.name) == ((0, 1), "can", "can-00000")
    k = folder.camera.intrinsics
    assert (k.width, k.height) == (480, 270) and k.fx == pytest.approx(0.25 * 912.37) and not folder.camera.has_lens
    assert view.mask is None and (view.depth > 0).mean() > 0.3 and folder.board == Board()
    assert np.array_equal(truth.T_board_cam, capture.truth.T_board_cam)
    mesh = trimesh.load(folder.path / "truth" / "mesh.glb", force="mesh")
    assert np.linalg.norm(np.ptp(mesh.vertices, axis=0)) == pytest.approx(0.25, rel=1e-6)
    vertices = transform(truth.T_board_obj, np.asarray(mesh.vertices, np.float64))
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-8)
    mask = cv2.imread(str(folder.path / "truth" / "mask_00001.png"), cv2.IMREAD_UNCHANGED)
    hull = cv2.convexHull(project(vertices, truth.T_board_cam[1], folder.camera).astype(np.float32) - 0.5)
    drawn = cv2.fillConvexPoly(np.zeros_like(mask), np.rint(hull[:, 0]).astype(np.int32), 255)
    assert (mask != drawn).mean() < 0.002 and 0.005 < (mask > 0).mean() < 0.3  # a can is nearly convex
    with pytest.raises(CaptureError, match="holds files"):
        simulate_capture(Simulate(), Board(), asset_of(), SceneChance(11, 0), folder.path)


def enclosed(k, T, size_m):
    """(depth [H, W] of the floor below the board, that of the nearest wall, rays [H, W, 3]) of a camera in the board frame."""
    rays = np.pad(pixel_rays(k, np.zeros(8)), ((0, 0), (0, 0), (0, 1)), constant_values=1.0) @ T[:3, :3].T
    ends = np.dstack([np.copysign(0.5 * np.array(size_m[:2]), rays[..., :2]), np.full(rays.shape[:2], -THICKNESS_M)])
    z = (ends - T[:3, 3]) / rays
    return np.where(z[..., 2] > 0, z[..., 2], np.inf), z[..., :2].min(axis=2), rays


def test_a_room_and_a_floor_stand_around_the_board_and_a_camera_outside_of_it_is_refused(tmp_path):
    """Where a held-out view shows neither board nor object, depth is that of the level floor or of the nearest wall."""
    job = Job(name="t", look={"room": {"size_m": [2.2, 2.4]}, "floor": {"colours": [[0.9, 0.1, 0.1]]}})
    around, pixels = (job.look, open_catalogue(job.assets, tmp_path, job.categories)), 0
    low = Simulate(views=1, image_scale=0.25, distance_m=[0.6, 0.8], inclination_rad=[0.5, 0.55])
    simulate_capture(low, Board(), asset_of(), SceneChance(11, 0), tmp_path / "room", around=around)
    size_m = read_receipt(tmp_path / "room")[2]["room_m"]
    folder = open_folder(tmp_path / "room/truth/held_out")
    for number in folder.numbers:
        view, T = read_view(folder, number), read_pose(folder.path / f"board_{number:05d}.txt")
        floor, wall, rays = enclosed(folder.camera.intrinsics, T, size_m)
        depth_m = view.depth / folder.camera.depth_units_per_m
        at = T[:3, 3] + depth_m[..., None] * rays
        beside = (np.abs(at[..., :2]) > [0.31, 0.21]).any(axis=2) & ~view.mask
        off = np.abs(depth_m - np.minimum(floor, wall))[beside]
        assert np.quantile(off, 0.9) < 1e-4 and off.max() < 0.06  # a skirting and a window stand before the wall
        red = view.rgb[beside & (floor < wall)].astype(int)
        assert (red[:, 0] > 2 * red[:, 1]).mean() > 0.98
        pixels += (beside & (wall < floor)).sum()
    assert pixels > 2000
    small = job.look.model_copy(update={"room": job.look.room.model_copy(update={"size_m": Range(1.0, 1.1)})})
    with pytest.raises(ViewError, match=r"capture's camera stands .* raise look.room.size_m"):
        simulate_capture(low, Board(), asset_of(), SceneChance(11, 0), tmp_path / "small", around=(small, around[1]))
    assert not any((tmp_path / "small").iterdir()), "refused before a file is written"
    wide = Board(width_m=1.2)
    with pytest.raises(StartError, match="the board reaches"):
        simulate_capture(low, wide, asset_of(), SceneChance(11, 0), tmp_path / "wide", around=(small, around[1]))


def test_the_same_seed_writes_the_same_bytes_and_the_object_is_of_the_jobs_category(tmp_path):
    truth = simulate_capture(Simulate(**SMALL), Board(), asset_of(), SceneChance(11, 0), tmp_path)
    assert changed(Made(open_folder(tmp_path), truth), made(**SMALL)) == set()
    assert "rgb" in changed(made(**SMALL), made(seed=12, **SMALL))
    job = Job(name="t", categories=["bowl"])
    catalogue = open_catalogue(job.assets, tmp_path, job.categories)
    one, same, other = (load_object(job, catalogue, SceneChance(3, n)) for n in (1, 1, 2))
    assert one.category == "bowl" and one.instance_id == same.instance_id != other.instance_id


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("distortion", "depth_noise") else pytest.mark.minute)
        for name in CAPTURE_EFFECTS
    ],
)
def test_an_effect_changes_its_own_files_and_no_pose(name):
    plain, asked = made(**SMALL), made(**SMALL, **{name: ON[name][0]})
    assert changed(asked, plain) == ON[name][1]
    assert np.array_equal(asked.truth.T_board_cam, plain.truth.T_board_cam)
    (ran, _, _), (others, skipped, _) = (read_receipt(one.folder.path) for one in (asked, plain))
    assert name in ran and set(ran) - {name} == set(others)
    assert {"effect": name, "why": f"captures.simulate.{name} is off"} in skipped


def test_no_effect_changes_the_random_numbers_of_another():
    both = made(**SMALL, depth_noise={}, rgb_noise={})
    assert changed(both, made(**SMALL, depth_noise={})) == {"rgb"}
    assert changed(both, made(**SMALL, rgb_noise={})) == {"depth"}


def test_held_out_views_are_exact_from_other_poses_and_know_no_sensor():
    capture = made(**SMALL, depth_noise={}, rgb_noise={}, distortion={"k1": 0.08}, exposure={}, motion_blur=0.008)
    folder, plain = (open_folder(one.folder.path / "truth" / "held_out") for one in (capture, made(**SMALL)))
    for file in plain.path.iterdir():
        assert file.read_bytes() == (folder.path / file.name).read_bytes()
    mesh = trimesh.load(capture.folder.path / "truth" / "mesh.glb", force="mesh")
    thing = Shape((Part("object", np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)),))
    square = np.array([[-0.3, -0.2, 0.0], [0.3, -0.2, 0.0], [0.3, 0.2, 0.0], [-0.3, 0.2, 0.0]])
    plane = Shape((Part("print", square, np.array([[0, 1, 2], [0, 2, 3]], np.int32)),))
    things = [Placed(2, plane, np.eye(4)), Placed(3, thing, capture.truth.T_board_obj)]
    assert folder.numbers == tuple(range(VIEWS)) and not folder.camera.has_lens
    for number in folder.numbers:
        view, T = read_view(folder, number), read_pose(folder.path / f"board_{number:05d}.txt")
        depth_m, region, _ = cast_view(things, Camera(folder.camera.intrinsics, T))
        assert ((region == 3) != view.mask).mean() < 1e-4  # rays at an outline's very edge
        same = (region >= 2) & ((region == 3) == view.mask)
        error = np.abs(view.depth / folder.camera.depth_units_per_m - depth_m)[same]
        assert np.percentile(error, 99.9) < 1e-4 and same.mean() > 0.03
        assert np.linalg.norm(capture.truth.T_board_cam[:, :3, 3] - T[:3, 3], axis=1).min() > 0.01
        assert 0.5 < np.linalg.norm(T[:3, 3] - capture.truth.T_board_obj[:3, 3]) < 1.1
