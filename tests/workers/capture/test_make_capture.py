"""One capture of a job: its pairs, files and rows, for folders, simulations and stand-ins whose every depth is known."""

import dataclasses
import io
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from schemas.capture import PosedImages, Reconstruction
from schemas.dataset.commit import FileEntry
from schemas.errors import AssetSourceError, CaptureError, ViewError
from schemas.job.assets import Assets
from schemas.job.captures import Board, Captures, Estimation
from schemas.job.job import Job
from schemas.scene.scene import SceneOutput
from schemas.scene.view import Camera, Intrinsics
from tests.captures import captures_job, exact_capture, rolled_pose, use_exact_captures, write_folder
from tests.workers.capture.simulated import box, copy_of
from workers.assets.catalogue import open_catalogue
from workers.assets.glb import asset_glb, read_shape
from workers.capture import make_capture
from workers.capture.folder import open_folder
from workers.capture.make_capture import (
    board_asset,
    image_effects,
    make_pairs,
    place_capture,
    process_capture,
    reconstructed_asset,
    run_capture,
)
from workers.capture.results import open_sources
from workers.capture.rows import (
    CapturedObject,
    LeftOut,
    Origin,
    capture_regions,
    make_capture_pair,
    record_capture,
)
from workers.capture.truth import read_truth
from workers.geometry.camera import look_at
from workers.geometry.frames import invert
from workers.geometry.projection import Bounds, Seen, compare_covisible
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.context import WorkerContext, open_worker
from workers.stopwatch import Stopwatch
from workers.store.images import decode_png
from workers.store.manifest import check_files, table_of_rows

JOB = captures_job(cameras={"mirror": {"T_z_m": 0.6}})
DONE = exact_capture()


# ---------------------------------------------------------------------------------------------- regions

K = Intrinsics(width=320, height=180, fx=152.0, fy=150.0, cx=160.4, cy=91.1)


