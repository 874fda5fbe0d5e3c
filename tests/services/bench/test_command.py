"""`verso bench` on a small job; a small camera, because no time is asserted."""

import json
import os

import pytest

from services.cli.main import main
from tests.services.bench.small_job import SMALL

pytestmark = pytest.mark.minute


def test_bench_prints_one_object_last_and_leaves_nothing(tmp_path, capsys):
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps(SMALL))
    before = os.sched_getaffinity(0)
    folder = tmp_path / "data"
    assert main(["bench", str(job), "--scenes", "3", "--folder", str(folder), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert figures["rounds"] == 2 and figures["scenes"] == 3
    for name in ("script_plain", "script_same_look"):
        ratio = figures["others"][name]["ratio"]
        assert ratio["least"] <= ratio["median"] <= ratio["most"]
        assert {"physics", "scene", "render", "projection", "write"} <= set(figures["others"][name]["stages_ms"])
    assert {"render", "encode", "write", "commit", "physics"} <= set(figures["ours"]["stages_ms"])
    assert os.sched_getaffinity(0) == before
    assert list(folder.iterdir()) == []
