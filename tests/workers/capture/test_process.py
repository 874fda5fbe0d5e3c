"""A capture's folder from photographs to results, read back and scored; what the user wrote into it wins."""

import dataclasses
import io
import json
import re
import shutil

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.capture import CaptureCamera, CaptureEstimate, Estimates, ViewEstimate
from schemas.errors import CaptureError, OutputError
from schemas.job.captures import Board, Captures, Estimation, Fusion, KinectDepthNoise, Simulate
from schemas.scene.shape import Mesh
from tests.conftest import SHARED_DATA
from tests.workers.capture import drawn as drawn_captures
from tests.workers.capture.drawn import KINECT, draw_view, errors, median_errors, write_capture
from tests.workers.capture.simulated import CAPTURES, VIEWS, asset_of, box, copy_of, made, processed, true_estimates
from workers.capture import reconstruct as captures
from workers.capture.board import frame_in_board
from workers.capture.folder import open_folder, pose_text, read_pose, read_view, write_pose, write_view
from workers.capture.process import (
    pose_table,
    process_folder,
    read_result,
    write_mirrors,
    write_synthesized,
)
from workers.capture.reconstruct import (
    corrections_of,
    estimate_poses,
    estimate_surface,
    given_files,
    processor_clock,
    read_posed,
    reconstruct,
)
from workers.capture.results import read_surface, write_results
from workers.capture.score import (
    describe_misfit,
    read_mesh_file,
    read_whole_truth,
    score_against_mesh,
    score_capture,
)
from workers.capture.simulate import simulate
from workers.capture.simulate.simulate import develop
from workers.capture.simulate.studio import place_object, plan_path
from workers.capture.surface.posed_view import placed
from workers.capture.truth import read_truth
from workers.geometry.colour import decode_codes
from workers.geometry.frames import half_turn, invert, pose, rotation_about, transform, translation
from workers.geometry.raycast import cast_view
from workers.scene.chance import SceneChance

CORRECTION = pose(rotation_about(np.array([0.0, 0, 1]), 0.02), np.array([0.01, 0.0, 0.005]))

SEEDS = [11, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (12, 13))]


def opened(path):
    return given_files(open_folder(path))


# ---------------------------------------------------------------------------------------------- poses of a folder


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """(a drawn capture, its true poses, its estimates)."""
    path = tmp_path_factory.mktemp("captures") / "box"
    truth = write_capture(path)
    return path, truth, estimate_poses(opened(path), Estimation())


@pytest.fixture
def copy(drawn, tmp_path):
    return copy_of(drawn[0], tmp_path)


def test_poses_of_a_drawn_capture_are_the_true_ones_and_the_same_bytes_twice(drawn):
    path, truth, estimates = drawn
    assert set(estimates.by_name) == {"markers", "article", "joint"}
    for view, T in zip(estimates.by_name["markers"].views, truth, strict=True):
        mm, degrees = errors(view.T_board_cam, T)
        assert view.status == "used" and mm < 0.5 and degrees < 0.05
    again = estimate_poses(opened(path), Estimation())
    for name, estimate in estimates.by_name.items():
        for a, b in zip(estimate.views, again.by_name[name].views, strict=True):
            assert np.array_equal(a.T_board_cam, b.T_board_cam)
    alone = estimate_poses(opened(path), Estimation(estimate="markers", compare=False))
    assert list(alone.by_name) == ["markers"] and set(alone.seconds) == {"read", "detect", "sample"}


@pytest.mark.minute
@pytest.mark.parametrize("frame", ["centre", "opencv", "opencv_old"])
def test_poses_that_were_given_are_read_in_the_frame_that_the_flag_names(copy, drawn, frame):
    text = (copy / "capture.json").read_text().replace('"centre"', f'"{frame}"')
    (copy / "capture.json").write_text(text)
    T_board_frame = frame_in_board(Board(), frame)
    theirs = invert(T_board_frame) @ drawn[1][1]
    write_pose(copy / "board_00001.txt", theirs)
    write_pose(copy / "correction_00001.txt", CORRECTION)
    write_pose(copy / "correction_00002.txt", CORRECTION)
    after = estimate_poses(opened(copy), Estimation())
    assert after.estimate.views[1].T_board_cam == pytest.approx(T_board_frame @ CORRECTION @ theirs, abs=1e-9)
    board = drawn[2].by_name["markers"].views[2].T_board_cam
    ours = T_board_frame @ CORRECTION @ invert(T_board_frame)
    assert np.array_equal(after.by_name["markers"].views[2].T_board_cam, board)
    for name in ("article", "joint"):
        assert after.by_name[name].views[2].T_board_cam == pytest.approx(ours @ board, abs=1e-12)
    assert "correction_00002.txt is kept as it was given" in after.estimate.views[2].reasons[-1]


