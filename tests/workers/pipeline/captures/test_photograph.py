"""Photographs: pixel conventions against OpenCV, and every effect against what it should do."""

import cv2
import numpy as np
import pytest
import trimesh

from schemas.job.captures import Board
from tests.workers.pipeline.captures.edge_corners import corner_errors, grey, project_opencv
from tests.workers.pipeline.captures.made_captures import made, take_one
from workers.capture.board.layout import marker_corners
from workers.capture.folder import read_view
from workers.capture.simulate.camera import AXIAL_M, AXIAL_PER_M, OFFSET_M, OFFSET_SHARE
from workers.geometry.colour import decode_codes
from workers.geometry.frames import invert, transform

NEAR = {"views": 1, "image_scale": 0.5, "distance_m": [0.4, 0.45]}
SMALL = {"views": 2, "image_scale": 0.25}
LENS = {"k1": 0.08, "k2": -0.05, "p1": 0.0005, "p2": -0.0004, "k3": 0.02}


def corners_of(board=None, **settings):
    """(errors [N, 2] px of the corners of one photograph, their outward parts [N])."""
    view, camera, T_board_cam = take_one(**NEAR, **settings)
    errors, outwards = corner_errors(view.rgb, camera, T_board_cam, board or Board())
    return errors, (errors * outwards).sum(axis=1)


def detected_errors(rgb, camera, T_board_cam):
    """[N, 2] px: corners that OpenCV's detector finds, against OpenCV's projection of the true ones."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    corners, ids, _ = detector.detectMarkers(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    true = marker_corners(Board())[ids.ravel()].reshape(-1, 3)
    errors = np.concatenate(corners).reshape(-1, 2) - project_opencv(camera, T_board_cam, true)
    return errors[np.abs(errors).max(axis=1) < 2.0]


@pytest.mark.parametrize(
    "settings", [{}, {"seed": 12}, {"seed": 13}, {"distortion": LENS}, {"motion_blur": {}}, {"rgb_noise": {}}]
)
def test_corners_lie_where_opencv_projects_them(settings):
    """A pixel convention off by half a pixel would show as 0.5; a blur to one side or uneven samples as some hundredths."""
    errors, outwards = corners_of(**settings)
    assert len(errors) >= 60
    assert np.abs(errors.mean(axis=0)).max() < 0.03
    assert abs(np.median(outwards)) < 0.03
    assert np.median(np.abs(errors)) < 0.05


def test_a_print_that_is_too_large_is_seen_so():
    """The board that the settings name is as large as it should be; only a ruler would tell the print's size."""
    errors, _ = corners_of(Board(measured_ruler_m=1.02 * Board().ruler_m), print_scale=1.02)
    assert np.abs(errors.mean(axis=0)).max() < 0.03
    assert np.median(np.abs(errors)) < 0.05


def test_motion_blurs_edges():
    sharp, blurred = (take_one(**NEAR, **more)[0] for more in ({}, {"motion_blur": {"exposure_s": 0.1}}))
    slopes = [np.abs(np.diff(grey(one.rgb), axis=1)).max(axis=1).mean() for one in (sharp, blurred)]
    assert slopes[1] < 0.8 * slopes[0]


def test_a_lens_leaves_no_black_corner():
    view, _, _ = take_one(**NEAR, distortion={"k1": -0.12, "k2": 0.05})
    assert all(view.rgb[row, column].max() > 0 for row in (0, -1) for column in (0, -1))


def test_exposure_multiplies_linear_light():
    plain, dark = (made(**SMALL, **more) for more in ({}, {"exposure": {"stops": [-1.0, -1.0]}}))
    before, after = (decode_codes(read_view(one.folder, 0).rgb) for one in (plain, dark))
    bright = before > 0.2
    assert np.median(after[bright] / before[bright]) == pytest.approx(0.5, rel=0.01)


