"""OUT/job.yaml: what goes in comes back, and another job or another's folder is refused."""

from pathlib import Path

import pytest
import yaml

from schemas.dataset.layout import JOB_FILE
from schemas.errors import CorruptError, OutputError
from schemas.job.job import Job
from services.job.record import JobRecord, adopt, encode_job, read_job, record_job, refuse_foreign, require_job
from workers.store.local import LocalStore


@pytest.fixture
def store(tmp_path) -> LocalStore:
    return LocalStore(tmp_path)


def record(catalogue: str = "c", **keys) -> JobRecord:
    return record_job(Job.model_validate({"name": "a", **keys}), catalogue, Path("jobs"))


def test_a_record_reads_back_as_it_was_written(store):
    assert read_job(store) is None
    written = record(scenes=5, categories=["mug"])
    store.put(JOB_FILE, encode_job(written))
    assert require_job(store) == written
    assert written.folder == str(Path("jobs").resolve())


def test_more_scenes_go_on_with_the_first_range_size_and_another_job_is_refused_by_key(store):
    store.put(JOB_FILE, encode_job(record(scenes=5, run={"range_size": 4})))
    adopted = adopt(store, record(scenes=9, run={"range_size": 64, "workers": 2}))
    assert (adopted.job.scenes, adopted.job.run.range_size, adopted.job.run.workers) == (9, 4, 2)
    with pytest.raises(OutputError, match="seed: 0 there, 3 here"):
        adopt(store, record(seed=3))
    with pytest.raises(OutputError, match="files of the asset folders"):
        adopt(store, record("other"))


def test_a_folder_that_is_no_dataset_is_refused(store, tmp_path):
    refuse_foreign(store)
    with pytest.raises(OutputError, match="holds no job"):
        require_job(store)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").touch()
    with pytest.raises(OutputError, match="photos, and no job"):
        refuse_foreign(store)


@pytest.mark.parametrize("text", ["- a list", "job: [", "digest: x"])
def test_a_damaged_record_is_told(store, text):
    store.put(JOB_FILE, text.encode())
    with pytest.raises(CorruptError, match="is not a job that `verso run` wrote"):
        require_job(store)


@pytest.mark.parametrize("folder", ["../elsewhere", "", 5, None, ["/a"], "/a\nverso: all is well", "/a\0b"])
def test_a_folder_that_is_no_absolute_path_is_refused(store, folder):
    tree = yaml.safe_load(encode_job(record()))
    store.put(JOB_FILE, yaml.safe_dump(tree | {"folder": folder}).encode())
    with pytest.raises(CorruptError, match="is not a job that `verso run` wrote"):
        require_job(store)


def test_captures_whose_files_changed_are_named_by_their_folders(store):
    captures = {"source": "folders", "folders": ["shots/mug", "shots/box"]}
    job = Job.model_validate({"name": "a", "captures": captures})
    before = record_job(job, "c", Path("jobs"), ("1" * 64, "2" * 64))
    store.put(JOB_FILE, encode_job(before))
    assert require_job(store) == before
    assert adopt(store, before).inputs == before.inputs
    with pytest.raises(OutputError, match="captures in shots/box ") as caught:
        adopt(store, record_job(job, "d", Path("jobs"), ("1" * 64, "3" * 64)))
    assert "shots/mug" not in str(caught.value)


def test_a_record_without_captures_is_written_as_before_there_were_any():
    tree = yaml.safe_load(encode_job(record()))
    assert list(tree) == ["digest", "catalogue", "folder", "job", "seal"]
    assert "captures" not in tree["job"]