def test_a_board_pose_serves_where_no_marker_is_seen_and_our_own_files_of_an_earlier_run_change_nothing(copy, drawn):
    cv2.imwrite(str(copy / "rgb_00003.png"), np.full((540, 960, 3), 120, np.uint8))
    write_pose(copy / "board_00003.txt", drawn[1][3])
    before = estimate_poses(opened(copy), Estimation()).estimate.views
    assert before[3].status == "used" and before[3].T_board_cam == pytest.approx(drawn[1][3], abs=1e-12)
    own = {"board_00000.txt": np.eye(4), "correction_00000.txt": CORRECTION, "correction_00002.txt": CORRECTION}
    write_results(copy, {name: pose_text(T).encode() for name, T in own.items()}, {})
    for a, b in zip(before, estimate_poses(opened(copy), Estimation()).estimate.views, strict=True):
        assert np.array_equal(a.T_board_cam, b.T_board_cam)
    (copy / "board_00003.txt").unlink()
    write_pose(copy / "correction_00003.txt", CORRECTION)
    with pytest.raises(CaptureError, match="corrects nothing"):
        estimate_poses(opened(copy), Estimation())


# ---------------------------------------------------------------------------------------------- the camera


def rewrite(path, **numbers):
    """camera.json with other numbers."""
    spec = json.loads((path / "camera.json").read_bytes())
    (path / "camera.json").write_text(json.dumps(spec | {k: v(spec.get(k)) for k, v in numbers.items()}))


@pytest.mark.minute
def test_a_folder_that_was_processed_with_the_markers_camera_is_read_back_with_it(tmp_path):
    path = copy_of(box(), tmp_path)
    rewrite(path, cx=lambda cx: cx + 8)
    quick = Captures(estimation=Estimation(compare=False, calibrate=True), fusion=Fusion(voxel_m=0.004))
    done = process_folder(path, quick)
    assert any(
        "the camera is the markers' in place of camera.json's: fx = " in note for note in done.estimates.estimate.notes
    )
    right, read = open_folder(box()).camera.intrinsics, read_result(path).folder.camera.intrinsics
    assert abs(read.cx - right.cx) < 0.8 and open_folder(path).camera.intrinsics.cx == pytest.approx(right.cx + 8)
    assert done.estimates.estimate.views[0].T_board_cam == pytest.approx(read_truth(path).T_board_cam[0], abs=5e-3)


@pytest.mark.minute
def test_too_few_views_to_merge_say_why_others_are_left_out(tmp_path):
    path = copy_of(box(), tmp_path)
    for number in open_folder(path).numbers[1:]:
        rgb = path / f"rgb_{number:05d}.png"
        cv2.imwrite(str(rgb), np.zeros_like(cv2.imread(str(rgb))))
    with pytest.raises(
        CaptureError, match=r"[0-9]+ of [0-9]+ views are left out, and fusion.min_views is 2; view 1: no marker"
    ):
        process_folder(path, Captures(estimation=Estimation(compare=False)))


@pytest.mark.minute
def test_a_camera_that_fits_is_kept_when_calibration_is_asked_for_and_makes_no_pose_less_certain(tmp_path):
    """With three views a camera of the markers' own would move the poses by millimetres."""
    path = copy_of(box(), tmp_path)
    for number in range(3, len(open_folder(path).numbers)):
        for name in ("rgb", "depth", "mask"):
            path.joinpath(f"{name}_{number:05d}.png").unlink(missing_ok=True)
    plain, asked = (Estimation(compare=False, calibrate=calibrate) for calibrate in (False, True))
    kept, found = (estimate_poses(given_files(open_folder(path), spec), spec).estimate for spec in (plain, asked))
    assert found.notes == kept.notes and len(found.views) == 3
    for a, b in zip(found.views, kept.views, strict=True):
        assert np.array_equal(a.T_board_cam, b.T_board_cam) and np.array_equal(a.covariance, b.covariance)


