"""Extensions that are refused before their first new commit leave a finished dataset as it was; those that begin reopen it."""

import contextlib
import json
import shutil
from pathlib import Path

import pytest

from schemas.dataset.commit import Span
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE, SUCCESS_FILE
from schemas.dataset.shard import ShardOrder
from schemas.errors import FingerprintError, MachineError
from services.job.job_file import validate_job
from services.job.record import record_job, require_job
from services.run.run_job import RunRequest, order_pattern, run_job
from tests.datasets import SMALL, make_dataset
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.render.raster.gbuffer import shared_renderer
from workers.shard import run_shard as module
from workers.shard.run_shard import run_shard
from workers.store.ledger import list_commits
from workers.store.local import LocalStage, LocalStore

KEPT = (JOB_FILE, SUCCESS_FILE, FINGERPRINT_FILE, "DATASET.md", "camPoses.csv")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("finished") / "out")[0]


@pytest.fixture
def finished(made, tmp_path):
    """A finished dataset of two scenes."""
    shutil.copytree(made.root, tmp_path / "out")
    return LocalStore(tmp_path / "out")


def kept(store: LocalStore) -> dict[str, bytes]:
    return {key: store.read(key) for key in KEPT if store.size(key) is not None}


def larger(store: LocalStore, scenes: int = 3, **run) -> RunRequest:
    return RunRequest(validate_job({**SMALL, "scenes": scenes, "run": run}, "test"), Path(), str(store.root))


def order_of(store: LocalStore, scenes: int = 3, **run) -> tuple[ShardOrder, Catalogue]:
    """The order of the third scene as the coordinator gives it, and the catalogue."""
    request = larger(store, scenes, **run)
    catalogue = open_catalogue(request.job.assets, Path(), tuple(request.job.categories))
    record = record_job(request.job, catalogue.digest, Path())
    pattern = order_pattern(store, record, list_commits(store))
    return pattern.model_copy(update={"spans": (Span(start=2, stop=3),)}), catalogue


def test_where_ray_does_not_start_or_the_first_scene_cannot_be_written_it_stays_finished(finished, monkeypatch):
    @contextlib.contextmanager
    def no_ray():
        raise MachineError("Ray did not start")
        yield

    def full(*args):
        raise MachineError("the disk is full")

    before = kept(finished)
    with pytest.raises(MachineError, match="Ray did not start"):
        run_job(larger(finished), no_ray())
    assert kept(finished) == before
    assert require_job(finished).job.scenes == 2
    monkeypatch.setattr(LocalStage, "flush", full)
    with pytest.raises(MachineError, match="the disk is full"):
        run_shard(*order_of(finished))
    assert kept(finished) == before


def test_the_first_new_commit_reopens_it_and_writes_the_larger_job(finished, monkeypatch):
    seen = []
    whole = LocalStage.put_if_absent

    def put(stage, key, data):
        seen.append((key, finished.size(SUCCESS_FILE), require_job(finished).job.scenes))
        return whole(stage, key, data)

    monkeypatch.setattr(LocalStage, "put_if_absent", put)
    run_shard(*order_of(finished))
    assert seen == [("manifest/_commits/0000000002.json", None, 3)]


def test_an_older_order_does_not_make_a_later_job_smaller(finished):
    older = order_of(finished)
    finished.put(JOB_FILE, order_of(finished, scenes=5)[0].job_change.after.encode())
    run_shard(*older)
    assert require_job(finished).job.scenes == 5


def test_another_stack_is_refused_by_what_the_commits_say_and_a_mix_of_them_ends_a_strict_job(finished, monkeypatch):
    mine = module._fingerprint(shared_renderer(), "raster")
    whole = json.loads(finished.read(FINGERPRINT_FILE))
    for damaged in (None, b"{", b"[]"):  # of the file: the same stack writes it again
        finished.remove(FINGERPRINT_FILE)
        if damaged is not None:
            finished.put(FINGERPRINT_FILE, damaged)
        module._join_stack(finished, mine, order_of(finished)[0])
        assert json.loads(finished.read(FINGERPRINT_FILE)) == whole
    other = mine.model_copy(update={"simd": "other"})
    monkeypatch.setattr(module, "_fingerprint", lambda renderer, tier: other)
    for file in (None, other.model_dump_json().encode()):
        finished.remove(FINGERPRINT_FILE)
        if file is not None:
            finished.put(FINGERPRINT_FILE, file)
        before = kept(finished)
        with pytest.raises(FingerprintError, match=f"the dataset's is {mine.digest[:12]}"):
            run_shard(*order_of(finished))
        assert kept(finished) == before
    run_shard(*order_of(finished, fingerprint="record"))
    with pytest.raises(FingerprintError, match=r"made by 2 stacks .* set it to record to go on"):
        order_of(finished)
