"""The three estimates of whole captures, against their truth, and what they say of what they found."""

import dataclasses
import re

import numpy as np
import pytest

from schemas.job.captures import Board, Estimation
from tests.kit.tiers import first_of
from tests.workers.capture.drawn import (
    HALF,
    KINECT,
    LENS,
    PINHOLE,
    DepthErrors,
    Virtual,
    errors,
    evidence_of,
    hand_held,
    make,
    median_errors,
    observe,
    project,
    with_corner_depth,
    with_pixels,
)
from workers.capture.board import marker_corners
from workers.capture.poses.estimates import (
    estimate_article,
    estimate_joint,
    estimate_markers,
    fit_article,
)
from workers.capture.poses.markers import Evidence, fit_markers
from workers.capture.poses.observation import Setup, no_patches
from workers.capture.poses.terms import moved

# ---------------------------------------------------------------------------------------------- article


def test_the_article_finds_the_true_pose_where_depth_is_right_and_is_not_carried_away():
    for camera in (PINHOLE, LENS):
        rng = np.random.default_rng(2)
        for T in hand_held(rng, 5):
            view = with_corner_depth(observe(T, rng, corner_px=0, camera=camera), T, rng, sigma_m=0)
            found, _, iterations = fit_article(view.corners, moved(T, rng.normal(0, 0.01, 6)))
            assert iterations < 100 and max(errors(found, T)) < 1e-3
    corners = with_corner_depth(observe(T, rng), T, rng, sigma_m=0.001).corners
    depth = corners.depth_m.copy()
    depth[:: len(depth) // 5] += 0.3  # wild at a few corners
    mm, degrees = errors(fit_article(dataclasses.replace(corners, depth_m=depth), T)[0], T)
    assert mm < 8 and degrees < 0.5


def test_the_warning_holds_that_depth_errs_as_much_as_it_says():
    """2 mm of noise at 104 corners: 1.1 mm, 0.07 degrees, where markers give 0.2 mm, 0.015; 10 mm of bias come out as 11."""
    for bias_m, (low_mm, high_mm), (low_deg, high_deg) in ((0.0, (0.7, 1.6), (0.04, 0.1)), (0.01, (9, 13), (0.1, 0.6))):
        found = []
        for seed in range(3):
            rng = np.random.default_rng(seed)
            for T in hand_held(rng, 20, distance_m=(0.8, 0.8), inclination_rad=(0.8, 1.1)):
                view = observe(T, rng, ids=rng.choice(35, 26, replace=False))
                corners = with_corner_depth(view, T, rng, bias_m=bias_m).corners
                found.append(errors(fit_article(corners, T)[0], T))
        mm, degrees = np.median(found, axis=0)
        assert low_mm < mm < high_mm and low_deg < degrees < high_deg


def test_the_article_keeps_views_with_biased_depth_and_refuses_those_without_depth_or_pose():
    rng = np.random.default_rng(7)
    truth = hand_held(rng, 4)  # their corners do not fit their images, which is what the article accepts
    views = [with_corner_depth(observe(T, rng, corner_px=0.05), T, rng, bias_m=0.01) for T in truth]
    assert all(view.status == "used" for view in estimate_article(evidence_of(views)).views)
    views[0], views[1] = observe(truth[0], rng), observe(truth[1], rng, ids=[])
    found = estimate_article(evidence_of(views))
    assert [view.status for view in found.views] == ["refused", "refused", "used", "used"]
    assert found.views[0].reasons == ("0 corners have depth, and 4 are needed",)
    assert "no markers" in found.views[1].reasons[0] and found.converged and found.iterations > 0


# ---------------------------------------------------------------------------------------------- joint

SHIFT = np.array([0.010, 0.0, 0.0])
CASES = {
    "noise": (Virtual(), {}),
    "twice the noise": (Virtual(seed=1, wrong=DepthErrors(sigma_m=0.006)), {}),
    "bias": (Virtual(seed=2, wrong=DepthErrors(sigma_m=0.003, bias_m=0.010)), {}),
    "registration": (Virtual(seed=3, wrong=DepthErrors(sigma_m=0.003, shift_m=SHIFT)), {}),
    "unknown wave": (Virtual(seed=4, wrong=DepthErrors(sigma_m=0.003, wave_m=0.003)), {}),
    "print, by depth": (Virtual(seed=5, print_scale=1.02), {"trust": "depth"}),
}


QUICK = ("noise", "bias", "print, by depth")


@pytest.mark.minute
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.minute) for name in CASES]
)
def test_joint_is_as_accurate_as_it_should_be_and_finds_the_error_of_depth(name, record_figure):
    virtual, spec = CASES[name]
    truth, evidence = make(virtual, **spec)
    joint = estimate_joint(evidence)
    (mm, degrees), markers = median_errors(joint, truth), median_errors(estimate_markers(evidence), truth)
    record_figure(f"capture poses, joint, {name}", "mm", mm, 0.5)
    assert degrees <= 0.05 and joint.converged
    if name == "print, by depth":
        assert 3 * mm <= markers[0]
    else:
        assert mm <= 0.5 and mm <= 1.1 * markers[0] and degrees <= 1.1 * markers[1]
    if name in ("bias", "registration"):
        assert 3 * mm <= median_errors(estimate_article(evidence), truth)[0]
    if name == "unknown wave":
        return  # no parameter describes it
    depth, shift = joint.depth, joint.depth.T_cam_depth[:3, 3]
    # Offset, shift along z and scale do nearly the same at one distance: what counts is what they do there together.
    assert depth.offset_m + shift[2] + (depth.scale - 1) * 0.8 == pytest.approx(virtual.wrong.bias_m, abs=0.002)
    assert shift[0] == pytest.approx(-virtual.wrong.shift_m[0], abs=0.0015)
    assert joint.print_scale == pytest.approx(virtual.print_scale, abs=0.002)
    assert {"offset_m", "shift_x_m"} <= set(depth.identified)


