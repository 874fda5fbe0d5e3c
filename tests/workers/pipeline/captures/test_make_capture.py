from pathlib import Path

import numpy as np
import pytest

from schemas.dataset.commit import FileEntry
from schemas.errors import CaptureError
from schemas.job.job import Job
from schemas.scene.scene import SceneOutput
from tests.captures import captures_job, exact_capture, use_exact_captures, write_folder
from workers.capture import make_capture
from workers.capture.make_capture import image_effects, run_capture
from workers.capture.results import open_sources
from workers.scene.context import Stopwatch, open_worker
from workers.store.images import decode_png
from workers.store.manifest import check_files, table_of_rows


def made(job: Job, folder: Path = Path(), scene_id: int = 0) -> SceneOutput:
    return run_capture(open_worker(job, open_sources(job, folder)), scene_id, Stopwatch())


@pytest.fixture
def folders(tmp_path) -> Path:
    write_folder(tmp_path / "shots" / "mug", "mug-0", truth=False)
    return tmp_path


def test_views_beyond_the_most_that_are_stored_are_left_out_evenly(monkeypatch, folders):
    monkeypatch.setattr(make_capture, "process_capture", lambda *_: exact_capture(views=6))
    job = captures_job(scenes=1, captures={"source": "folders", "folders": ["shots/mug"], "most_views": 3})
    rows = made(job, folders).rows
    assert sorted({row["capture"]["number"] for row in rows["views"]}) == [1, 3, 5]
    told = [(one["number"], one["status"]) for one in rows["scenes"][0]["capture"]["left_out"]]
    assert told == [(0, "flagged"), (2, "spare"), (4, "spare")]


def test_switches_of_the_job_are_the_effects_of_a_captures_images():
    assert image_effects(captures_job()).ran == ("mirror", "projection")
    off = captures_job(images={"projection": {"enabled": False}})
    assert image_effects(off).ran == ("mirror",)
    both = captures_job(images={"projection": {"splat": 3, "hidden_point_removal": True}})
    assert image_effects(both).ran == ("mirror", "projection", "splat", "hidden_point_removal")


def test_a_simulated_capture_leaves_rows_of_the_captures_schema_and_nothing_in_the_temporary_folder(
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


def test_each_used_view_is_a_pair_in_order_and_the_flagged_one_is_none(monkeypatch):
    use_exact_captures(monkeypatch)
    views = made(captures_job(), scene_id=1).rows["views"]
    assert [(row["pose_id"], row["role"], row["capture"]["number"]) for row in views] == [
        (8 + 2 * at + odd, role, number)
        for at, number in enumerate((1, 2))
        for odd, role in ((0, "input"), (1, "mirror"), (0, "projected"))
    ]


def test_a_folder_is_a_capture_and_one_that_changed_since_it_was_listed_is_refused(monkeypatch, folders):
    use_exact_captures(monkeypatch)
    job = captures_job(scenes=1, captures={"source": "folders", "folders": ["shots/mug"], "category": "cup"})
    context = open_worker(job, open_sources(job, folders))
    (scene,) = run_capture(context, 0, Stopwatch()).rows["scenes"]
    assert (scene["source"], scene["category"]) == ("capture", "mug")
    assert scene["capture"]["input_sha256"] == context.catalogue.captures[0].sha256
    (folders / "shots/mug/rgb_00001.png").write_bytes(b"more")
    with pytest.raises(CaptureError, match="shots/mug does not hold what it held"):
        run_capture(context, 0, Stopwatch())


def test_the_category_of_a_folder_without_capture_json_is_the_jobs(monkeypatch, folders):
    use_exact_captures(monkeypatch)
    (folders / "shots/mug/capture.json").unlink()
    (folders / "shots/mug").rename(folders / "shots/mug-1")
    job = captures_job(scenes=1, captures={"source": "folders", "folders": ["shots/mug-1"], "category": "cup"})
    output = made(job, folders)
    assert {row["category"] for row in output.rows["views"]} == {"cup"}
    assert all(file.path.startswith(("cup/", "assets/cup/")) for file in output.files)


def test_files_are_those_of_the_rows_and_images_have_the_size_of_the_camera(monkeypatch):
    use_exact_captures(monkeypatch)
    output = made(captures_job())
    entries = {one.path: FileEntry(path=one.path, bytes=len(one.data), sha256=one.sha256) for one in output.files}
    check_files(output, entries)
    images = {file.path: decode_png(file.data, file.path) for file in output.files if file.path.endswith(".png")}
    assert images["mug/RGB00000.png"].shape == (108, 192, 3)
    assert images["mug/depth00001.png"].dtype == np.uint16
    assert set(np.unique(images["mug/segment00000.png"]).tolist()) == {0, 2, 3}