@pytest.mark.minute
@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("file", "words", "right"),
    [
        ("fx_plus_1pc", r"fx = ([0-9.]+) \(", 611.8),
        ("no_lens", "see that `distortion` has all", None),  # it has eight numbers, which k1 alone does not stand for
        ("cx_plus_15", r"cx = ([0-9.]+) \(", 639.3),
    ],
)
def test_a_wrong_camera_of_an_independent_capture_is_told(file, words, right, tmp_path):
    """The mug of ../shared/data/captures, drawn by a ray caster that is not ours."""
    path, truth = copy_of(SHARED_DATA / "captures" / "m_ref", tmp_path), np.load(SHARED_DATA / "captures/mug.truth.npy")
    (path / "camera.json").write_bytes((SHARED_DATA / "captures" / "wrong_camera" / f"{file}.json").read_bytes())
    found = estimate_poses(opened(path), Estimation(compare=False)).estimate
    said = re.search(words, found.notes[0])
    assert found.notes[0].startswith("camera.json does not fit") and said
    assert right is None or float(said[1]) == pytest.approx(right, abs=0.2)
    for view in found.views:
        mm, sigma_mm = (
            errors(view.T_board_cam, truth[view.number])[0],
            1000 * np.sqrt(np.trace(view.covariance[:3, :3])),
        )
        assert mm < 1.25 * sigma_mm


# ---------------------------------------------------------------------------------------------- what a camera does to edges

EDGES = {
    "sharpen": {"sharpen": 1.0},
    "tone curve": {"tone_curve": {}},
    "jpeg": {"jpeg": 85},
    "linear": {"tone_curve": {"linear": True, "contrast": 0.0}},
}


@pytest.mark.minute
@pytest.mark.shared_data
@pytest.mark.parametrize("name", ["sharpen", *(pytest.param(n, marks=pytest.mark.slow) for n in [*EDGES][1:])])
def test_what_a_camera_does_to_edges_moves_no_pose_of_an_independent_capture(name, tmp_path, record_figure):
    """The mug of ../shared/data/captures, its photographs developed anew; without, its poses are within 0.03 mm."""
    path, truth = copy_of(SHARED_DATA / "captures" / "m_ref", tmp_path), np.load(SHARED_DATA / "captures/mug.truth.npy")
    for asked, bound_mm in (({}, 0.03), (EDGES[name], 0.1)):
        for file in path.glob("rgb_*.png"):
            rgb = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
            cv2.imwrite(str(file), develop(decode_codes(rgb), Simulate(**asked))[..., ::-1])
        mm, degrees = median_errors(estimate_poses(opened(path), Estimation(compare=False)).estimate, truth)
        record_figure(f"poses of the shared mug, {name if asked else 'as it is'}", "mm", mm, bound_mm)
        assert mm < bound_mm and degrees < 0.006


# ---------------------------------------------------------------------------------------------- what depth measures


def remeasure(path, change):
    """Every depth image with `change`(z, length of the pixel's ray at z = 1) in place of its z."""
    k = open_folder(path).camera.intrinsics
    rows, columns = np.mgrid[: k.height, : k.width] + 0.5
    length = np.sqrt(1 + ((columns - k.cx) / k.fx) ** 2 + ((rows - k.cy) / k.fy) ** 2)
    for file in path.glob("depth_*.png"):
        z = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), np.where(z > 0, np.rint(change(z.astype(float), length)), 0).astype(np.uint16))


DEPTH = {
    "ray": (lambda z, length: z * length, {}, r'is the distance along the ray, and .* says z: .* write "depth": "ray"'),
    "z said to be ray": (lambda z, length: z, {"depth": "ray"}, r'is z along the optical axis, .* write "depth": "z"'),
    "tenths of millimetres": (
        lambda z, length: 10 * z,
        {},
        r"depth_units_per_m in camera\.json is 1000, and 10000 would fit",
    ),
    "metres": (lambda z, length: z, {"depth_units_per_m": 1.0}, r"is 1000 times .* is 1, and 1000 would fit"),
    "100 mm off": (lambda z, length: z + 100, {}, r"depth is off by \+(9|10)\d mm at every distance"),
}


