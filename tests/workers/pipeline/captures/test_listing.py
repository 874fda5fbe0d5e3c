from pathlib import Path

import pytest

from schemas.errors import AssetSourceError
from schemas.job.job import Job
from workers.assets.catalogue import open_catalogue
from workers.capture.results import open_sources


def job_of(*folders: str) -> Job:
    return Job.model_validate({"name": "t", "captures": {"source": "folders", "folders": list(folders)}})


@pytest.fixture
def shots(tmp_path) -> Path:
    for name in ("mug", "box"):
        (tmp_path / "shots" / name).mkdir(parents=True)
        (tmp_path / "shots" / name / "rgb_00000.png").write_text(name)
    return tmp_path


def test_folders_are_relative_to_the_job_file_and_their_files_decide_the_digest(shots, tmp_path):
    job = job_of("shots/mug", "shots/box")
    before = open_sources(job, shots)
    assert [listing.folder.name for listing in before.captures] == ["mug", "box"]
    (shots / "shots").rename(shots / "moved")
    moved = open_sources(job_of("moved/mug", "moved/box"), shots)
    assert moved.digest == before.digest
    (shots / "moved/box/rgb_00000.png").write_text("other")
    changed = open_sources(job_of("moved/mug", "moved/box"), shots)
    assert changed.digest != before.digest
    assert changed.captures[0].sha256 == before.captures[0].sha256
    assert open_sources(job_of("moved/box", "moved/mug"), shots).digest != changed.digest


def test_a_folder_that_is_not_there_is_refused_by_its_key(shots):
    with pytest.raises(AssetSourceError, match=r"captures\.folders\.1: .*nowhere is no folder") as caught:
        open_sources(job_of("shots/mug", "nowhere"), shots)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("keys", [{}, {"captures": {}}])
def test_a_job_without_folders_has_the_digest_of_its_shapes_alone(keys):
    job = Job.model_validate({"name": "t", **keys})
    assert open_sources(job, Path()).digest == open_catalogue(job.assets, Path(), tuple(job.categories)).digest
