"""Verifying takes as much memory for many ranges as for few."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.kit import many_ranges

VERIFY = """
import json, sys
from pathlib import Path
from services.read.verify import verify
from workers.store.local import LocalStore
found = verify(LocalStore(sys.argv[1]), lambda now: None)
(peak,) = [line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
parts = dict(found.parts)
print(json.dumps({"parts": parts, "scenes": found.scenes, "files": found.files, "peak_mib": int(peak) / 1024}))
"""


def measure(folder: Path, ranges: int) -> dict:
    """What verifying took: ranges of one scene, six tables and a damaged tar, all merged again; no job.yaml, so no labels."""
    many_ranges.write_ranges(folder, ranges)
    command = [sys.executable, "-c", VERIFY, str(folder)]
    figures = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert figures["scenes"] == ranges
    assert figures["parts"] == {"job": 2, "file": ranges - (ranges + 499) // 1000, "merge": 1}
    return figures


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_ten_thousand_ranges_take_little_more_memory_than_a_thousand(tmp_path, record_figure):
    few, many = (measure(tmp_path / str(ranges), ranges) for ranges in (1_000, 10_000))
    record_figure("verify_peak_mib[1000 ranges]", "passed", few["peak_mib"], 1024.0)
    record_figure("verify_peak_mib[10000 ranges]", "passed", many["peak_mib"], 1024.0)
    assert many["peak_mib"] - few["peak_mib"] < 128
    assert many["peak_mib"] < 1024