@pytest.mark.minute
def test_the_shapes_of_the_surfaces_help_views_with_few_markers():
    few = (1, 4, 7, 10)
    truth, evidence = make(Virtual(views=16, seed=6, few=few, few_ids=(0, 1)))
    bare = tuple(dataclasses.replace(o, object_patches=no_patches()) for o in evidence.observations)
    board = estimate_joint(dataclasses.replace(evidence, observations=bare))
    of_few = [median_errors(e, truth, few) for e in (estimate_markers(evidence), board, estimate_joint(evidence))]
    assert of_few[2][0] < 0.8 * of_few[0][0] and of_few[2][1] < 0.8 * of_few[0][1]
    assert of_few[2][0] < 1.05 * of_few[1][0]


@pytest.mark.minute
def test_depth_tells_apart_what_markers_do_not():
    """One small marker, far off: both tilts fit; the tilt of the board in depth decides."""
    truth, evidence = make(Virtual(views=10, few=(2, 5), few_ids=(0,), k=HALF))
    found = estimate_joint(evidence)
    for number in (2, 5):
        assert errors(found.views[number].T_board_cam, truth[number])[1] < 3


@pytest.fixture(scope="module")
def capture():
    """(true poses, evidence) of ten views."""
    return make(Virtual(views=10, k=HALF))


def changed(evidence, number, **changes):
    """Evidence with another observation in place of one."""
    observations = tuple(dataclasses.replace(o, **changes) if o.number == number else o for o in evidence.observations)
    return dataclasses.replace(evidence, observations=observations)


def test_a_pose_given_by_hand_is_kept_to_the_bit(capture):
    truth, evidence = capture
    given = moved(truth[3], np.array([0.004, 0, 0, 0, 0.01, 0]))
    found = estimate_joint(changed(evidence, 3, manual_T_board_cam=given, given_by="as told"))
    assert found.views[3].T_board_cam == pytest.approx(given, abs=1e-12)
    assert found.views[3].reasons[-1] == "as told" and median_errors(found, truth)[0] < 0.5