@pytest.mark.minute
@pytest.mark.parametrize("seed", SEEDS)
def test_depth_that_no_sensor_measures_is_named_with_the_key_to_change(seed, tmp_path):
    kept = made(seed, views=VIEWS, image_scale=0.35, depth_noise=KinectDepthNoise()).folder.path
    for name, (change, said, words) in DEPTH.items():
        path = copy_of(kept, tmp_path / name)
        remeasure(path, change)
        rewrite(path, **{key: lambda _, value=value: value for key, value in said.items()})
        with pytest.raises(CaptureError, match=words):
            estimate_poses(opened(path), Estimation())
        (path / "camera.json").write_bytes((kept / "camera.json").read_bytes())
        if name == "ray":  # read as what it is, it is what it was
            rewrite(path, depth=lambda _: "ray")
            mended, before = (read_view(open_folder(p), 4).depth.astype(int) for p in (path, kept))
            assert np.abs(mended - before).max() <= 1
            assert len(estimate_poses(opened(path), Estimation(compare=False)).estimate.used) == VIEWS
    remeasure(
        path := copy_of(kept, tmp_path / "usual"), lambda z, _: 1.03 * z - 15
    )  # a print and a sensor as they may be
    assert len(estimate_poses(opened(path), Estimation(compare=False)).estimate.used) == VIEWS


# ---------------------------------------------------------------------------------------------- an object that moved


@pytest.mark.minute
@pytest.mark.parametrize(
    ("category", "seed"),
    [("mug", 21), *(pytest.param(*one, marks=pytest.mark.slow) for one in (("can", 22), ("box", 23)))],
)
def test_photographs_of_an_object_that_moved_are_told_from_those_of_the_largest_group(
    category, seed, tmp_path, monkeypatch
):
    turned = pose(rotation_about(np.array([0.0, 0, 1]), np.pi), np.zeros(3))
    places = {"first": np.eye(4), "shifted": translation(0.03, 0.01, 0), "turned": turned}
    settings = Simulate(views=VIEWS, image_scale=0.35, depth_noise=KinectDepthNoise())
    paths = tmp_path / "mixed"
    for name, moved in places.items():
        monkeypatch.setattr(
            simulate, "place_object", lambda asset, rng, T=moved: frozen_array(T @ place_object(asset, rng))
        )
        monkeypatch.setattr(simulate, "plan_path", lambda s, _, rng: plan_path(s, np.array([0, 0, 0.05]), rng))
        simulate.simulate_capture(settings, Board(), asset_of(category, seed), SceneChance(seed, 0), tmp_path / name)
    for name, numbers, expected in (
        ("shifted", (3, 4, 8), [3, 4, 8]),
        ("turned", (5,), [5] if category == "mug" else []),
    ):
        shutil.rmtree(paths, ignore_errors=True)
        shutil.copytree(tmp_path / "first", paths)
        for number in numbers:
            for kind in ("rgb", "depth"):
                shutil.copy(tmp_path / name / f"{kind}_{number:05d}.png", paths)
        camera = json.loads((paths / "camera.json").read_text())
        for centre in ("0", "0.5"):  # a wrong camera that moves poses by tenths of a millimetre hides nothing
            (paths / "camera.json").write_text(json.dumps({**camera, "pixel_centre": centre}))
            found = estimate_poses(opened(paths), Estimation(compare=False)).estimate
            assert [view.number for view in found.views if view.status != "used"] == expected, found.notes[0]


def turn(path, number):
    """Both images of a view turned by 180 degrees, as a file manager does."""
    for kind in ("rgb", "depth"):
        file = str(path / f"{kind}_{number:05d}.png")
        cv2.imwrite(file, cv2.imread(file, cv2.IMREAD_UNCHANGED)[::-1, ::-1])


@pytest.mark.minute
@pytest.mark.parametrize("seed", SEEDS)
def test_an_image_that_is_turned_is_refused_and_spoils_nothing_else(seed, tmp_path):
    kept = made(seed, views=VIEWS, image_scale=0.35, depth_noise=KinectDepthNoise())
    path, truth = copy_of(kept.folder.path, tmp_path), read_truth(kept.folder.path).T_board_cam
    turn(path, 4)
    found = estimate_poses(opened(path), Estimation()).estimate
    assert found.views[4].status == "refused" and "turned by 180 degrees" in found.views[4].reasons[0]
    assert len(found.used) == VIEWS - 1 and not any("camera.json" in note or "moved" in note for note in found.notes)
    assert median_errors(found, truth)[0] < 0.3
    turn(path, 4)
    assert len(estimate_poses(opened(path), Estimation(compare=False)).estimate.used) == VIEWS


