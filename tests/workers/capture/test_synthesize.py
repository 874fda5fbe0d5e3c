"""Views as pinholes see them, from elsewhere too, against exact ones; and the measures of what is off."""

import dataclasses
import functools
import re

import cv2
import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.capture import CaptureCamera, CapturedView, DepthCorrection, Reconstruction
from schemas.errors import CaptureError
from schemas.job.captures import Synthesis
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from tests.workers.capture.analytic_capture import HIGH, LOW, RADIUS, SPHERE, Thing, capture, cast, kinect, poses
from workers.capture.score import (
    align_mesh,
    measured_points,
    score_surface,
)
from workers.capture.surface.coverage import describe_grazing, sample_surface
from workers.capture.surface.posed_view import (
    UNSEEN,
    PosedView,
    best_cosine,
    correct_depth,
    distort_mask,
    facing_cosine,
    placed,
    pose_view,
)
from workers.capture.surface.synthesize import (
    choose_sources,
    color_depth,
    fill_holes,
    prepare_source,
    synthesize_view,
    warp,
)
from workers.capture.surface.tsdf import fit_depth
from workers.geometry.camera import look_at
from workers.geometry.frames import angle_between, invert, pose, rotation_about, transform, translation
from workers.geometry.pixels import opencv_matrix
from workers.geometry.raycast import Caster, cast_view

# ---------------------------------------------------------------------------------------------- without the lens

SIZED = Intrinsics(width=240, height=180, fx=200.0, fy=205.0, cx=121.3, cy=88.7)
LENS = np.array([0.12, -0.2, 0.002, -0.003, 0.05, 0.0, 0.0, 0.0])
DOTS = np.array([[-0.35, -0.25, 1.0], [0.3, 0.25, 1.0], [0.02, -0.3, 1.0], [-0.4, 0.3, 1.0]])
ROWS, COLUMNS = np.mgrid[0:180, 0:240]


def places(lens):
    """(u, v) of the dots, pixel centres on integers, by OpenCV."""
    return cv2.projectPoints(DOTS, np.zeros(3), np.zeros(3), opencv_matrix(SIZED), lens)[0].reshape(-1, 2)


def centre_near(image, u, v):
    """Centroid, pixel centres on integers, of what is bright about a place."""
    w = np.where(np.hypot(COLUMNS - u, ROWS - v) < 9, image.astype(float), 0.0)
    return np.array([(COLUMNS * w).sum(), (ROWS * w).sum()]) / w.sum()


