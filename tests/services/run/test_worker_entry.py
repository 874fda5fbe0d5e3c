"""How a shard enters a worker: what is checked first, and how a node that is to end gives its shard back."""

import os
import pickle
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from schemas.environment import KEEP
from schemas.errors import FingerprintError, OutputError
from services.run import worker_entry as module
from services.run.joining import terms_of_driver
from services.run.worker_entry import DRAIN, WorkerTerms, check_worker, enter_shard, is_draining

ROOT = Path(__file__).resolve().parents[3]

ENTER = """
import pickle, sys
from services.run.worker_entry import enter_shard
try:
    enter_shard(pickle.loads(sys.stdin.buffer.read()), b"not pickled", b"not pickled")
except Exception as error:
    print(type(error).__name__, error)
print(*sorted({"numpy", "pydantic", "cv2", "OpenGL", "pybullet"} & set(sys.modules)))
"""


def enter(terms: WorkerTerms, environ: dict[str, str]) -> list[str]:
    """What a worker with this environment says, and which heavy modules it has loaded then."""
    run = [sys.executable, "-P", "-c", ENTER]
    plain = {"PYTHONPATH": str(ROOT), **environ}
    done = subprocess.run(run, input=pickle.dumps(terms), env=plain, cwd="/", capture_output=True, check=True)
    return done.stdout.decode().splitlines()


def test_a_worker_without_a_variable_is_refused_before_anything_heavy_loads():
    terms = replace(terms_of_driver(), environment=(("NPY_DISABLE_CPU_FEATURES", "X86_V4"),))
    said, loaded = enter(terms, {})
    assert said.startswith("FingerprintError") and "NPY_DISABLE_CPU_FEATURES is not set there and 'X86_V4' here" in said
    assert loaded == ""


def test_a_worker_that_has_it_goes_on():
    terms = replace(terms_of_driver(), environment=(("NPY_DISABLE_CPU_FEATURES", "X86_V4"),))
    said, loaded = enter(terms, {"NPY_DISABLE_CPU_FEATURES": "X86_V4"})
    assert said.startswith("UnpicklingError") and "numpy" in loaded


def test_a_worker_with_other_code_is_refused_before_it_unpacks_the_order():
    said, loaded = enter(replace(terms_of_driver(), environment=(), code="0" * 64), {})
    assert said.startswith("FingerprintError") and "where the run was started, has 000000000000" in said
    assert loaded == ""


def test_a_worker_of_a_node_that_joined_later_is_asked_for_the_output_folder(tmp_path):
    terms = WorkerTerms((), terms_of_driver().code, "head", str(tmp_path), str(tmp_path / "_lock.json"), "token")
    with pytest.raises(OutputError, match="does not share the output folder"):
        check_worker(terms)


def test_a_driver_is_a_worker_of_its_own():
    if os.environ.get(KEEP) == "1":
        pytest.skip("this environment is kept as it is")
    terms = terms_of_driver()
    started = dict(line.partition("=")[::2] for line in Path("/proc/self/environ").read_text().split("\0"))
    if any(started.get(name) != value for name, value in terms.environment):
        with pytest.raises(FingerprintError):
            check_worker(terms)
    else:
        check_worker(terms)


def test_a_node_is_to_end_once_the_file_is_there(tmp_path, monkeypatch):
    monkeypatch.delenv(DRAIN, raising=False)
    assert not is_draining()
    monkeypatch.setenv(DRAIN, str(tmp_path / "drain"))
    assert not is_draining()
    (tmp_path / "drain").touch()
    assert is_draining()


def test_a_node_that_is_to_end_keeps_a_shard_for_a_moment_so_that_it_is_not_handed_out_in_a_circle(monkeypatch):
    monkeypatch.setattr(module, "is_draining", lambda: True)
    monkeypatch.setattr(module, "DRAINED_PAUSE_S", 0.3)
    begun = time.monotonic()
    with pytest.raises(pickle.UnpicklingError):
        enter_shard(WorkerTerms((), terms_of_driver().code, "head"), b"not pickled", b"not pickled")
    assert time.monotonic() - begun >= 0.3