def test_where_markers_fit_the_board_no_other_board_is_looked_for(tmp_path, monkeypatch):
    """Two views of an object that moved: neither is used, and looking at photographs for other boards takes seconds."""
    truth = write_capture(tmp_path, 2)
    monkeypatch.setattr(drawn_captures, "BOX", tuple(np.add(corner, [0.06, 0, 0]) for corner in drawn_captures.BOX))
    write_view(tmp_path, draw_view(1, truth[1], np.random.default_rng(1)))
    monkeypatch.setattr(captures, "other_board", lambda folder: pytest.fail("another board is looked for"))
    with pytest.raises(CaptureError, match="the object moved on the board") as refused:
        estimate_poses(opened(tmp_path), Estimation(compare=False))
    assert refused.value.reason == "poses"


@pytest.mark.minute
@pytest.mark.shared_data
def test_views_far_apart_of_an_object_that_never_moved_are_all_used(tmp_path):
    """The mug of ../shared/data/captures: five views, and every second photograph without depth."""
    found = estimate_poses(opened(SHARED_DATA / "captures" / "m_five"), Estimation(compare=False)).estimate
    assert len(found.used) == 5 and not any("moved" in note for note in found.notes)
    path = copy_of(SHARED_DATA / "captures" / "m_ref", tmp_path)
    for number in range(0, 20, 4):
        (path / f"depth_{number:05d}.png").unlink()
    found = estimate_poses(opened(path), Estimation(compare=False)).estimate
    assert len(found.used) == 10 and not any("moved" in note for note in found.notes)


# ---------------------------------------------------------------------------------------------- manual corrections


@pytest.mark.minute
@pytest.mark.parametrize("estimate", ["markers", "joint"])
def test_a_manual_correction_moves_its_pose_and_notes_are_there_once(estimate, tmp_path):
    path, watch = copy_of(box(), tmp_path), processor_clock()
    write_pose(path / "correction_00002.txt", translation(0.01, 0.02, 0.03))
    (path / "depth_00003.png").unlink()
    cv2.imwrite(str(path / "depth_00005.png"), np.zeros((378, 672), np.uint16))
    quick = Captures(estimation=Estimation(estimate=estimate, compare=False), fusion=Fusion(voxel_m=0.004))
    estimates, merged = estimate_surface(opened(path), quick, watch)
    view, T = estimates.estimate.views[2], read_truth(path).T_board_cam[2]
    assert np.allclose(view.T_board_cam[:3, 3] - T[:3, 3], [0.01, 0.02, 0.03], atol=3e-3)
    assert any("kept as it was given" in reason for reason in view.reasons) and view.status == "used"
    assert merged.notes == ("2 used views have no depth",)
    for note in (*merged.notes, "1 pose from manual corrections"):
        assert estimates.estimate.notes.count(note) == 1
    assert {"estimate", "read", "fuse"} <= set(watch.seconds)
    for number, (board, correction) in corrections_of(opened(path), estimates).items():
        assert np.allclose(correction @ board, estimates.estimate.views[number].T_board_cam)


# ---------------------------------------------------------------------------------------------- the surface


@pytest.mark.minute
def test_a_mask_of_the_user_is_kept_and_a_view_without_a_pose_or_a_capture_without_depth_is_refused(tmp_path):
    path, mask = copy_of(box(), tmp_path), np.zeros((378, 672), np.uint8)
    mask[200:300, 400:500] = 255
    cv2.imwrite(str(path / "mask_00001.png"), mask)
    estimate = true_estimates(path, without=(2,)).estimate
    assert np.array_equal(read_posed(opened(path), estimate, 1).mask, mask > 0)
    assert read_posed(opened(path), estimate, 3).mask is None
    with pytest.raises(CaptureError, match="view 2 has no pose: left out by the test"):
        read_posed(opened(path), estimate, 2)
    for number in range(VIEWS):
        (path / f"depth_{number:05d}.png").unlink()
    before = sorted(file.name for file in path.iterdir())
    for work in (
        lambda: reconstruct(opened(path), estimate, Fusion(), processor_clock()),
        lambda: process_folder(path, CAPTURES),  # and the folder stays as it was
    ):
        with pytest.raises(CaptureError, match=r"none of the \d+ used views .* has depth") as refusal:
            work()
        assert refusal.value.reason == "no_depth"
    assert sorted(file.name for file in path.iterdir()) == before


# ---------------------------------------------------------------------------------------------- the processed folder