def test_picture_and_mask_are_where_pinhole_and_lens_have_them():
    straight, bent = places(np.zeros(8)), places(LENS)
    assert np.hypot(*(straight - bent).T).max() > 2.0
    light = sum(np.exp(-((COLUMNS - u) ** 2 + (ROWS - v) ** 2) / (2 * 2.5**2)) for u, v in bent)
    rgb = np.repeat(np.rint(250 * light)[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)
    view = CapturedView(3, rgb, np.full((180, 240), 1000, np.uint16), None)
    seen = pose_view(view, CaptureCamera(SIZED, LENS), np.eye(4), DepthCorrection())
    mask = np.any([np.hypot(COLUMNS - u, ROWS - v) < 5 for u, v in straight], axis=0)
    drawn = distort_mask(mask, CaptureCamera(SIZED, LENS))
    for place, stored in zip(straight, bent, strict=True):
        assert np.hypot(*(centre_near(seen.rgb[..., 0], *place) - place)) < 0.15
        assert np.hypot(*(centre_near(drawn, *stored) - stored)) < 0.5


def test_a_camera_without_lens_keeps_pictures_and_depth_is_corrected_by_scale_then_offset():
    plain = CaptureCamera(SIZED, np.zeros(8))
    rgb, depth, mask = np.zeros((180, 240, 3), np.uint8), np.full((180, 240), 700, np.uint16), ROWS > COLUMNS
    T, T_cam_depth = translation(1, 2, 3), translation(0.01, 0, 0)
    seen = pose_view(CapturedView(0, rgb, depth, mask), plain, T, DepthCorrection(T_cam_depth=T_cam_depth))
    assert (
        seen.rgb is rgb and seen.mask is mask and distort_mask(mask, plain) is mask and np.allclose(seen.depth_m, 0.7)
    )
    assert np.allclose(seen.depth_camera.position, [1.01, 2, 3]) and np.allclose(seen.camera.position, [1, 2, 3])
    assert np.allclose(correct_depth(np.array([[0, 1000, 500]], np.uint16), 0.001, 1.02, -0.01), [[0.0, 1.01, 0.5]])
    assert np.array_equal(correct_depth(np.array([[5]], np.uint16), 0.001, 1.0, -0.01), [[0.0]])
    with pytest.raises(CaptureError, match=r"depth_00007\.png is missing"):
        pose_view(CapturedView(7, rgb, None, None), plain, np.eye(4), DepthCorrection())


# ---------------------------------------------------------------------------------------------- what cameras see

EYE = Intrinsics(width=200, height=150, fx=200.0, fy=200.0, cx=100.0, cy=75.0)


def eye_at(*position):
    return Camera(EYE, frozen_array(look_at(np.array(position, dtype=float), np.zeros(3))))


def visible(mesh, points, normals, cameras):
    return best_cosine(Caster(mesh), points, normals, cameras) > UNSEEN


def test_a_camera_sees_the_cap_of_a_sphere_that_faces_it_unless_another_part_hides_it():
    made = trimesh.creation.icosphere(4, 0.1)
    ball, faces = np.array(made.vertices), np.array(made.faces, np.int32)
    normals, alone = ball / 0.1, Mesh(ball, faces)
    seen = visible(alone, ball, normals, [eye_at(1, 0, 0)])
    clear = np.abs(ball[:, 0] - 0.01) > 0.003  # the cap ends where the rays touch the sphere: x = r^2 / d
    assert np.array_equal(seen[clear], (ball[:, 0] > 0.01)[clear])
    assert visible(alone, ball, normals, [eye_at(1, 0, 0), eye_at(-1, 0, 0)]).sum() > 1.8 * seen.sum()
    around = [eye_at(np.cos(t), np.sin(t), 0) for t in np.arange(6)]  # on a sphere alone nothing hides the best of them
    best = np.max([facing_cosine(ball, normals, camera) for camera in around], axis=0)
    assert np.allclose(best_cosine(Caster(alone), ball, normals, around)[best > 0.05], best[best > 0.05])
    both = Mesh(
        np.concatenate([ball + np.array([0.5, 0, 0]), ball]),
        np.concatenate([faces, faces + len(ball)]).astype(np.int32),
    )
    front = ball[:, 0] > 0.05
    assert not visible(both, ball, normals, [eye_at(1.2, 0, 0)])[front].any()
    many = [eye_at(1.2, 0, 0), eye_at(0, 0, 1), eye_at(0, 1, 0.2), eye_at(1, 1, 0.1), eye_at(0, -1, 0)]
    assert visible(both, ball, normals, many)[front].mean() > 0.9
    assert not visible(alone, ball, normals, []).any()
    assert len(visible(alone, ball[:0], normals[:0], many)) == 0
    points = np.array([[0.0, 0, 0], [0.0, 0, 0], [5.0, 0, 0]])
    cosine = facing_cosine(points, np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 0, 1.0]]), eye_at(0.6, 0.0, 0.8))
    assert np.allclose(cosine, [0.8, 0.6, UNSEEN])


# ---------------------------------------------------------------------------------------------- one view from elsewhere

K, THING = kinect(0.25), Thing()


def camera_at(*position):
    return Camera(K, frozen_array(look_at(np.array(position), np.array([0.0, 0.0, 0.04]))))


HOME = camera_at(0.5, 0.1, 0.45)


@functools.cache
def source_at(shift_m=0.0):
    """The thing as a device at HOME sees it, whose depth camera stands so far to its right."""
    depth_camera = Camera(K, frozen_array(HOME.T_world_cam @ translation(shift_m, 0, 0))) if shift_m else HOME
    depth = cast(THING, depth_camera)[0].astype(np.float32)
    return prepare_source(PosedView(0, HOME, depth_camera, cast(THING, HOME)[2], depth), fit_depth(depth, K))


