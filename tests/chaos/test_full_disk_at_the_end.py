"""A disk that is full while a finished dataset is merged: one line, nothing lost, and the same dataset afterwards."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

FILL = """
import contextlib, io, json, os, sys, traceback
from pathlib import Path
from services.cli.main import main
from tests.datasets import make_dataset
import yaml

out, ballast = Path("small/out"), Path("small/ballast")
digest = make_dataset(out)[1]
Path("small.yaml").write_text(yaml.safe_dump(yaml.safe_load((out / "job.yaml").read_text())["job"]))
found = []
for kilobytes in (0, 4, 8, 16, 24, 32, 48, 64, 96, 128, 256, 1024):
    (out / "_SUCCESS").unlink(missing_ok=True)
    with contextlib.suppress(OSError), open(ballast, "wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    left = os.statvfs("small").f_bavail * 4096
    os.truncate(ballast, max(0, ballast.stat().st_size + left - kilobytes * 1024))
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main(["run", "small.yaml", "--out", str(out)])
        except BaseException:
            code = traceback.format_exc()
    ballast.unlink()
    found.append([kilobytes, code, told.getvalue()])
with contextlib.redirect_stdout(io.StringIO()):
    code = main(["run", "small.yaml", "--out", str(out)])
success = json.loads((out / "_SUCCESS").read_text())
print(json.dumps([found, code, success["digest"] == digest]))
"""


@pytest.mark.root
def test_a_merge_on_a_full_disk_is_one_line_and_loses_nothing(tmp_path):
    (tmp_path / "small").mkdir()
    (tmp_path / "fill.py").write_text(FILL)
    command = f"mount -t tmpfs -o size=12m none small && PYTHONPATH={ROOT} exec {sys.executable} fill.py"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=200
    )
    assert done.returncode == 0, done.stderr
    found, code, same = json.loads(done.stdout.splitlines()[-1])
    assert (code, same) == (0, True)
    failed = [(kilobytes, code, told) for kilobytes, code, told in found if code != 0]
    assert len(failed) >= 4
    for kilobytes, code, told in failed:
        assert code in (1, 2), (kilobytes, code)
        (line,) = told.splitlines()
        assert line.startswith("verso: ")
        assert "full; free some space and start again, nothing finished is lost" in line
