"""The rounds of a benchmark: where they write, and a side that cannot run."""

from contextlib import ExitStack

import pytest

from schemas.errors import MachineError, OutputError
from services.bench.measure import bench_folder, start_others
from services.bench.others import SIDES, Side


def test_a_folder_that_cannot_be_made_is_told_of(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="choose another --folder"), bench_folder(tmp_path / "file"):
        pass


def test_an_optional_side_that_cannot_run_is_left_out_and_any_other_ends_the_benchmark(given, tmp_path):
    broken = Side("broken", "Broken", "nothing", "services.bench.no_such_module", package="broken")
    with ExitStack() as running:
        others = start_others([SIDES[0], broken], given[:1], tmp_path, running)
        assert others.sides == [SIDES[0]]
        assert "no_such_module" in others.left_out["Broken"]
        assert others.startup_s["script_plain"] > 0.0
    needed = Side("broken", "Broken", "nothing", "services.bench.no_such_module")
    with ExitStack() as running, pytest.raises(MachineError, match="no_such_module"):
        start_others([needed], given[:1], tmp_path, running)
