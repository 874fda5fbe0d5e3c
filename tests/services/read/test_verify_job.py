"""job.yaml and the fingerprint are compared with what every commit says."""

import dataclasses

import pytest

from schemas.dataset.shard import Fingerprint
from services.job.record import encode_job, require_job
from services.read.verify import encode_fingerprint
from tests.datasets import faults_of
from workers.store.local import LocalStore


def rewrite(out, **changes) -> list[str]:
    """The faults after the job was changed, and sealed as if a run had written it."""
    store = LocalStore(out)
    record = require_job(store)
    job = record.job.model_copy(update=changes)
    store.put("job.yaml", encode_job(dataclasses.replace(record, job=job)))
    return faults_of(store)


@pytest.mark.parametrize("changes", [{"seed": 12}, {"name": "other"}, {"categories": {"box": 1.0}}])
def test_a_job_with_other_keys_than_its_commits_is_told_even_where_it_is_sealed(copy, changes):
    told = "\n".join(rewrite(copy, **changes))
    assert "job.yaml: its digest is not that of its keys" in told
    assert "job.yaml: its keys or asset files" in told and "are not those of manifest/_commits/0000000000.json" in told


def test_fewer_and_more_scenes_than_committed_are_told(copy):
    assert any("scenes 2 to 2 are committed, outside of those asked" in fault for fault in rewrite(copy, scenes=2))
    assert any("scenes 3 to 3 are not committed" in fault for fault in rewrite(copy, scenes=4))


def test_another_range_size_than_the_commits_have_is_told(copy):
    run = require_job(LocalStore(copy)).job.run.model_copy(update={"range_size": 4})
    assert any("run.range_size is 4, that of the commits 1" in fault for fault in rewrite(copy, run=run))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("workers: null", "workers: 7"),
        ("# The job", "# The joy"),
        ("folder: /", "folder: /x/"),
        ("seed: 11\n", "seed:  11\n"),
    ],
)
def test_even_what_changes_no_image_is_told(copy, before, after):
    path = copy / "job.yaml"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))
    assert faults_of(LocalStore(copy)) == [
        f"job.yaml: was altered after a run wrote it: its seal does not match: `verso replay {copy} --repair` puts it back, "
        "or restore it from a copy"
    ]


def test_a_fingerprint_that_is_not_the_commits_is_told(copy):
    path = copy / "manifest/_fingerprint.json"
    stored = Fingerprint.model_validate_json(path.read_bytes())
    assert path.read_bytes() == encode_fingerprint(stored)
    path.write_bytes(encode_fingerprint(stored.model_copy(update={"simd": "other"})))
    assert "which no commit has" in faults_of(LocalStore(copy))[0]
    path.write_text(path.read_text() + "\n")
    assert "was altered" in faults_of(LocalStore(copy))[0]
    path.unlink()
    assert "manifest/_fingerprint.json: is missing" in faults_of(LocalStore(copy))[0]
