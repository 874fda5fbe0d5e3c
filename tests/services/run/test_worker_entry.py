"""How a shard enters a worker: what is checked first, and how a node that is to end gives its shard back."""

import json
import os
import pickle
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from ray import cloudpickle

from schemas.environment import FOR_SPEED, KEEP, ON_X86_64_V3, STACK_ENVIRONMENT, X86_64_V3, stack_environment
from schemas.errors import FingerprintError, MachineError, OutputError
from services.run import worker_entry
from services.run import worker_entry as module
from services.run.joining import terms_of_driver
from services.run.worker_entry import (
    DRAIN,
    Sight,
    WorkerTerms,
    check_worker,
    enter_shard,
    is_draining,
    look_at_folder,
    processor_flags,
    refusal_of,
    refusal_of_worker,
    see,
    start_environment,
    worker_environment,
)
from workers.shard.code import code_digest

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


def lock_in(folder: Path, token: str) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "_lock.json").write_text(json.dumps({"token": token, "beat": 7}))
    return str(folder / "_lock.json")


def test_processor_flags_are_those_of_the_first_core(tmp_path):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nflags\t\t: fpu avx2 bmi2\n\nflags\t\t: other\n")
    assert processor_flags(cpuinfo) == {"fpu", "avx2", "bmi2"}
    cpuinfo.write_text("Features\t: asimd\n")
    assert processor_flags(cpuinfo) == frozenset()
    assert processor_flags(tmp_path / "absent") == frozenset()


def test_what_a_process_sets_later_is_not_what_it_was_started_with():
    look = "import os; os.environ['ONE'] = 'changed'; from services.run.worker_entry import start_environment as s; print(s"
    command = [sys.executable, "-c", f"{look}(['ONE', 'TWO', 'THREE']))"]
    environ = {"PYTHONPATH": str(ROOT), "ONE": "first", "TWO": "a=b"}
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str({"ONE": "first", "TWO": "a=b"})
    assert start_environment(["no such variable"]) == {}


def test_it_loads_nothing_that_reads_the_environment():
    look = "import sys, services.run.worker_entry; print(*{'numpy', 'pydantic', 'cv2', 'ray', 'OpenGL'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", look], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_folder_is_the_drivers_if_its_file_holds_the_token(tmp_path):
    proof = lock_in(tmp_path / "out", "ours")
    assert look_at_folder(proof, "ours", 0) == ""
    assert [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()] == ["_lock.json"]
    assert look_at_folder(proof, "theirs", 0) == "it holds the lock of another run"
    assert look_at_folder(str(tmp_path / "absent" / "_lock.json"), "ours", 0) == "there is no such folder"
    (tmp_path / "empty").mkdir()
    assert look_at_folder(str(tmp_path / "empty" / "_lock.json"), "ours", 0) == "it is another folder"


def test_a_token_that_arrives_late_is_waited_for(tmp_path):
    """As on a network file system, or while the heartbeat is being written."""
    later = (
        f"import time; time.sleep(0.4); open({str(tmp_path / '_lock.json')!r}, 'w').write('{{\"token\": \"ours\"}}')"
    )
    (tmp_path / "_lock.json").write_text("{")
    with subprocess.Popen([sys.executable, "-c", later]):
        assert look_at_folder(str(tmp_path / "_lock.json"), "ours", 10) == ""


def test_a_folder_that_can_only_be_read_is_told(tmp_path, monkeypatch):
    proof = lock_in(tmp_path / "out", "ours")

    def refuse(*_: object) -> int:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "open", refuse)
    assert look_at_folder(proof, "ours", 0) == "it cannot be written (Read-only file system)"


def test_a_node_tells_its_code_or_why_it_has_none(tmp_path):
    assert see((), "", "").code == code_digest()
    cloudpickle.register_pickle_by_value(worker_entry)
    try:
        question = cloudpickle.dumps(lambda: see((), "", "").no_code)
    finally:
        cloudpickle.unregister_pickle_by_value(worker_entry)
    away = f"import sys; sys.path = [p for p in sys.path if p != {str(ROOT)!r}]; from ray import cloudpickle"
    answer = f"{away}; print(cloudpickle.loads(sys.stdin.buffer.read())())"
    done = subprocess.run(
        [sys.executable, "-P", "-c", answer], cwd=tmp_path, input=question, capture_output=True, check=False
    )
    assert done.stdout.decode().strip() == "No module named 'workers'", done.stderr


