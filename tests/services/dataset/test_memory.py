"""Streaming pairs takes as much memory for many ranges as for few."""

import json
import subprocess
import sys

import pytest

STREAM = """
import json, sys
from tests.kit.memory import peak_mib
from pathlib import Path
from services.dataset.dataset import Dataset
from services.job.job_file import validate_job
from services.job.record import encode_job, record_job
from tests.datasets import SMALL
from tests.kit.many_ranges import ManyRanges

def stream(root, ranges):
    store = ManyRanges(root, ranges)
    store.prepare()
    store.put("job.yaml", encode_job(record_job(validate_job(SMALL, "test"), "c" * 64, root)))
    pairs = sum(1 for pair in Dataset(store).pairs() if pair.mirror.images)
    return pairs, peak_mib()

few = stream(Path(sys.argv[1]) / "few", 100)
many = stream(Path(sys.argv[1]) / "many", 500)
print(json.dumps([few, many]))
"""


@pytest.mark.minute
def test_five_times_the_pairs_take_no_more_memory(tmp_path, record_figure):
    done = subprocess.run([sys.executable, "-c", STREAM, str(tmp_path)], capture_output=True, text=True, check=True)
    (few, before), (many, after) = json.loads(done.stdout)
    assert many > 4 * few > 300
    record_figure("stream_pairs_growth_mib", "passed", after - before, 8.0)
    assert after - before < 8.0
