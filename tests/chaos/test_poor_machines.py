"""Machines with little of everything: the run works, or says in one line what is missing."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.chaos.test_lost_processes import JOB

ROOT = Path(__file__).resolve().parents[2]

WALL_CLOCK = re.compile(
    r"time\.time\b|datetime|gmtime|localtime|st_[mc]time|CLOCK_REALTIME|last_modified|\.modified_s\b"
)

MAY_READ_IT = {
    "services/cli/queue_commands.py": "when a job was submitted: the order of jobs of one priority, where any order is right",
    "services/queue/listing.py": "the age of a job, to be shown",
    "services/queue/queue.py": "the time of an event, to be shown",
    "services/read/status.py": "the rate of the latest commits, to be shown",
    "services/look/live.py": "when a range was committed, to be shown",
    "services/run/progress.py": "the time of an event, to be logged, and when a run began, to be shown",
    "workers/assets/library/collection.py": "whether a source changed: where times differ, its bytes are read",
    "workers/assets/library/reading.py": "the same, written beside a file's digest",
    "workers/assets/library/making.py": "the same, for the list of a folder's files",
    "workers/store/local.py": "when a file was written, for the rate",
    "workers/store/objects.py": "when an object was put, for the rate",
}
"""No work is lost or done twice by these, so a clock may be set while a run goes on."""


def run(tmp_path: Path, prepare: str, *arguments: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    """`verso run` in a mount namespace of its own, after the shell commands `prepare`."""
    (tmp_path / "small.yaml").write_text(json.dumps(JOB | {"scenes": 4}))
    command = f"{prepare} && exec {sys.executable} -m services.cli.main run small.yaml --out out {' '.join(arguments)}"
    changed = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run(
        ["unshare", "-m", "sh", "-c", command],
        cwd=tmp_path,
        env={name: value for name, value in changed.items() if value is not None},
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )


@pytest.mark.ray
@pytest.mark.root
def test_64_open_files_no_home_and_1_mb_of_shared_memory_are_enough(tmp_path):
    done = run(
        tmp_path, "ulimit -n 64 && mount -t tmpfs -o size=1m none /dev/shm", "--workers", "1", "--json", HOME=None
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["scenes"] == {"made": 4, "intrinsic": 0, "environmental": 0}


def test_nothing_is_decided_by_a_wall_clock_that_may_be_set_back():
    reading = set()
    for package in ("schemas", "services", "workers"):
        for path in (ROOT / package).rglob("*.py"):
            if WALL_CLOCK.search(path.read_text()):
                reading.add(str(path.relative_to(ROOT)))
    assert reading == set(MAY_READ_IT)
    assert all(MAY_READ_IT.values())