def test_depth_and_colour_are_those_that_the_other_camera_has():
    for position in ((0.5, 0.1, 0.45), (0.45, 0.2, 0.4), (0.35, 0.0, 0.35), (0.6, 0.1, 0.7)):
        camera = camera_at(*position)
        layer, (depth, _, rgb) = warp(source_at(), camera), cast(THING, camera)
        seen = layer.weight > 0
        off = np.abs(layer.depth_m - depth)[seen]
        assert seen.sum() > 5000 and np.median(off) < 1e-4 and np.quantile(off, 0.95) < 2e-3
        assert np.median(np.abs(layer.rgb.astype(int) - rgb)[seen]) <= 2
    assert np.allclose(warp(source_at(), camera, 0.25).weight, 0.25 * layer.weight)


def test_a_nearer_camera_sees_no_gaps_and_a_surface_from_behind_hides_and_shows_nothing():
    camera = camera_at(0.28, 0.06, 0.26)
    seen, inner = warp(source_at(), camera).weight > 0, np.s_[60:-60, 120:-120]
    assert seen[inner][(cast(THING, camera)[0] > 0)[inner]].mean() > 0.75
    holes = ~seen[1:-1, 1:-1] & seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]
    assert holes.sum() <= 3
    layer = warp(source_at(), camera_at(-0.5, 0.0, 0.3))
    behind = (layer.depth_m > 0) & (layer.weight == 0)
    assert behind.sum() > 200 and not layer.rgb[behind].any()


def test_colours_and_depth_follow_a_depth_camera_that_stands_elsewhere():
    source = source_at(0.02)
    expected = cast(THING, source.camera)[2]
    assert np.median(np.abs(source.rgb.astype(int) - expected)[source.fitted.inverse > 0]) <= 2
    aside = source_at(0.01).camera
    depth, truth = (cast(THING, camera) for camera in (aside, HOME))
    seen = PosedView(0, HOME, aside, truth[2], depth[0].astype(np.float32))
    carried = color_depth(seen)
    both = (carried > 0) & (truth[0] > 0)
    assert both.sum() > 0.9 * (truth[0] > 0).sum() and np.quantile(np.abs(carried - truth[0])[both], 0.9) < 1e-4
    assert color_depth(dataclasses.replace(seen, depth_camera=HOME)) is seen.depth_m


# ---------------------------------------------------------------------------------------------- many views


def body(*open_at):
    """The thing as a mesh, without the box's bottom and its upper faces within 25 mm of (x, y) where that is given."""
    ball, box = trimesh.creation.icosphere(5, RADIUS), trimesh.creation.box(bounds=np.stack([LOW, HIGH]))
    box = box.subdivide().subdivide().subdivide().subdivide()
    for place in open_at:
        middle = box.triangles_center
        top, bottom = middle[:, 2] > HIGH[2] - 1e-6, middle[:, 2] < 1e-6
        box.update_faces(~bottom & ~(top & (np.hypot(*(middle[:, :2] - place).T) < 0.025)))
    mesh = trimesh.util.concatenate([ball.apply_translation(SPHERE), box])
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int32))


def sources(sigma_m, count=24, seed=0, spoil=lambda depth_m, camera: depth_m):
    views = capture(THING, count=count, sigma_m=sigma_m, seed=seed)
    fitted = [fit_depth(spoil(view.depth_m, view.camera), K) for view in views]
    return [prepare_source(*pair) for pair in zip(views, fitted, strict=True)]


def off_by(view, camera):
    """[H, W] distance of a view's depth from what a pixel or one beside it truly has."""
    framed = np.pad(cast(THING, camera)[0], 1)
    around = [framed[i : i + K.height, j : j + K.width] for i in range(3) for j in range(3)]
    return np.min([np.abs(view.depth_m - truth) for truth in around], axis=0)


