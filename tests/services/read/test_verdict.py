from services.read import verdict
from services.read.verdict import COPY, Verdict, describe_os_error, printable


def test_a_fault_is_one_line_that_every_terminal_prints():
    found = Verdict("data/a")
    found.tell("two\nlines\udcff: is in no commit", COPY)
    assert found.faults == ["two\\nlines\\udcff: is in no commit: restore it from a copy"]
    assert found.faults[0].encode("ascii")
    assert printable("żółty kubek") == "żółty kubek"


def test_more_faults_than_anybody_reads_are_counted(monkeypatch):
    monkeypatch.setattr(verdict, "MOST_FAULTS", 3)
    found = Verdict()
    for number in range(5):
        found.tell(str(number), COPY, "file")
    found.tell("_SUCCESS: is missing", COPY, "merge")
    assert (len(found.faults), found.untold) == (4, 2)
    assert found.faults[-1].startswith("_SUCCESS")


def test_why_a_file_cannot_be_read_is_told_in_words():
    assert describe_os_error(IsADirectoryError(21, "x")) == "is a folder, where a file should be"
    assert describe_os_error(NotADirectoryError(20, "x")) == "is missing"
    assert describe_os_error(OSError(5, "Input/output error")) == "cannot be read (Input/output error)"
