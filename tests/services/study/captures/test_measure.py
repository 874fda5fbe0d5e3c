"""A small simulated capture, processed with two settings."""

from pathlib import Path

import pytest

from schemas.capture import CaptureScore
from schemas.job.job import Job
from services.study.command import errors_of, fewer_views, measure_capture
from services.study.model import Setting
from workers.assets.catalogue import open_catalogue
from workers.capture.folder import open_folder
from workers.capture.make_capture import simulate_one
from workers.scene.context import open_worker

pytestmark = pytest.mark.minute

JOB = {
    "name": "t",
    "scenes": 2,
    "categories": ["mug"],
    "captures": {
        "simulate": {"views": 8, "image_scale": 0.35},
        "estimation": {"compare": False},
        "fusion": {"voxel_m": 0.003},
    },
}


@pytest.fixture(scope="module")
def worker():
    job = Job.model_validate(JOB)
    return open_worker(job, open_catalogue(job.assets, Path(), tuple(job.categories)))


def test_a_setting_has_its_time_its_bytes_and_its_errors_or_a_reason(worker, tmp_path):
    simulate_one(worker, 0, tmp_path / "capture")
    coarse = Setting((("voxel", "0.008"),), {"captures.fusion.voxel_m": 0.008})
    hopeless = Setting((("views", "1"),), {"captures.simulate.views": 1})
    answer = measure_capture(worker, (Setting(), coarse, hopeless), tmp_path / "capture", (0, 0))
    own = Setting().name
    assert set(answer["whole"]) == {own, coarse.name} and all(s > 0 for s in answer["whole"].values())
    assert answer["bytes"][coarse.name] < answer["bytes"][own] / 3
    assert answer["errors"][own]["cloud_mm"] < answer["errors"][coarse.name]["cloud_mm"]
    assert "views" in answer["failed"][hopeless.name]


def test_fewer_views_are_spread_over_the_path(worker, tmp_path):
    simulate_one(worker, 1, tmp_path / "capture")
    folder = open_folder(tmp_path / "capture")
    assert fewer_views(folder, 3).numbers == (0, 4, 7) and fewer_views(folder, 99).numbers == folder.numbers


def test_what_was_not_scored_is_left_out():
    assert errors_of(CaptureScore(pose_mm=0.5, completeness=0.98)) == {
        "camera_mm": 0.5,
        "missing_share": pytest.approx(0.02),
    }
