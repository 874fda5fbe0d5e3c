"""Files made again: the cheapest way first, and only those that come out as the commit says."""

import pytest

from services.job.record import require_job
from services.read import replay as remake
from services.read.replay import Maker
from workers.store.commit import committed_files, read_record


@pytest.fixture
def made(monkeypatch) -> list[int]:
    """The scenes that are made again."""
    scenes: list[int] = []
    original = remake.run_scene

    def counted(context, scene_id, total):
        scenes.append(scene_id)
        return original(context, scene_id, total)

    monkeypatch.setattr(remake, "run_scene", counted)
    return scenes


@pytest.mark.parametrize("layout", ["tiny", "packed"])
def test_every_file_of_a_range_is_made_again(layout, request, made):
    store = request.getfixturevalue(layout)
    record = read_record(store, 1)
    lost = committed_files(store, record)
    found = dict(Maker(store, require_job(store)).make_files(record, lost))
    assert found == {entry.path: store.read(entry.path) for entry in lost}
    assert made == [1]


def test_measured_times_are_put_back_without_making_a_scene(tiny, made):
    record = read_record(tiny, 2)
    lost = [entry for entry in record.files if entry.path.endswith(("timings.parquet", "failures.parquet"))]
    assert [path for path, _ in Maker(tiny, require_job(tiny)).make_files(record, lost)] == [one.path for one in lost][
        ::-1
    ]
    assert made == []


def test_nothing_is_given_back_where_the_commit_says_otherwise(tiny):
    record = read_record(tiny, 0)
    lost = [entry.model_copy(update={"sha256": "0" * 64}) for entry in committed_files(tiny, record)]
    assert list(Maker(tiny, require_job(tiny)).make_files(record, lost)) == []
