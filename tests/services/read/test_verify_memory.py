"""Verifying takes as much memory for many ranges as for few."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from services.merge.step import merge
from tests.made_up_datasets import dataset_at
from tests.made_up_scenes import small_scene

pytestmark = pytest.mark.usefixtures("unflushed")

VERIFY = """
import json, resource, sys
from services.merge import shared, tables
from services.read import path_index, verdict
from services.read.verify import verify
from workers.store.local import LocalStore
path_index.CACHE_KIB = shared.CACHE_KIB = int(sys.argv[2])
tables.ROWS_PER_GROUP = int(sys.argv[3])
found = verify(LocalStore(sys.argv[1]), lambda now: None)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({"faults": found.faults[:3], "scenes": found.scenes, "files": found.files, "peak_mib": peak / 1024}))
"""


def measure(folder: Path, scenes: int, cache_kib: int = 16 << 10, rows: int = 8_192) -> dict:
    """What verifying a finished dataset took: ranges of four scenes, 16 images, 6 tables and 3 shapes."""
    store = dataset_at(folder, first=0, stop=scenes, make=small_scene)
    merge(store, 0, scenes)
    command = [sys.executable, "-c", VERIFY, str(folder), str(cache_kib), str(rows)]
    figures = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    # There is no job.yaml, so labels are not derived; all else is.
    assert [fault.partition(":")[0] for fault in figures["faults"]] == [
        "job.yaml",
        "manifest/_fingerprint.json",
        "DATASET.md",
    ]
    assert figures["scenes"] == scenes
    return figures


def test_ten_times_the_ranges_take_little_more_memory(tmp_path):
    few, many = (measure(tmp_path / str(scenes), scenes, 512, 64) for scenes in (24, 200))
    assert many["files"] > 6 * few["files"]
    assert many["peak_mib"] - few["peak_mib"] < 12


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_ten_thousand_ranges_take_little_more_memory_than_a_thousand(tmp_path, record_figure):
    few, many = (measure(tmp_path / str(scenes), scenes) for scenes in (4_000, 40_000))
    record_figure("verify_peak_mib[1000 ranges]", "passed", few["peak_mib"], 1024.0)
    record_figure("verify_peak_mib[10000 ranges]", "passed", many["peak_mib"], 1024.0)
    assert many["peak_mib"] - few["peak_mib"] < 64
    assert many["peak_mib"] < 1024