@pytest.mark.minute
def test_each_photograph_is_decoded_once_and_again_only_for_a_mask_of_the_user(tmp_path, monkeypatch):
    path, read = copy_of(box(), tmp_path), []
    shutil.copy(path / "truth" / "mask_00002.png", path / "mask_00002.png")
    monkeypatch.setattr(captures, "read_view", lambda *which: read.append(which[1]) or read_view(*which))
    process_folder(path, Captures(estimation=Estimation(compare=False), fusion=Fusion(voxel_m=0.004)))
    assert sorted(read) == sorted([*range(VIEWS), 2])


def test_every_view_has_its_files_near_the_truth_and_process_json_names_them():
    path, done = processed()
    record, truth = json.loads((path / "process.json").read_bytes()), read_truth(path)
    kinds = (("board", "txt"), ("correction", "txt"), ("mask", "png"))
    expected = {f"{kind}_{n:05d}.{end}" for n in range(VIEWS) for kind, end in kinds}
    assert set(record["files"]) == expected | {"cloud.ply", "mesh.ply", "poses.parquet"}
    assert len(read_surface(path).points) == record["cloud_points"] == len(done.merged.surface.points)
    assert {"poses_detect", "poses_joint", "read", "fuse", "masks", "total"} <= set(record["seconds"])
    assert pq.read_table(path / "poses.parquet").num_rows == 3 * VIEWS
    assert record["settings"]["fusion"]["voxel_m"] == 0.002
    for n in range(VIEWS):
        T = read_pose(path / f"correction_{n:05d}.txt") @ read_pose(path / f"board_{n:05d}.txt")
        assert np.linalg.norm(T[:3, 3] - truth.T_board_cam[n][:3, 3]) < 0.003
        mask, true = (cv2.imread(str(p / f"mask_{n:05d}.png"), 0) > 0 for p in (path, path / "truth"))
        assert (mask & true).sum() / (mask | true).sum() > 0.93


@pytest.mark.minute
def test_a_second_run_writes_the_same_bytes_and_keeps_what_the_user_changed(tmp_path):
    def results(path):
        record = json.loads((path / "process.json").read_bytes())
        return {name: (path / name).read_bytes() for name in record["files"]} | {"record": record | {"seconds": None}}

    path = copy_of(processed()[0], tmp_path)
    process_folder(path, CAPTURES)
    assert results(path) == results(processed()[0]) and not list(path.glob(".*"))
    moved = translation(0.002, 0.0, 0.0) @ read_pose(path / "correction_00001.txt")
    write_pose(path / "correction_00001.txt", moved)
    given = cv2.imread(str(path / "truth" / "mask_00002.png"), 0)
    given[:, :5] = 255
    cv2.imwrite(str(path / "mask_00002.png"), given)
    done = process_folder(path, CAPTURES)
    assert done.users == ("correction_00001.txt", "mask_00002.png")
    assert "1 pose from manual corrections" in done.estimates.estimate.notes
    final = done.estimates.estimate.views[1].T_board_cam
    assert np.allclose(final, moved @ read_pose(path / "board_00001.txt"), atol=1e-12)
    assert np.array_equal(cv2.imread(str(path / "mask_00002.png"), 0), given)
    assert "mask_00002.png" not in json.loads((path / "process.json").read_bytes())["files"]


def test_poses_parquet_has_residuals_before_and_after_and_the_camera_columns_of_a_dataset():
    covariance = np.diag([1e-6, 4e-6, 1e-8, 1e-8, 1e-8, 9e-8])
    before = tuple(ViewEstimate(n, "used", translation(n, 0, 0), None, 30, 0.5, 4.0) for n in (0, 2))
    used = ViewEstimate(0, "used", translation(0, 1, 0), covariance, 30, 0.2, 1.0)
    after = (used, ViewEstimate(2, "refused", None, None, 0, None, None, ("no marker",)))
    views = {"markers": CaptureEstimate("markers", before), "joint": CaptureEstimate("joint", after)}
    table = pq.read_table(io.BytesIO(pose_table(Estimates("joint", views), CaptureCamera(KINECT, np.zeros(8)))))
    rows = table.to_pylist()
    told = [(row["estimate"], row["number"], row["chosen"]) for row in rows]
    assert told == [("markers", 0, False), ("markers", 2, False), ("joint", 0, True), ("joint", 2, True)]
    joint = rows[2]
    assert (joint["reprojection_before_px"], joint["reprojection_px"]) == (0.5, 0.2)
    assert (joint["depth_before_mm"], joint["depth_mm"]) == (4.0, 1.0)
    assert joint["sigma_mm"] == pytest.approx(2.0) and joint["sigma_deg"] == pytest.approx(np.degrees(3e-4))
    assert rows[3]["T_world_cam"] is None and rows[3]["reasons"] == ["no marker"] and rows[3]["sigma_mm"] is None
    assert rows[1]["cx"] - rows[1]["cx_opencv"] == 0.5 and np.reshape(rows[1]["T_world_cam"], (4, 4))[0, 3] == 2.0


