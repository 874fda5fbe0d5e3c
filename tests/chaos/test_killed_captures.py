"""A run of virtual captures whose every process is killed: it goes on, and makes what one process makes without a kill."""

import json
import os
import signal
import time
from pathlib import Path

import pytest
import yaml

from services.job.job_file import load_job
from tests.chaos.test_random_kills import digest_of, running
from tests.datasets import faults_of, run_here
from tests.kit.killed_runs import processes_with

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(900)]

JOB = {
    "name": "captures",
    "seed": 3,
    "scenes": 4,
    "categories": ["box", "mug"],
    "assets": {"objects": [{"source": "procedural", "size": "metric"}]},
    "captures": {"most_views": 8, "simulate": {"views": 5, "image_scale": 0.25, "depth_noise": {}}},
}


def test_a_killed_job_of_captures_goes_on_and_has_the_digest_of_one_process(tmp_path):
    job = tmp_path / "job.yaml"
    job.write_text(yaml.safe_dump(JOB))
    out = tmp_path / "out"
    with running(job, out) as run:
        deadline = time.monotonic() + 300
        while not list(Path(out).glob("manifest/_commits/*.json")):
            assert run.wait(0.1) is None
            assert time.monotonic() < deadline
        for process in processes_with(run.mark):
            os.kill(process.pid, signal.SIGKILL)
    committed = len(list(out.glob("manifest/_commits/*.json")))
    assert 0 < committed < 4
    assert digest_of(out) is None
    with running(job, out) as run:
        assert run.wait(280) == 0
    store, alone = run_here(load_job(job), tmp_path / "alone")
    assert digest_of(out) == alone
    assert faults_of(store) == []
    assert json.loads((out / "_SUCCESS").read_text())["scenes"]["made"] == 4