def at_place(place, camera, size):
    """The square of pixels about a point of the board frame."""
    x, y, z = transform(invert(camera.T_world_cam), np.array([place]))[0]
    u, v = int(K.fx * x / z + K.cx), int(K.fy * y / z + K.cy)
    return np.s_[v - size : v + size, u - size : u + size]


@pytest.mark.minute
def test_what_is_called_measured_lies_on_the_object_or_the_board_whatever_single_views_show():
    def spoil(depth_m, camera):
        depth_m, (true, thing, _) = depth_m.copy(), cast(THING, camera)
        depth_m[at_place((0.11, 0.0, 0.0), camera, 3)] -= 0.03  # floats over the board beside the box
        through = at_place((0.0, 0.0, 0.1), camera, 3)
        depth_m[through] = np.where(thing[through], true[through] + 0.06, true[through])  # the board inside the box
        return depth_m

    camera = camera_at(0.6, 0.25, 0.5)
    ready = [source for source in sources(0.001, spoil=spoil) if source.number % 4 == 1]
    view = synthesize_view(ready, camera, body())
    assert (off_by(view, camera)[view.measured & (view.depth_m > 0)] < 0.01).mean() > 0.9998
    assert (view.measured & view.mask).sum() > 0.8 * view.mask.sum()


def test_a_camera_that_sees_the_board_alone_has_no_mask_and_no_warning():
    beside = frozen_array(look_at(np.array([0.3, 0.2, 0.5]), np.array([0.3, 0.21, 0.0])))
    view = synthesize_view(sources(0.0), Camera(K.model_copy(update={"fx": 2000.0, "fy": 2000.0}), beside), body())
    assert not view.mask.any() and (view.depth_m > 0.0).any()


@pytest.mark.minute
def test_what_no_view_sees_of_the_object_is_its_own_and_counts_as_not_measured():
    camera, place = camera_at(0.3, 0.1, 0.7), (0.03, 0.0)

    def spoil(depth_m, camera):
        depth, thing, _ = cast(THING, camera)
        rays = np.stack(
            [
                (np.arange(K.width) + 0.5 - K.cx) / K.fx * depth,
                (np.arange(K.height)[:, None] + 0.5 - K.cy) / K.fy * depth,
                depth,
            ],
            axis=-1,
        )
        at = transform(camera.T_world_cam, rays.reshape(-1, 3)).reshape(rays.shape)
        lost = thing & (np.hypot(at[..., 0] - place[0], at[..., 1] - place[1]) < 0.025) & (at[..., 2] > 0.09)
        return np.where(lost, np.float32(0), depth_m)

    whole, holed = (synthesize_view(sources(0.0, spoil=spoil)[:8], camera, body(*where)) for where in ((), (place,)))
    mask = cast(THING, camera)[1]
    for view in (whole, holed):
        assert (view.mask & mask).sum() > 0.97 * mask.sum() and (view.mask & ~mask).sum() < 0.04 * mask.sum()
        lost = view.mask & ~view.measured
        assert 0.1 < lost.sum() / mask.sum() < 0.35
        assert view.measured_share == pytest.approx(view.measured.sum() / ((view.depth_m > 0) | view.mask).sum())


