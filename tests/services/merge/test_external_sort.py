import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.merge import external_sort
from services.merge.external_sort import ExternalSort

PAIRS = st.lists(st.tuples(st.binary(max_size=4), st.binary(max_size=4)), max_size=60)


@given(PAIRS, st.integers(1, 2000))
def test_pairs_come_back_sorted_with_duplicates_however_little_memory_there_is(tmp_path_factory, pairs, limit):
    ordered = ExternalSort(tmp_path_factory.mktemp("runs"), "x", limit)
    for pair in pairs:
        ordered.add(*pair)
    assert list(ordered) == sorted(pairs)
    assert list(ordered) == sorted(pairs)


def test_runs_are_merged_before_there_are_too_many_files(tmp_path, monkeypatch):
    monkeypatch.setattr(external_sort, "_MOST_RUNS", 4)
    ordered = ExternalSort(tmp_path, "x", 1)
    for number in range(40):
        ordered.add(bytes([40 - number]), b"")
        assert len(list(tmp_path.iterdir())) < 5
    assert [key[0] for key, _ in ordered] == list(range(1, 41))


def test_a_run_that_is_cut_short_is_not_read_as_the_end(tmp_path):
    ordered = ExternalSort(tmp_path, "x", 1)
    ordered.add(b"key", b"value")
    (run,) = tmp_path.iterdir()
    run.write_bytes(run.read_bytes()[:-1])
    with pytest.raises(EOFError, match="cut short"):
        list(ordered)