@pytest.mark.minute
def test_of_an_object_that_moved_the_largest_group_of_views_is_used_and_no_group_of_two(capture):
    truth, evidence = capture
    still = estimate_joint(evidence)
    assert not any("moved" in note for note in still.notes) and len(still.used) == len(truth)

    def shifted(places_m):
        """The object, not the board, elsewhere along x and y in each view."""
        parts = []
        for seen, T, place_m in zip(evidence.observations, truth, places_m, strict=True):
            ray_z = seen.object_patches.ray_z + T[:3, :3].T @ np.array([place_m, place_m / 3, 0])
            patches = dataclasses.replace(seen.object_patches, ray_z=ray_z, ray=ray_z / ray_z[:, 2:])
            parts.append(dataclasses.replace(seen, object_patches=patches))
        return estimate_joint(dataclasses.replace(evidence, observations=tuple(parts)))

    found = shifted([0.0] * 7 + [0.03] * 3)
    assert "stands still within each of: views 0, 1, 2, 3, 4, 5, 6; views 7, 8, 9. The first" in found.notes[0]
    assert [view.status for view in found.views] == ["used"] * 7 + ["flagged"] * 3
    assert median_errors(found, truth)[0] < 0.5
    everywhere = shifted([-0.06, -0.06, -0.03, -0.03, 0.0, 0.0, 0.03, 0.03, 0.06, 0.06])
    assert not everywhere.used and "No group is large enough to be used" in everywhere.notes[0]


def test_a_view_that_does_not_fit_is_flagged_and_takes_no_part(capture):
    truth, evidence = capture
    corners = evidence.observations[4].corners
    wrong = dataclasses.replace(corners, board=corners.board * np.array([0.5, 1.3, 1]))
    seen = list(changed(evidence, 4, corners=wrong).observations)
    found = estimate_joint(Evidence.of(evidence, seen, [fit_markers(o, evidence.camera) for o in seen]))
    assert found.views[4].status in ("flagged", "refused")
    assert median_errors(found, truth, [n for n in range(10) if n != 4])[0] < 0.5
    patches = evidence.observations[5].board_patches
    off = estimate_joint(changed(evidence, 5, board_patches=dataclasses.replace(patches, ray_z=patches.ray_z * 1.1)))
    assert off.views[5].status == "flagged" and "off the board, after the correction" in off.views[5].reasons[-1]
    assert errors(off.views[5].T_board_cam, truth[5])[0] < 1.0


# ---------------------------------------------------------------------------------------------- what a camera does to edges


@pytest.mark.minute
def test_squares_that_all_look_larger_do_not_bring_the_cameras_nearer():
    """Ink that spreads by 0.3 mm, by OpenCV's projection of a board of larger squares."""
    printed = marker_corners(Board(marker_m=0.0603, gap_m=0.0197))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = hand_held(rng, 8)
        seen = []
        for number, T in enumerate(truth):
            view = observe(T, rng, number=number, corner_px=0.05)
            ids = view.corners.markers[::4]
            pixels = project(printed[ids].reshape(-1, 3), T, PINHOLE) + rng.normal(0, 0.05, (4 * len(ids), 2))
            seen.append(with_pixels(view, pixels))
        evidence = evidence_of(seen)
        found, alone = estimate_joint(evidence), estimate_markers(evidence)
        assert median_errors(found, truth)[0] < 0.1 and median_errors(alone, truth)[0] > 0.2
        assert found.camera is None


# ---------------------------------------------------------------------------------------------- the camera


def seen_as(given, true, truth, rng, corner_px=0.1):
    """Evidence of the corners that the true camera sees, read with the camera that was given."""
    seen = []
    for number, T in enumerate(truth):
        view = observe(T, rng, number=number, camera=true, corner_px=corner_px)
        seen.append(with_pixels(view, view.corners.pixels, given))
    setup = Setup(given, Board(), Estimation(corner_px=corner_px))
    return Evidence.of(setup, seen, [fit_markers(o, given) for o in seen])


