"""The rounds of a benchmark: where they write."""

import pytest

from schemas.errors import OutputError
from services.bench.measure import bench_folder


def test_a_folder_that_cannot_be_made_is_told_of(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="choose another --folder"), bench_folder(tmp_path / "file"):
        pass
