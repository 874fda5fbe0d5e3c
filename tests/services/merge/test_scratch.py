import contextlib

import pytest

from schemas.errors import MachineError
from services.merge.shared import explain_full_disk, open_scratch


def test_a_full_table_is_explained(tmp_path):
    with contextlib.closing(open_scratch(tmp_path / "a.sqlite", "CREATE TABLE rows (text TEXT)")) as table:
        table.execute("PRAGMA max_page_count = 4")
        with pytest.raises(MachineError, match=r"the merge could not write its files: .* full"), explain_full_disk():
            table.executemany("INSERT INTO rows VALUES (?)", ((f"{i:0100d}",) for i in range(1000)))


def test_a_folder_that_is_gone_is_explained(tmp_path):
    with pytest.raises(MachineError, match="unable to open"), explain_full_disk():
        open_scratch(tmp_path / "none" / "a.sqlite", "CREATE TABLE rows (text TEXT)")