# ---------------------------------------------------------------------------------------------- read back


@pytest.fixture(scope="module")
def result():
    return read_result(processed()[0])


def test_poses_correction_and_surface_are_those_of_the_run(result):
    done = processed()[1]
    chosen = done.estimates.estimate
    for stored, view in zip(result.estimate.views, chosen.views, strict=True):
        assert (stored.number, stored.status) == (view.number, view.status)
        assert np.allclose(stored.T_board_cam, view.T_board_cam, atol=1e-12)
    assert result.estimate.depth.offset_m == chosen.depth.offset_m and result.estimate.depth.scale == chosen.depth.scale
    assert np.array_equal(result.estimate.depth.T_cam_depth, chosen.depth.T_cam_depth)
    assert np.allclose(result.surface.vertices, done.merged.surface.vertices, atol=1e-7)
    assert np.array_equal(result.surface.views, done.merged.surface.views)
    assert result.captures.fusion == CAPTURES.fusion and len(result.body.faces) == len(done.merged.body.faces)


def test_a_folder_that_was_not_processed_or_whose_record_is_damaged_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="run `verso capture process") as refusal:
        read_result(box())
    assert refusal.value.reason == "not_processed"
    path = copy_of(processed()[0], tmp_path)
    record = json.loads((path / "process.json").read_bytes())
    for key in ("depth", "settings", "board_as_measured"):
        (path / "process.json").write_text(json.dumps(record | {key: "nonsense"}))
        with pytest.raises(CaptureError, match=r"process\.json is damaged"):
            read_result(path)
    (path / "process.json").write_text(json.dumps(record))
    whole = (path / "poses.parquet").read_bytes()
    for data in (b"", whole[:-9], b"x" * len(whole)):
        (path / "poses.parquet").write_bytes(data)
        with pytest.raises(CaptureError, match=r"poses\.parquet is damaged"):
            read_result(path)
    (path / "poses.parquet").unlink()
    with pytest.raises(CaptureError, match=r"poses\.parquet is not there: run"):
        read_result(path)


# ---------------------------------------------------------------------------------------------- views


@pytest.mark.minute
def test_a_mirror_view_stands_on_the_other_side_and_shows_the_true_depth(result):
    camera, d_z, view = result.mirror(5)
    T = result.estimate.views[5].T_board_cam
    pivot = T[:3, 3] + d_z * T[:3, 2]
    assert np.allclose(camera.position + 1.3 * camera.T_world_cam[:3, 2], pivot)
    assert np.allclose(camera.T_world_cam[:3, :3], half_turn(np.array([0.0, 0.0, 1.0])) @ T[:3, :3])
    truth = cast_view([placed(read_whole_truth(result.folder).surface)], camera)[0]
    both = view.mask & (truth > 0) & (view.depth_m > 0)
    assert both.sum() > 0.8 * (truth > 0).sum() and np.median(np.abs(view.depth_m - truth)[both]) < 0.0015
    assert 0.8 < view.measured_share <= 1.0
    own = result.posed(4).camera  # a view that is left out is no source
    assert result.synthesize(own).sources[0] == 4 and 4 not in result.synthesize(own, without=4).sources