@pytest.mark.parametrize("sigma_m", [0.002, pytest.param(0.004, marks=pytest.mark.minute)])
def test_a_view_from_a_held_out_pose_is_the_true_one(sigma_m, record_figure):
    ready, worst = sources(sigma_m, seed=1), 0.0
    for T in poses(3, 0.75, seed=71):
        camera = Camera(K, frozen_array(T))
        best = choose_sources(
            {source.number: source.camera.T_world_cam[:3, 2] for source in ready}, camera, Synthesis()
        )
        view = synthesize_view([ready[number] for number in best], camera, body())
        depth, mask, rgb = cast(THING, camera)
        both = (view.depth_m > 0) & view.mask & mask
        worst = max(worst, float(np.median(np.abs(view.depth_m - depth)[both])) * 1e3)
        assert both.sum() > 0.9 * mask.sum() and (view.mask & ~mask).sum() < 0.03 * mask.sum()
        assert np.median(np.abs(view.rgb.astype(int) - rgb)[both]) <= 3
        assert 0.97 < view.measured_share <= 1.0 and len(view.sources) == 6
    record_figure(f"synthesised depth, noise {sigma_m * 1e3:g} mm", "median, mm", worst, 1.0)
    assert worst < 1.0
    away = Camera(K, frozen_array(look_at(np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.0, 2.0]))))
    with pytest.raises(CaptureError, match="shows anything to this camera") as refusal:
        synthesize_view(ready[:4], away, body())
    assert refusal.value.reason == "nothing_seen"
    down = Camera(K, frozen_array(look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))))  # ranked by the cosine of the axes
    axes = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 0.0, -1.0], [-0.6, 0.0, -0.8], [1.0, 0.0, 0.0]])
    assert choose_sources(dict(enumerate(axes)), down, Synthesis()) == [2, 1, 3, 4, 0]


def halves():
    """(rgb, depth) of a near surface at the left and a farther one at the right."""
    depth = np.full((60, 80), 1.0)
    depth[:, :40] = 0.8
    rgb = np.where(depth[..., None] < 0.9, [200, 10, 10], [10, 10, 200]).astype(np.uint8)
    return rgb, depth


def test_small_holes_are_filled_from_the_farther_surface_and_large_ones_and_outer_edges_stay():
    for hole in (np.s_[20:24, 10:14], np.s_[:, 39:42]):  # within a surface; a gap between two is shared
        rgb, depth = halves()
        depth[hole], rgb[hole] = 0.0, 0
        for got, expected in zip(fill_holes(rgb, depth, 3), halves(), strict=True):
            assert np.allclose(got[5:-5], expected[5:-5])
        assert not depth[hole].any(), "what was given is not changed"
    rgb, depth = halves()
    depth[10:21, 10:21], depth[35:50, 10:25], depth[:, 60:] = 0.0, 0.0, 0.0
    filled = fill_holes(rgb, depth, 3)[1]
    assert np.allclose(filled[10:21, 10:21], 0.8), "an enclosed hole is filled whole"
    assert not filled[39:46, 14:21].any() and not filled[:, 60:].any()
    assert np.array_equal(fill_holes(rgb, depth, 0)[1], depth)


# ---------------------------------------------------------------------------------------------- errors made on purpose

BOX = trimesh.creation.box((0.2, 0.1, 0.06))
MESH = Mesh(np.array(BOX.vertices), np.array(BOX.faces, np.int32))
ABOVE = Camera(K, frozen_array(look_at(np.array([0.4, 0.1, 0.4]), np.zeros(3))))


def test_samples_are_even_over_the_area_and_surface_errors_are_the_distances_that_were_made():
    samples, normals = sample_surface(MESH, 20_000)
    top = normals[:, 2] > 0.5
    assert top.mean() == pytest.approx(0.2 * 0.1 / (2 * (0.2 * 0.1 + 0.2 * 0.06 + 0.1 * 0.06)), abs=0.005)
    assert np.allclose(samples[top][:, 2], 0.03) and ((samples * normals).sum(axis=1) > 0).all()
    assert abs(samples[top][:, 0].mean()) < 0.002 and np.array_equal(samples, sample_surface(MESH, 20_000)[0])
    black, views = np.zeros((len(samples), 3), np.uint8), np.ones(len(samples), np.int32)
    found = Reconstruction(samples + 0.002 * normals, normals, black, views, MESH.vertices, MESH.faces, black)
    errors = score_surface(found, MESH, [ABOVE])
    assert errors.cloud_median_mm == pytest.approx(2.0) and errors.cloud_p95_mm == pytest.approx(2.0)
    assert errors.surface_median_mm == pytest.approx(0.0, abs=1e-6) and errors.completeness > 0.97
    seen = visible(MESH, samples, normals, [ABOVE]).mean()
    assert errors.visible_share == pytest.approx(seen, abs=0.01) and 0.3 < seen < 0.7