def test_a_sight_is_plain_data():
    seen = see(("PATH",), "", "")
    assert Sight(**seen.__dict__) == seen
    assert seen.environment == {"PATH": os.environ["PATH"]} or "PATH" in seen.environment


ENVIRONMENT = stack_environment(X86_64_V3)
TERMS = WorkerTerms(tuple(ENVIRONMENT.items()), "c" * 64, "head", "/data/out", "/data/out/_lock.json", "token")
GOOD = Sight("h2", X86_64_V3 | {"sse2"}, ENVIRONMENT, "c" * 64)


def test_a_worker_that_has_all_is_taken():
    assert refusal_of(TERMS, GOOD) is None
    assert refusal_of_worker(TERMS, GOOD) is None


def test_a_driver_gives_what_it_has_of_the_stacks_variables_and_no_other():
    mine = {**ENVIRONMENT, "OMP_NUM_THREADS": "4", "AWS_SECRET_ACCESS_KEY": "secret"}
    assert worker_environment(mine) == {**ENVIRONMENT, "OMP_NUM_THREADS": "4"}
    assert worker_environment({}) == {}
    assert {*STACK_ENVIRONMENT, *ON_X86_64_V3} == set(worker_environment(mine))


def test_a_driver_gives_its_own_setting_for_speed_but_not_a_users():
    assert worker_environment(FOR_SPEED) == dict(FOR_SPEED)
    assert worker_environment({"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2"}) == {}


@pytest.mark.parametrize("name", sorted(ENVIRONMENT))
def test_a_worker_without_one_of_the_variables_is_told_which_and_what_to_do(name):
    without = {key: value for key, value in ENVIRONMENT.items() if key != name}
    refusal = refusal_of_worker(TERMS, replace(GOOD, environment=without))
    assert isinstance(refusal, FingerprintError)
    assert f"{name} is not set there and '{ENVIRONMENT[name]}' here" in str(refusal)
    assert "h2" in str(refusal) and "head" in str(refusal) and "`ray start` on h2" in str(refusal)
    other = refusal_of_worker(TERMS, replace(GOOD, environment={**ENVIRONMENT, name: "other"}))
    assert f"{name} is 'other' there" in str(other)


def test_before_a_worker_starts_its_node_is_not_asked_for_variables():
    assert refusal_of(TERMS, replace(GOOD, environment={})) is None


def test_a_processor_below_v3_is_refused_where_the_drivers_kernels_need_it():
    old = replace(GOOD, flags=GOOD.flags - {"fma", "avx2"})
    for refusal in (refusal_of(TERMS, old), refusal_of_worker(TERMS, old)):
        assert isinstance(refusal, MachineError)
        assert "h2 is below x86-64-v3 (no avx2, fma)" in str(refusal) and "head" in str(refusal)
    without = replace(TERMS, environment=tuple(stack_environment(frozenset()).items()))
    assert refusal_of(without, old) is None


def test_other_code_is_refused_with_both_digests():
    refusal = refusal_of(TERMS, replace(GOOD, code="d" * 64))
    assert isinstance(refusal, FingerprintError)
    assert "h2 has code dddddddddddd" in str(refusal) and "head, where the run was started, has cccccccccccc" in str(
        refusal
    )
    assert "install the same wheel or image" in str(refusal)
    absent = refusal_of(TERMS, replace(GOOD, code="", no_code="No module named 'workers'"))
    assert "h2 has no code of this project (No module named 'workers')" in str(absent)


def test_a_folder_that_is_not_shared_is_refused_with_both_ways_out():
    refusal = refusal_of(TERMS, replace(GOOD, folder="there is no such folder"))
    assert isinstance(refusal, OutputError) and refusal.exit_code == 2
    told = str(refusal)
    assert "h2 does not share the output folder /data/out with head" in told and "there is no such folder" in told
    assert "NFS" in told and "s3://" in told and "output.layout=tar" in told