@pytest.mark.minute
def test_synthesised_views_are_written_with_pose_and_shares_and_never_into_the_capture(result, tmp_path):
    T = result.estimate.views[2].T_board_cam
    told = write_synthesized(result, T, tmp_path / "views")
    rgb, depth, mask, measured = (
        cv2.imread(str(tmp_path / "views" / f"{kind}_00000.png"), cv2.IMREAD_UNCHANGED)
        for kind in ("rgb", "depth", "mask", "measured")
    )
    assert rgb.shape == (378, 672, 3) and depth.dtype == np.uint16
    assert np.array_equal(read_pose(tmp_path / "views" / "board_00000.txt"), T)
    assert ((mask > 0) & (depth > 0)).sum() > 1000 and not ((measured > 0) & (depth == 0)).any()
    assert told["measured_share"] == pytest.approx((measured > 0).sum() / (depth > 0).sum())
    record = json.loads((tmp_path / "views" / "views.json").read_bytes())
    assert record["views"] == [told] and record["camera"]["width"] == 672 and told["sources"][0] == 2
    mirrors = write_mirrors(result, tmp_path / "mirrors")
    assert [one["name"] for one in mirrors] == [f"{n:05d}" for n in range(VIEWS)]
    assert all(0.3 < one["d_z_m"] < 1.2 for one in mirrors) and len(list(tmp_path.glob("mirrors/rgb_*.png"))) == VIEWS
    with pytest.raises(OutputError, match="name another folder"):
        write_synthesized(result, T, result.folder.path)
    shutil.copytree(result.folder.path, tmp_path / "torn")
    depth = tmp_path / "torn/depth_00002.png"
    depth.write_bytes(depth.read_bytes()[:100])
    for read in (
        lambda torn: write_mirrors(torn, tmp_path / "no"),
        lambda torn: score_capture(torn, read_whole_truth(torn.folder)),
    ):
        with pytest.raises(CaptureError, match=r"depth_00002\.png is no image that can be read"):
            read(read_result(tmp_path / "torn"))


# ---------------------------------------------------------------------------------------------- scores


@pytest.mark.minute
def test_the_score_of_a_good_capture_is_good_and_poses_that_are_off_are_told_by_as_much(result):
    truth = read_whole_truth(result.folder)
    score = score_capture(result, truth, held_out=3)
    one = score.summary
    assert one.pose_mm < 2.0 and one.pose_deg < 0.2
    assert max(view.pose_mm for view in one.views.values()) >= one.pose_mm
    assert one.cloud_median_mm < 0.5 and one.cloud_p95_mm < 2.5 and one.completeness > 0.9
    assert one.depth_median_mm < 1.5
    assert sorted(score.held_out) == [0, 4, 9] and set(one.views) == set(range(VIEWS))
    assert one.views[4].depth_median_mm == score.held_out[4].depth_median_mm and one.views[5].depth_median_mm is None
    off = translation(0.0, 0.007, 0.0)
    views = tuple(
        dataclasses.replace(view, T_board_cam=frozen_array(off @ truth.T_board_cam[view.number]))
        for view in result.estimate.views
    )
    wrong = dataclasses.replace(result.estimate, views=views)
    summary = score_capture(dataclasses.replace(result, estimate=wrong), truth, held_out=1).summary
    assert summary.pose_mm == pytest.approx(7.0) and summary.pose_deg == pytest.approx(0.0, abs=1e-6)


def test_a_mesh_from_elsewhere_is_aligned_and_scored_as_in_place_and_a_file_that_is_none_refused(result, tmp_path):
    true = read_whole_truth(result.folder).surface
    away = pose(rotation_about(np.array([0.0, 0.0, 1.0]), 2.0), np.array([3.0, -1.0, 0.5]))
    lying = pose(rotation_about(np.array([1.0, 0.0, 0.0]), -0.5 * np.pi), np.zeros(3))  # y up, as glTF has it
    for T in (away, away @ lying):
        found, _, rms_mm = score_against_mesh(result, Mesh(transform(T, true.vertices), true.faces))
        assert rms_mm < 1.0 and describe_misfit(result.surface.points, rms_mm) is None
        assert found.cloud_median_mm < 1.0 and found.cloud_p95_mm < 3.0 and found.completeness > 0.9
    for scale, told in (
        (1000.0, "metres: scale it by 0.001 if"),
        (0.01, "scale it by 100 if"),
        (7.0, "is it this object"),
    ):
        with pytest.raises(CaptureError, match=told):
            score_against_mesh(result, Mesh(scale * true.vertices, true.faces))
    other = trimesh.creation.uv_sphere(0.5 * np.ptp(true.vertices, axis=0).max())
    rms_mm = score_against_mesh(result, Mesh(other.vertices, other.faces.astype(np.int32)))[2]
    assert "is it this object, whole?" in describe_misfit(result.surface.points, rms_mm)
    assert read_whole_truth(dataclasses.replace(open_folder(box()), path=tmp_path)) is None
    (tmp_path / "bad.ply").write_bytes(b"nonsense")
    for name, words in (
        ("none.ply", "missing: .* check its name"),
        ("bad.ply", "bad.ply is not a"),
        ("a.fbx", "none of .glb"),
    ):
        with pytest.raises(CaptureError, match=words):
            read_mesh_file(tmp_path / name)
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    assert len(read_mesh_file(tmp_path / "box.stl").faces) == 12
