"""What a scene leaves behind: rows with exactly the tables' columns, whatever became of it."""

import hashlib
from pathlib import Path

import pytest

from schemas.dataset.tables import SCHEMAS
from schemas.errors import SettleError
from services.job.job_file import validate_job
from tests.datasets import SMALL, overlaid
from workers.assets.catalogue import open_catalogue
from workers.scene.context import Stopwatch, open_worker
from workers.scene.make_scene import make_scene
from workers.scene.rows import failed_scene, record_scene, timing_row
from workers.store.manifest import table_of_rows


@pytest.fixture(scope="module")
def recorded():
    """(scene, its output) with three objects."""
    job = validate_job(overlaid(SMALL, {"objects_per_scene": 3}), "test")
    context = open_worker(job, open_catalogue(job.assets, Path(), tuple(job.categories)))
    scene = make_scene(context, 0, Stopwatch())
    return scene, record_scene(context, scene, Stopwatch())


def test_rows_have_the_tables_columns_and_types(recorded):
    _, output = recorded
    for table, rows in output.rows.items():
        assert table_of_rows(table, rows).schema == SCHEMAS[table]
    counts = {table: len(rows) for table, rows in output.rows.items()}
    assert counts == {"scenes": 1, "views": 4, "objects": 3 * 4, "assets": 4, "failures": 0}


def test_a_views_files_are_those_that_are_written_with_their_digests(recorded):
    _, output = recorded
    listed = {file["path"]: file for row in output.rows["views"] for file in row["files"]}
    images = {file.path: file.data for file in output.files if file.path.endswith(".png")}
    assert listed.keys() == images.keys()
    for path, data in images.items():
        assert (listed[path]["bytes"], listed[path]["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())


def test_a_scenes_figures_are_the_worst_of_its_objects(recorded):
    scene, output = recorded
    (row,) = output.rows["scenes"]
    assert row["hover_gap_mm"] == max(rest.hover_gap_mm for rest in scene.settled)
    assert row["support_margin_mm"] == min(rest.support_margin_mm for rest in scene.settled)
    assert [body["region_id"] for body in row["bodies"]] == [3, 4, 5]


def test_a_projected_view_has_no_object_columns_and_the_table_no_patch(recorded):
    _, output = recorded
    projected = next(row for row in output.rows["views"] if row["role"] == "projected")
    assert projected["object_pixels"] is projected["visible_fraction"] is projected["patch_object_fraction"] is None
    assert 0 < projected["projected_filled_share"] < 1
    assert all(row["patch_object_fraction"] is None for row in output.rows["objects"] if row["region_id"] == 2)


def test_a_failed_scene_is_one_row():
    output = failed_scene(7, "mug", SettleError("left_table", "it rolled off"), attempts=2)
    assert output.files == ()
    (row,) = table_of_rows("failures", output.rows["failures"]).to_pylist()
    assert (row["scene_id"], row["stage"], row["kind"], row["reason"]) == (7, "settle", "intrinsic", "left_table")
    assert (row["detail"], row["attempts"]) == ("it rolled off", 2)


def test_a_timing_row_sums_its_stages():
    watch = Stopwatch({"render": 0.25, "physics": 0.5}, {"dynamics": 0.125})
    (row,) = table_of_rows("timings", [timing_row(3, "mug", watch)]).to_pylist()
    assert row["total_s"] == 0.75
    assert row["effects"] == [{"name": "dynamics", "seconds": 0.125}]
