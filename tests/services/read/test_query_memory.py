"""A large answer takes as much memory as a small one."""

import json
import subprocess
import sys

import pytest

ASK = """
import json, os, sys
from tests.kit.memory import peak_mib
from services.read.query import ask
from services.read.query import write_rows
from workers.store.local import LocalStore
peaks = []
for times in map(int, sys.argv[4:]):
    sql = f"select {sys.argv[3]} from views v, range({times})"
    with ask(LocalStore(sys.argv[1]), sql) as rows, open(os.devnull, "wb") as sink:
        write_rows(rows, sys.argv[2], sink)
    peaks.append(peak_mib())
print(json.dumps(peaks))
"""


@pytest.mark.minute
@pytest.mark.parametrize(
    ("style", "columns", "times"),
    [("csv", "v.pose_id, v.T_world_cam", ("800", "8000")), ("parquet", "v.*", ("2000", "20000"))],
)
def test_ten_times_the_rows_take_no_more_memory(tiny, style, columns, times, record_figure):
    """As a whole the rows take more than 48 MiB; that of the first answer is what row groups and buffers need."""
    command = [sys.executable, "-c", ASK, tiny.name, style, columns, *times]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    few, many = json.loads(done.stdout)
    record_figure(f"query_growth_mib[{style}]", "passed", many - few, 48.0)
    assert many - few < 48.0