def with_numbers(camera, **numbers):
    return dataclasses.replace(camera, intrinsics=camera.intrinsics.model_copy(update=numbers))


LONG = with_numbers(PINHOLE, fx=1.01 * KINECT.fx, fy=1.01 * KINECT.fy)
WRONG = {
    "fx": (LONG, PINHOLE, KINECT.fx, 5.0),
    "cx": (with_numbers(PINHOLE, cx=KINECT.cx + 15), PINHOLE, KINECT.cx_opencv, 5.0),
    "k1": (PINHOLE, dataclasses.replace(LENS, lens=LENS.lens * np.eye(8)[0]), 0.08, 0.01),
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("corner_px", first_of([0.05, 0.2], 0, 1))
def test_a_camera_that_is_not_this_one_is_told_with_the_right_number_and_its_error_is_in_the_sigma(name, corner_px):
    (given, true, right, within), off_mm, sigma_mm = WRONG[name], [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = hand_held(rng, 10)
        found = estimate_joint(seen_as(given, true, truth, rng, corner_px))
        assert found.notes[0].startswith("camera.json does not fit: the markers say ")
        said = re.search(rf"{name} = ([0-9.]+) \([0-9.]+ given\)", found.notes[0])
        assert said and abs(float(said[1]) - right) < within and len(found.used) == 10
        for view, T in zip(found.views, truth, strict=True):
            off_mm.append(errors(view.T_board_cam, T)[0])
            sigma_mm.append(1000 * np.sqrt(np.trace(view.covariance[:3, :3])))
    assert 0.75 < np.sqrt(np.mean(np.square(off_mm)) / np.mean(np.square(sigma_mm))) < 1.25


def test_a_centre_half_a_pixel_off_is_told_and_no_rolling_shutter():
    rng = np.random.default_rng(0)
    given = with_numbers(PINHOLE, cx=KINECT.cx - 0.5, cy=KINECT.cy - 0.5)
    found = estimate_joint(seen_as(given, PINHOLE, hand_held(rng, 10), rng, 0.02))
    said = re.search(r"cx = ([0-9.]+) \(", found.notes[0])
    assert said and abs(float(said[1]) - KINECT.cx_opencv) < 0.2 and not any("rows" in note for note in found.notes)


@pytest.mark.minute
def test_the_right_camera_is_never_blamed_nor_any_by_views_that_cannot_tell():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        views = (3, 5, 10, 20)[seed % 4]
        found = estimate_joint(seen_as(LENS, LENS, hand_held(rng, views), rng))
        assert found.camera is None and not any("camera.json" in note for note in found.notes)
        alike = [moved(T0, rng.normal(0, 0.002, 6)) for T0 in hand_held(rng, 1) * 3]
        found = estimate_joint(seen_as(LONG, PINHOLE, alike, rng, 0.2))
        assert found.camera is None and not re.search("f[xy] = ", found.notes[0])


def test_a_print_of_another_size_is_told_unless_scales_agree_and_the_ruler_asked_for_unless_measured():
    def said(evidence, board=None, **spec):
        spec, board = Estimation(corner_px=0.05, **spec), board or evidence.board
        return " | ".join(estimate_joint(dataclasses.replace(evidence, spec=spec, board=board)).notes)

    (_, usual), (_, larger) = make(Virtual(views=6)), make(Virtual(views=6, print_scale=1.02))
    by_print = said(larger)
    told = re.search(r"by depth the print is (\d\.\d) % larger", by_print)
    assert told and abs(float(told[1]) - 2.0) < 0.31
    for words in ("cannot be identified", "measured_ruler_m", "the print was believed"):
        assert words in by_print
    assert "depth was believed" in said(larger, trust="depth")
    measured = said(larger, Board(measured_ruler_m=0.2))
    assert "although its ruler was measured" in measured and "Measure the printed ruler" not in measured
    agreed = said(usual)
    assert "disagree" not in agreed and re.search(r"sigma of a corner: 0\.0[45]", agreed)
    assert "depth of the board: sigma of a patch 0." in agreed and "of all patches of a view together 0." in agreed