def test_colour_noise_has_the_variance_of_its_electrons():
    plain, noisy = (made(**SMALL, **more) for more in ({}, {"rgb_noise": {"full_well_e": 1000.0, "read_noise_e": 5.0}}))
    light, seen = (decode_codes(read_view(one.folder, 1).rgb) for one in (plain, noisy))
    for low, high in ((0.1, 0.15), (0.2, 0.3)):
        chosen = (light > low) & (light < high)
        expected = light[chosen].mean() / 1000.0 + (5.0 / 1000.0) ** 2
        assert np.var((seen - light)[chosen]) == pytest.approx(expected, rel=0.1)


def test_hidden_markers_are_found_no_more():
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    found = []
    for more in ({}, {"hidden_markers": {"share": 0.6}}):
        image = cv2.cvtColor(take_one(**NEAR, **more)[0].rgb, cv2.COLOR_RGB2GRAY)
        found.append(len(detector.detectMarkers(image)[1]))
    assert found[0] >= 15
    assert found[1] < 0.75 * found[0]


# ---------------------------------------------------------------------------------------------- depth


def board_depth(capture, number, shift=(0.0, 0.0, 0.0)):
    """(stored depth, depth of the print's plane moved by `shift` in camera axes), metres, at pixels well within the print."""
    k, T = capture.folder.camera.intrinsics, invert(capture.truth.T_board_cam[number])
    depth = read_view(capture.folder, number).depth / 1000.0
    v, u = np.mgrid[0 : k.height, 0 : k.width] + 0.5
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1)
    normal = T[:3, 2]
    plane = normal @ (T[:3, 3] + shift) / (rays @ normal)
    corners = transform(
        T, np.array([[x, y, 0.0] for x, y in ((-0.27, -0.17), (0.27, -0.17), (0.27, 0.17), (-0.27, 0.17))])
    )
    outline = np.stack(
        [k.fx * corners[:, 0] / corners[:, 2] + k.cx, k.fy * corners[:, 1] / corners[:, 2] + k.cy], axis=1
    )
    inside = cv2.fillConvexPoly(np.zeros(depth.shape, np.uint8), np.rint(outline).astype(np.int32), 1) > 0
    mask = cv2.imread(str(capture.folder.path / "truth" / f"mask_{number:05d}.png"), cv2.IMREAD_UNCHANGED) > 0
    around = cv2.dilate(mask.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
    chosen = inside & ~around & (depth > 0.0)
    assert chosen.sum() > 500
    return depth[chosen], plane[chosen]


def test_exact_depth_of_the_board_is_that_of_its_plane():
    for number in (0, 1):
        found, expected = board_depth(made(**SMALL), number)
        assert np.abs(found - expected).max() < 0.001  # half a millimetre of rounding, and float32


def test_depth_noise_has_the_bias_of_its_preset():
    for more in ({}, {"bias_m": 0.01}):
        found, expected = board_depth(made(**SMALL, depth_noise=more), 0)
        bias = OFFSET_M + OFFSET_SHARE * expected.mean() + more.get("bias_m", 0.0)
        assert np.mean(found - expected) == pytest.approx(bias, abs=5e-4)


def test_twice_the_noise_scatters_twice_as_much():
    sigma = []
    for times in (1.0, 2.0):
        found, expected = board_depth(made(**SMALL, depth_noise={"times": times}), 0)
        sigma.append(np.std(found - expected))
    assert sigma[1] / sigma[0] == pytest.approx(2.0, rel=0.15)
    stated = AXIAL_M + AXIAL_PER_M * np.mean(expected) ** 2
    assert 0.5 * stated < sigma[0] < 2.0 * stated  # registration averages neighbours, and the board is seen at an angle


def test_a_wrong_registration_moves_the_measured_surface():
    """Every measured point is taken to lie `shift` further, so the plane that is stored is the true one moved by it."""
    shift = [0.010, 0.004, -0.006]
    found, expected = board_depth(made(**SMALL, registration_error={"shift_m": shift}), 0, np.array(shift))
    true = board_depth(made(**SMALL, registration_error={"shift_m": shift}), 0)[1]
    assert np.abs(found - expected).max() < 0.001
    assert np.abs(found - true).max() > 0.003


def test_depth_is_registered_to_the_image_that_the_lens_draws():
    """At a stored pixel, depth is that of the ray which OpenCV undistorts it to."""
    capture = made(**SMALL, distortion={"k1": 0.3, "p1": 0.002})
    k, T = capture.folder.camera.intrinsics, invert(capture.truth.T_board_cam[0])
    depth = read_view(capture.folder, 0).depth / 1000.0
    points = np.array([[x, y, 0.0] for x in np.linspace(-0.28, 0.28, 15) for y in (-0.18, -0.14, 0.14, 0.18)])
    pixels = np.rint(project_opencv(capture.folder.camera, capture.truth.T_board_cam[0], points))
    seen = ((pixels >= 0) & (pixels < [k.width, k.height])).all(axis=1)
    stored = depth[pixels[seen, 1].astype(int), pixels[seen, 0].astype(int)]
    matrix = np.array([[k.fx, 0.0, k.cx_opencv], [0.0, k.fy, k.cy_opencv], [0.0, 0.0, 1.0]])
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    rays = cv2.undistortPoints(pixels[seen][:, None], matrix, capture.folder.camera.lens, criteria=stop)[:, 0]
    normal = T[:3, 2]
    expected = normal @ T[:3, 3] / (np.column_stack([rays, np.ones(len(rays))]) @ normal)
    measured = stored > 0.0
    assert measured.sum() >= 15
    assert np.median(np.abs(stored - expected)[measured]) < 5e-4
    assert (np.abs(stored - expected)[measured] < 0.001).mean() > 0.8  # the can hides some of the points


def test_a_mask_is_the_objects_picture():
    """Every vertex of the can that OpenCV puts well inside the mask's outline is in the mask, and none is far from it."""
    capture = made(**SMALL)
    mask = cv2.imread(str(capture.folder.path / "truth" / "mask_00001.png"), cv2.IMREAD_UNCHANGED)
    vertices = trimesh.load(capture.folder.path / "truth" / "mesh.glb", force="mesh").vertices
    placed = transform(capture.truth.T_board_obj, np.asarray(vertices, np.float64))
    pixels = project_opencv(capture.folder.camera, capture.truth.T_board_cam[1], placed)
    hull = cv2.convexHull(pixels.astype(np.float32))
    drawn = cv2.fillConvexPoly(np.zeros_like(mask), np.rint(hull[:, 0]).astype(np.int32), 255)
    assert (mask != drawn).mean() < 0.002  # a can is nearly convex
    assert 0.005 < (mask > 0).mean() < 0.3


# ---------------------------------------------------------------------------------------------- the other renderer


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"distortion": LENS}])
def test_a_traced_photograph_has_its_corners_where_opencv_projects_them(settings):
    """Mitsuba shares nothing with the rasteriser: neither its camera nor its samples."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed: ./verso extra pathtraced")
    view, camera, T_board_cam = take_one(tier="pathtraced", **NEAR, **settings)
    errors, outwards = corner_errors(view.rgb, camera, T_board_cam, Board())
    assert len(errors) >= 60
    assert np.abs(errors.mean(axis=0)).max() < 0.03
    assert abs(np.median((errors * outwards).sum(axis=1))) < 0.03
    assert np.median(np.abs(errors)) < 0.06
    found = detected_errors(view.rgb, camera, T_board_cam)
    assert len(found) >= 60
    assert np.abs(found.mean(axis=0)).max() < 0.05


def test_opencvs_detector_finds_the_corners():
    """Its corners lie a little inside the true ones (edge_corners.py), so their mean over all markers is what must be 0."""
    view, camera, T_board_cam = take_one(**NEAR)
    errors = detected_errors(view.rgb, camera, T_board_cam)
    assert len(errors) >= 60
    assert np.abs(errors.mean(axis=0)).max() < 0.05
    assert np.median(np.abs(errors)) < 0.3
