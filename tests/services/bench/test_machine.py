"""The description of the machine, and pinning to one core."""

import os

import pytest

from services.bench.figures import pinned, process_age_s, threads_per_core


def test_cores_are_given_back_also_after_an_error():
    before = os.sched_getaffinity(0)

    def fail() -> None:
        with pinned() as core:
            assert os.sched_getaffinity(0) == {core}
            raise KeyError(core)

    with pytest.raises(KeyError):
        fail()
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize(("siblings", "threads"), [("0", 1), ("0-1", 2), ("0,64", 2), ("0-1,8-9", 4)])
def test_threads_of_a_core_are_counted(tmp_path, siblings, threads):
    (tmp_path / "siblings").write_text(siblings + "\n")
    assert threads_per_core(tmp_path / "siblings") == threads
    assert threads_per_core(tmp_path / "nothing") is None


def test_this_process_gets_older():
    before = process_age_s()
    assert 0.0 < before <= process_age_s()
