"""The journal: what is measured outlives the process, and no study goes on with another's figures."""

import pytest

from schemas.errors import OutputError
from services.study.study import JOURNAL_FILE, Journal

HEADER = {"job": "abc", "sizes": {"scenes": 4}}


def test_what_was_added_is_there_when_it_is_opened_again(tmp_path):
    with Journal(tmp_path / "study", HEADER) as first:
        first.add("time/0/3", {"whole": {"the job": 0.1 + 0.2}})
    with Journal(tmp_path / "study", HEADER) as second:
        assert "time/0/3" in second and "time/0/4" not in second
        assert second["time/0/3"] == {"whole": {"the job": 0.1 + 0.2}}


def test_a_line_that_was_cut_off_is_measured_again(tmp_path):
    with Journal(tmp_path, HEADER) as journal:
        journal.add("a", 1)
        journal.add("b", 2)
    file = tmp_path / JOURNAL_FILE
    file.write_text(file.read_text()[:-5])
    with Journal(tmp_path, HEADER) as again:
        assert "a" in again and "b" not in again
        again.add("b", 3)
    with Journal(tmp_path, HEADER) as last:
        assert last["b"] == 3


def test_another_study_is_refused_by_what_differs_and_stays_as_it_is(tmp_path):
    with Journal(tmp_path, HEADER) as journal:
        journal.add("a", 1)
    before = (tmp_path / JOURNAL_FILE).read_bytes()
    with pytest.raises(OutputError, match=r"another study \(other sizes\): choose another --out"):
        Journal(tmp_path, {**HEADER, "sizes": {"scenes": 8}})
    assert (tmp_path / JOURNAL_FILE).read_bytes() == before


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="choose another --out"):
        Journal(tmp_path / "file" / "study", HEADER)
