"""Our side of the benchmark makes a job's scenes."""

import pytest

from schemas.dataset.commit import Span
from schemas.errors import RunError, SceneError
from services.bench.measure import make_in_memory, run_process
from services.job.job_file import validate_job
from tests.services.bench.small_job import SMALL


def test_the_scenes_in_memory_are_those_of_the_committed_files(bench):
    bench, span = bench
    files = bench.files(span)
    made = make_in_memory(bench.context, span)
    assert [scene.plan.scene_id for scene in made] == list(span.scene_ids)
    assert bench.next_scene == span.stop
    assert all((bench.store.root / path).read_bytes() == data for path, data in files.items())


def test_where_no_scene_can_be_made_the_reason_is_given(bench, monkeypatch):
    monkeypatch.setattr("services.bench.measure.make_scene", _fail)
    with pytest.raises(RunError, match=r"none of the scenes 0 to 3 could be made: .*fell off"):
        make_in_memory(bench[0].context, bench[1])


def _fail(*_: object) -> None:
    raise SceneError("physics", "fell off")


def test_a_process_makes_every_range_of_its_span(tmp_path):
    lap = run_process(validate_job(SMALL, "test"), tmp_path, tmp_path / "out", Span(start=0, stop=3))
    assert lap.scenes == 3 and lap.cpu_s > 0
    commits = (tmp_path / "out" / "manifest" / "_commits").glob("*.json")
    assert sorted(int(path.stem) for path in commits) == [0, 2]