def ring(elevation_deg, turns_deg):
    """Distant cameras about the origin at an elevation and angles about the vertical, by number."""
    wide, found = Intrinsics(width=200, height=200, fx=900.0, fy=900.0, cx=100.0, cy=100.0), {}
    for number, turn in enumerate(np.radians(turns_deg)):
        e = np.radians(elevation_deg)
        position = 5.0 * np.array([np.cos(e) * np.cos(turn), np.cos(e) * np.sin(turn), np.sin(e)])
        found[number] = Camera(wide, frozen_array(look_at(position, np.zeros(3))))
    return found


def test_what_is_seen_only_at_grazing_angles_is_a_share_and_a_place_from_where_it_is_seen_well():
    made = trimesh.creation.icosphere(4, 0.1)
    ball, all_around = Mesh(np.array(made.vertices), np.array(made.faces, np.int32)), np.arange(0, 360, 10)
    note = describe_grazing(ball, ring(50.0, all_around))
    # A belt of a sphere has an area as its height: seen down to 40 degrees below the middle, at 70 down to 20 below.
    share = (np.sin(np.radians(40)) - np.sin(np.radians(20))) / (1 + np.sin(np.radians(40)))
    assert abs(int(note.split("%")[0]) - 100 * share) < 2 and "about 10 degrees above the board all around" in note
    lower = {number + 36: camera for number, camera in ring(10.0, all_around).items()}
    assert describe_grazing(ball, {**ring(50.0, all_around), **lower}) is None
    views = ring(45.0, [92, 100, 180, 268, 20])  # the box's face towards +x is seen by the last alone
    assert describe_grazing(MESH, views) is None
    views[4] = ring(45.0, [72])[0]  # 77 degrees from that face's normal
    told = describe_grazing(MESH, views)
    assert re.search("about (10|25|40) degrees above the board on the side of view 4", told)


def test_points_are_measured_where_a_pixel_has_their_depth():
    depth = cast_view([placed(MESH)], ABOVE)[0].astype(np.float32)
    points, normals = sample_surface(MESH, 4000)
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    towards = ((ABOVE.position - points) * normals).sum(axis=1) > 0.02
    measured = measured_points(points, normals, PosedView(0, ABOVE, ABOVE, rgb, depth))
    assert measured[towards].mean() > 0.97 and not measured[~towards].any()
    for spoilt in (np.zeros_like(depth), np.where(depth > 0, depth + np.float32(0.1), np.float32(0))):
        assert measured_points(points, normals, PosedView(0, ABOVE, ABOVE, rgb, spoilt)).mean() < 0.01


def test_the_pose_of_a_mesh_is_found_from_a_noisy_part_of_its_surface():
    parts = [trimesh.creation.box((0.16, 0.1, 0.06)), trimesh.creation.box((0.05, 0.04, 0.12))]
    parts[1].apply_translation((0.05, 0.02, 0.03))  # a body that no turn takes to itself
    whole = trimesh.util.concatenate(parts)
    mesh = Mesh(np.array(whole.vertices), np.array(whole.faces, np.int32))
    for seed in range(2):
        rng = np.random.default_rng(seed)
        tilt = rotation_about(np.array([1.0, 0.0, 0.0]), rng.normal(0, 0.03))
        T = pose(tilt @ rotation_about(np.array([0.0, 0.0, 1.0]), rng.uniform(0, 6.28)), rng.normal(0, 0.3, 3))
        points, normals = sample_surface(mesh, 6000)
        cloud = transform(T, points[normals[:, 2] > -0.5])  # nobody saw the bottom
        found, rms_mm = align_mesh(cloud + rng.normal(0, 0.0005, cloud.shape), mesh)
        assert np.linalg.norm(found[:3, 3] - T[:3, 3]) < 0.001 and rms_mm < 0.6
        assert np.degrees(angle_between(found[:3, :3], T[:3, :3])) < 0.5
    with pytest.raises(CaptureError, match="50 points cannot be aligned"):
        align_mesh(np.zeros((50, 3)), mesh)