@pytest.mark.parametrize("number", [0, 1, 2, 3])
@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_the_board_is_the_polygon_that_opencv_projects_its_corners_to(number, scale):
    board = Board(measured_ruler_m=0.2 * scale)
    camera = Camera(K, rolled_pose(number, 4))
    region = capture_regions(camera, board, np.zeros((K.height, K.width), bool))
    x, y = 0.3 * scale, 0.2 * scale
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    T = invert(camera.T_world_cam)
    matrix = np.array([[K.fx, 0, K.cx_opencv], [0, K.fy, K.cy_opencv], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(corners, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], matrix, None)
    drawn = cv2.fillConvexPoly(
        np.zeros((K.height, K.width), np.uint8), np.round(pixels * 16).astype(int), 2, cv2.LINE_8, 4
    )
    rim = cv2.polylines(np.zeros_like(drawn), [np.round(pixels).astype(int)], True, 1, 3)
    assert set(np.unique(region)) == {0, 2}
    assert (region == drawn)[rim == 0].all()
    assert 2000 < np.count_nonzero(region) < region.size


def test_the_object_is_where_its_mask_is_and_a_board_from_below_or_behind_the_camera_is_nothing():
    mask = np.zeros((K.height, K.width), bool)
    mask[:60] = True
    assert ((capture_regions(Camera(K, rolled_pose(1, 4)), Board(), mask) == 3) == mask).all()
    below = look_at(np.array([0.1, 0.0, -0.5]), np.zeros(3))
    away = look_at(np.array([0.3, 0.0, 0.5]), np.array([1.0, 0.0, 1.5]))
    for T in (below, away):
        assert not capture_regions(Camera(K, T), Board(), mask & False).any()


# ---------------------------------------------------------------------------------------------- assets


def surface(closed: bool = True) -> Reconstruction:
    """A red box of 0.1 x 0.2 x 0.3 m about (0.05, -0.02, 0.15), with or without its bottom."""
    body = trimesh.creation.box((0.1, 0.2, 0.3))
    faces = body.faces if closed else body.faces[body.face_normals[:, 2] > -0.5]
    red = np.tile(np.array([[200, 10, 20]], np.uint8), (8, 1))
    vertices = np.asarray(body.vertices) + np.array([0.05, -0.02, 0.15])
    return Reconstruction(vertices, vertices * 0, red, np.ones(8, np.int32), vertices, faces.astype(np.int32), red)


def test_the_reconstructed_object_stands_at_the_middle_of_its_box_and_reads_back_with_its_colours():
    names = "box-00003", "box", "CC0-1.0", "capture"
    (asset, T), (open_, _) = (reconstructed_asset(surface(closed), names, Assets()) for closed in (True, False))
    np.testing.assert_allclose(T[:3, 3], [0.05, -0.02, 0.15], atol=1e-15)
    np.testing.assert_allclose(asset.extents_m, [0.1, 0.2, 0.3], atol=1e-15)
    np.testing.assert_allclose(asset.shape.vertices + T[:3, 3], surface().vertices, atol=1e-15)
    assert (asset.source, asset.licence, asset.watertight) == ("capture", "CC0-1.0", True)
    assert asset.volume_m3 == pytest.approx(0.006, rel=1e-9)
    assert (open_.watertight, open_.volume_m3) == (False, None) and "reconstructed" in open_.notes[0]
    assert open_.sha256 != asset.sha256
    scene = trimesh.load_scene(io.BytesIO(asset_glb(asset)), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.extents, [0.1, 0.2, 0.3], atol=1e-7)
    (part,) = read_shape(asset_glb(asset))[0].parts
    assert {tuple(color) for color in part.colors.tolist()} == {(200, 10, 20, 255)}


def test_a_board_has_its_true_size_and_a_name_that_tells_it_from_others():
    boards = (Board(measured_ruler_m=0.19), Board(), Board(first_id=15), Board(columns=6))
    assets = [board_asset(board, Assets()) for board in boards]
    np.testing.assert_allclose(assets[0].extents_m, [0.57, 0.38, 0.0], atol=1e-12)
    assert len({asset.instance_id for asset in assets}) == 4


# ---------------------------------------------------------------------------------------------- pairs


def thing() -> CapturedObject:
    return place_capture(JOB, 2, DONE, "mug", "capture")


def pair_of(images: PosedImages, at: int = 1):
    return make_capture_pair(JOB, thing(), images, at, DONE.synthesize, shared_renderer().count_pixels).pair


def test_the_board_has_one_place_in_both_views_and_no_region_is_where_nothing_was_synthesised():
    pair = pair_of(DONE.images(1))
    first, mirror = pair.input, pair.mirror
    source, target = (Seen(view.depth, view.region, view.camera) for view in (first, mirror))
    wide, units = Bounds(facing=-1.0, smooth_m=(1.0, 1.0), hidden_m=1.0), JOB.images.depth_units_per_m
    difference_m, region = compare_covisible(source, target, np.flatnonzero(first.region == 2), wide, units)
    assert len(difference_m) > 1000 and set(region.tolist()) == {2} and np.median(difference_m) < 0.0005
    assert pair.agreement is None
    assert not mirror.region[mirror.depth == 0].any() and (mirror.region == 3).any()


def test_pose_ids_follow_from_capture_and_place_and_labels_name_board_and_object():
    pair = pair_of(DONE.images(2), at=3)
    told = [(view.role, view.pose_id, view.parent_id) for view in pair.views]
    assert told == [("input", 22, 22), ("mirror", 23, 22), ("projected", 22, 22)]
    for view in (pair.input, pair.mirror):
        assert [(one.region_id, one.category) for one in view.labels] == [(2, "board"), (3, "mug")]
        assert 0.95 < view.labels[1].visible_fraction <= 1.0


def test_a_view_without_depth_of_the_object_has_no_pair_and_what_is_switched_off_is_not_made():
    seen = DONE.images(1)
    with pytest.raises(ViewError):
        pair_of(PosedImages(1, seen.camera, seen.rgb, np.where(seen.mask, 0.0, seen.depth_m), seen.mask))
    job = captures_job(images={"projection": {"enabled": False}}, cameras={"mirror": {"enabled": False}})
    alone = dataclasses.replace(thing(), effects=image_effects(job))

    def refuse(camera):
        raise AssertionError

    one = make_capture_pair(job, alone, seen, 0, refuse, shared_renderer().count_pixels)
    assert (len(one.pair.views), one.mirror) == (1, None)


# ---------------------------------------------------------------------------------------------- rows


@pytest.fixture(scope="module")
def context() -> WorkerContext:
    job = captures_job()
    return open_worker(job, open_sources(job, Path()))


def rows_of(context: WorkerContext, done=DONE, scene_id: int = 0, more: tuple = ()) -> dict[str, list]:
    placed = place_capture(context.job, scene_id, done, "mug", "capture")
    pairs = [*make_pairs(context, placed, done, Stopwatch()), *more]
    return record_capture(context, placed, done, Origin(Path(), None, "f" * 64), pairs, Stopwatch()).rows


def test_quality_columns_are_those_of_the_used_views_and_errors_are_absent_without_truth(context):
    scored, unknown = (rows_of(context, dataclasses.replace(DONE, score=s)) for s in (DONE.score, None))
    quality = scored["scenes"][0]["capture"]
    assert quality["reprojection_before_px"] == pytest.approx(0.515)  # views 1 and 2: 0.51 and 0.52
    assert quality["reprojection_px"] == pytest.approx(0.215)
    assert (quality["markers"], quality["depth_offset_m"], quality["identified"]) == (60, 0.002, ["offset_m"])
    assert quality["measured_share"] == pytest.approx(0.97)
    assert quality["completeness"] == 0.98 and unknown["scenes"][0]["capture"]["completeness"] is None
    known = [(row["capture"]["number"], row["role"], row["capture"]["depth_median_mm"]) for row in scored["views"]]
    assert [one for one in known if one[2] is not None] == [(1, "input", 0.5)]
    assert {row["capture"]["pose_mm"] for row in unknown["views"]} == {None}
    told = {row["role"]: (row["capture"]["sources"], row["capture"]["measured_share"]) for row in scored["views"]}
    assert told == {"input": (None, None), "mirror": ([1, 2], 0.97), "projected": (None, None)}
    spare = rows_of(context, more=(LeftOut(1, "spare", "pairs_per_scene is 4"),))["scenes"][0]["capture"]
    assert [(one["number"], one["status"]) for one in spare["left_out"]] == [(0, "flagged"), (1, "spare")]
    assert spare["views"] == 1


def test_captures_of_one_object_are_different_assets_of_one_split(context):
    rows = [row for n in range(6) for row in rows_of(context, scene_id=n)["assets"] if row["category"] == "mug"]
    split = context.job.assets.split
    assert len({row["instance_id"] for row in rows}) == 6 and {row["split"] for row in rows} == {split.of("mug-0")}
    assert len({split.of(f"mug-0-{n:05d}") for n in range(40)}) > 1  # captures of one object would leak


# ---------------------------------------------------------------------------------------------- the list of steps


def made(job: Job, folder: Path = Path(), scene_id: int = 0) -> SceneOutput:
    return run_capture(open_worker(job, open_sources(job, folder)), scene_id, Stopwatch())


def folders_job(*names: str, **changes) -> Job:
    return captures_job(scenes=1, captures={"folders": list(names)}, **changes)


@pytest.fixture
def folders(tmp_path) -> Path:
    write_folder(tmp_path / "shots" / "mug", "mug-0", truth=False)
    return tmp_path


def test_views_beyond_the_most_that_are_stored_are_left_out_evenly(monkeypatch, folders):
    monkeypatch.setattr(make_capture, "process_capture", lambda *_: exact_capture(views=6))
    rows = made(folders_job("shots/mug", pairs_per_scene=3), folders).rows
    assert sorted({row["capture"]["number"] for row in rows["views"]}) == [1, 3, 5]
    told = [(one["number"], one["status"]) for one in rows["scenes"][0]["capture"]["left_out"]]
    assert told == [(0, "flagged"), (2, "spare"), (4, "spare")]


def test_a_simulated_capture_leaves_files_and_rows_of_the_schema_and_nothing_in_the_temporary_folder(
    monkeypatch, tmp_path
):
    use_exact_captures(monkeypatch)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    output = made(captures_job())
    assert list(tmp_path.iterdir()) == []
    for table, rows in output.rows.items():
        table_of_rows(table, rows)
    (scene,) = output.rows["scenes"]
    assert (scene["source"], scene["category"], scene["penetration_mm"]) == ("simulated_capture", "mug", None)
    assert scene["effects"] == ["depth_noise", "mirror", "projection"]
    assert [one["effect"] for one in scene["skipped"]] == ["motion_blur"]
    quality = scene["capture"]
    assert quality["left_out"] == [{"number": 0, "status": "flagged", "why": "blurred: 9 px"}]
    assert (quality["views"], quality["estimate"], quality["input_sha256"]) == (2, "joint", None)
    assert quality["reprojection_before_px"] > quality["reprojection_px"] > 0.0
    files = output.files
    check_files(output, {one.path: FileEntry(path=one.path, bytes=len(one.data), sha256=one.sha256) for one in files})
    images = {file.path: decode_png(file.data, file.path) for file in files if file.path.endswith(".png")}
    assert images["mug/RGB00000.png"].shape == (108, 192, 3) and images["mug/depth00001.png"].dtype == np.uint16
    assert set(np.unique(images["mug/segment00000.png"]).tolist()) == {0, 2, 3}
    views = made(captures_job(), scene_id=1).rows["views"]  # each used view is a pair in order, the flagged one is none
    assert [(row["pose_id"], row["role"], row["capture"]["number"]) for row in views] == [
        (8 + 2 * at + odd, role, number)
        for at, number in enumerate((1, 2))
        for odd, role in ((0, "input"), (1, "mirror"), (0, "projected"))
    ]


def test_a_folder_is_a_capture_and_one_that_changed_since_it_was_listed_is_refused(monkeypatch, folders):
    use_exact_captures(monkeypatch)
    job = folders_job("shots/mug")
    context = open_worker(job, open_sources(job, folders))
    (scene,) = run_capture(context, 0, Stopwatch()).rows["scenes"]
    assert (scene["source"], scene["category"]) == ("capture", "mug")
    assert scene["capture"]["input_sha256"] == context.catalogue.captures[0].sha256
    (folders / "shots/mug/rgb_00001.png").write_bytes(b"more")
    with pytest.raises(CaptureError, match="shots/mug does not hold what it held"):
        run_capture(context, 0, Stopwatch())
    for name in ("capture.json", "rgb_00001.png"):
        (folders / "shots/mug" / name).unlink()
    (folders / "shots/mug").rename(folders / "shots/mug-1")  # without capture.json it has no category
    output = made(folders_job("shots/mug-1"), folders)
    assert {row["category"] for row in output.rows["views"]} == {"object"}
    assert all(file.path.startswith(("object/", "assets/object/")) for file in output.files)


def test_folders_are_relative_to_the_job_file_and_their_files_decide_the_digest(tmp_path):
    for name in ("mug", "box"):
        (tmp_path / "shots" / name).mkdir(parents=True)
        (tmp_path / "shots" / name / "rgb_00000.png").write_text(name)
    before = open_sources(folders_job("shots/mug", "shots/box"), tmp_path)
    assert [listing.folder.name for listing in before.captures] == ["mug", "box"]
    (tmp_path / "shots").rename(tmp_path / "moved")
    assert open_sources(folders_job("moved/mug", "moved/box"), tmp_path).digest == before.digest
    (tmp_path / "moved/box/rgb_00000.png").write_text("other")
    changed = open_sources(folders_job("moved/mug", "moved/box"), tmp_path)
    assert changed.digest != before.digest and changed.captures[0].sha256 == before.captures[0].sha256
    assert open_sources(folders_job("moved/box", "moved/mug"), tmp_path).digest != changed.digest
    with pytest.raises(AssetSourceError, match=r"captures\.folders\.1: .*nowhere: there is no such folder") as caught:
        open_sources(folders_job("moved/mug", "nowhere"), tmp_path)
    assert caught.value.exit_code == 2
    for keys in ({}, {"captures": {}}):  # without folders the digest is that of the shapes alone
        job = Job.model_validate({"name": "t", **keys})
        assert open_sources(job, Path()).digest == open_catalogue(job.assets, Path(), tuple(job.categories)).digest


# ---------------------------------------------------------------------------------------------- the whole chain


@pytest.mark.minute
def test_a_capture_is_processed_without_a_file_more_or_less_in_its_folder():
    path, watch = box(), Stopwatch()
    before, truth = sorted(path.rglob("*")), read_truth(path)
    done = process_capture(open_folder(path), Captures(estimation=Estimation(compare=True)), watch)
    used = done.estimates.estimate.used
    assert sorted(path.rglob("*")) == before and {"estimate", "fuse", "score"} <= set(watch.seconds)
    assert set(done.estimates.by_name) == {"markers", "article", "joint"} and done.score.cloud_median_mm < 3.0
    for view in used:
        assert np.linalg.norm(view.T_board_cam[:3, 3] - truth.T_board_cam[view.number][:3, 3]) < 0.003
    assert set(done.score.views) == {view.number for view in used} and done.images(used[0].number).mask.any()


@pytest.mark.minute
def test_without_truth_there_is_no_score(tmp_path):
    bare = copy_of(box(), tmp_path)
    shutil.rmtree(bare / "truth")
    quick = Captures(estimation=Estimation(estimate="markers", compare=False))
    assert process_capture(open_folder(bare), quick, Stopwatch()).score is None
