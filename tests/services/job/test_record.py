"""OUT/job.yaml: what goes in comes back, and another job or another's folder is refused."""

import re
from pathlib import Path

import pytest
import yaml

from schemas.dataset.layout import JOB_FILE
from schemas.errors import CorruptError, OutputError
from schemas.job.job import PATHS, Job
from services.job.record import JobRecord, encode_job, is_job_sealed, read_job, record_job, refuse_foreign, require_job
from workers.store.local import LocalStore

CAPTURES = {"folders": ["shots/mug", "shots/box"]}


@pytest.fixture
def store(tmp_path) -> LocalStore:
    return LocalStore(tmp_path)


def record(catalogue: str = "c", inputs: tuple[str, ...] = (), out: LocalStore | None = None, **keys) -> JobRecord:
    return record_job(Job.model_validate({"name": "a", **keys}), catalogue, Path("jobs"), inputs, out)


def test_a_record_reads_back_as_it_was_written(store):
    assert read_job(store) is None
    for written in (record(scenes=5, categories=["mug"]), record(inputs=("1" * 64, "2" * 64), captures=CAPTURES)):
        store.put(JOB_FILE, encode_job(written))
        assert require_job(store) == written
        assert is_job_sealed(store.read(JOB_FILE)) and not is_job_sealed(store.read(JOB_FILE)[1:])
    assert written.folder == str(Path("jobs").resolve())
    store.put(JOB_FILE, encode_job(record(preset="exact")))
    kept = require_job(store)  # what a preset sets later is no key of a dataset that was made before
    assert (kept.job.preset, kept.job.physics.step_hz, kept.digest) == ("balanced", 1920, record(preset="exact").digest)
    assert record(preset="exact", scenes=70, out=store).digest == kept.digest
    assert list(yaml.safe_load(encode_job(record()))) == ["digest", "catalogue", "folder", "job", "seal"]


def test_more_scenes_go_on_with_the_first_range_size_and_another_job_is_refused_by_key(store):
    store.put(JOB_FILE, encode_job(record(scenes=5, run={"range_size": 4})))
    adopted = record(scenes=9, run={"range_size": 64, "workers": 2}, out=store)
    assert (adopted.job.scenes, adopted.job.run.range_size, adopted.job.run.workers) == (9, 4, 2)
    assert adopted.digest == record(scenes=9).digest
    with pytest.raises(OutputError, match="seed: 0 there, 3 here"):
        record(seed=3, out=store)
    with pytest.raises(OutputError, match="  the built-in shapes of this version "):
        record("other", out=store)


def test_whatever_files_a_job_names_are_named_where_some_have_changed(store):
    keys = {
        "assets": {"objects": [{"source": "library", "folder": "x"}], "tables": [{"source": "library", "folder": "x"}]},
        "cameras": {"more": [{"name": "a", "poses": "x"}]},
        "look": {name: {"folder": "x"} for name in ("floor", "table", "environment")} | {"background": "x"},
        "scenes_from": "x",
    }
    store.put(JOB_FILE, encode_job(record(**keys)))
    with pytest.raises(OutputError) as caught:
        record("other", out=store, **keys)
    named = {re.sub(r"\.\d+", "", key) for key in re.findall(r"the files that (\S+) names", str(caught.value))}
    assert named == PATHS - {"captures.folders"}


def test_captures_whose_files_changed_are_named_by_their_folders(store):
    store.put(JOB_FILE, encode_job(record(inputs=("1" * 64, "2" * 64), captures=CAPTURES)))
    assert record(inputs=("1" * 64, "2" * 64), captures=CAPTURES, out=store).inputs == ("1" * 64, "2" * 64)
    with pytest.raises(OutputError, match="captures in shots/box ") as caught:
        record("d", ("1" * 64, "3" * 64), store, captures=CAPTURES)
    assert "shots/mug" not in str(caught.value)


def test_a_folder_that_is_no_dataset_is_refused_unless_a_run_or_a_file_system_left_what_it_holds(store, tmp_path):
    store.prepare()
    (tmp_path / "lost+found").mkdir()
    (tmp_path / "_lock.json").write_text("{}")
    refuse_foreign(store)
    with pytest.raises(OutputError, match=r"holds no job.yaml: a run is just beginning there"):
        require_job(store)
    store.remove("_lock.json")
    with pytest.raises(OutputError, match=r"holds no job.yaml: it is not an output folder"):
        require_job(store)
    (tmp_path / "photos").mkdir()
    with pytest.raises(OutputError, match="photos, and no job"):
        refuse_foreign(store)


def test_a_damaged_record_is_told(store):
    folders = ("../elsewhere", "", 5, None, ["/a"], "/a\nverso: all is well", "/a\0b")
    tree = yaml.safe_load(encode_job(record()))
    for text in ("- a list", "job: [", "digest: x", *(yaml.safe_dump(tree | {"folder": folder}) for folder in folders)):
        store.put(JOB_FILE, text.encode())
        with pytest.raises(CorruptError, match="is not a job that `verso run` wrote"):
            require_job(store)
