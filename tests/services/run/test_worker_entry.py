"""How a shard enters a worker: what a driver asks of it, what is checked first, and how a node gives a shard back."""

import json
import os
import pickle
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from ray import cloudpickle

from schemas.dataset.layout import FINGERPRINT_FILE
from schemas.dataset.shard import Fingerprint, ShardOrder
from schemas.environment import FOR_SPEED, ON_X86_64_V3, STACK_ENVIRONMENT, X86_64_V3, stack_environment
from schemas.errors import FingerprintError, MachineError, OutputError
from services.job.job_file import validate_job
from services.run import worker_entry as module
from services.run.ray_cluster import with_own_stack
from services.run.worker_entry import (
    DRAIN,
    Pattern,
    Sight,
    WorkerTerms,
    check_worker,
    enter_shard,
    is_draining,
    look_at_folder,
    processor_flags,
    refusal_of,
    see,
    start_environment,
    terms_of_driver,
)
from workers.assets.catalogue import Catalogue
from workers.render.raster.gbuffer import shared_renderer
from workers.shard.fingerprint import take_fingerprint
from workers.source import code_digest
from workers.store.local import LocalStore

ROOT = Path(__file__).resolve().parents[3]

ENTER = """
import pickle, sys
from services.run.worker_entry import enter_shard
print(*sorted({"numpy", "pydantic", "cv2", "ray", "OpenGL", "pybullet"} & set(sys.modules)))
try:
    enter_shard(pickle.loads(sys.stdin.buffer.read()), b"not pickled", b"not pickled")
except Exception as error:
    print(type(error).__name__, error)
print(*sorted({"numpy", "pydantic", "cv2", "OpenGL", "pybullet"} & set(sys.modules)))
"""


@pytest.mark.minute
def test_a_worker_is_refused_before_anything_heavy_loads_and_goes_on_where_it_has_what_the_driver_has():
    """Before it unpacks what it was given, too, which other code could not."""
    terms = replace(terms_of_driver(), environment=(("NPY_DISABLE_CPU_FEATURES", "X86_V4"),))
    lacks = "NPY_DISABLE_CPU_FEATURES is not set there and 'X86_V4' here"
    other = replace(terms, environment=(), code="0" * 64)
    for asked, environ, error, words in (
        (terms, {}, "FingerprintError", lacks),
        (other, {}, "FingerprintError", "where the run was started, has 000000000000"),
        (terms, dict(terms.environment), "UnpicklingError", ""),
    ):
        run = [sys.executable, "-P", "-c", ENTER]
        plain = {"PYTHONPATH": str(ROOT), **environ}
        done = subprocess.run(run, input=pickle.dumps(asked), env=plain, cwd="/", capture_output=True, check=True)
        before, said, loaded = done.stdout.decode().splitlines()
        assert before == "" and said.startswith(error) and words in said
        assert ("numpy" in loaded) == (error == "UnpicklingError")


def test_a_worker_of_a_node_that_joined_later_is_asked_for_the_output_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "look_at_folder", lambda proof, token: look_at_folder(proof, token, 0.2))
    terms = WorkerTerms((), terms_of_driver().code, "head", str(tmp_path), str(tmp_path / "_lock.json"), "token")
    with pytest.raises(OutputError, match="does not share the output folder"):
        check_worker(terms)


def test_a_node_that_is_to_end_keeps_a_shard_for_a_moment_so_that_it_is_not_handed_out_in_a_circle(
    tmp_path, monkeypatch
):
    monkeypatch.setenv(DRAIN, str(tmp_path / "drain"))
    assert not is_draining()
    (tmp_path / "drain").touch()
    assert is_draining()
    monkeypatch.setattr(module, "DRAINED_PAUSE_S", 0.3)
    begun = time.monotonic()
    with pytest.raises(pickle.UnpicklingError):
        enter_shard(WorkerTerms((), terms_of_driver().code, "head"), b"not pickled", b"not pickled")
    assert time.monotonic() - begun >= 0.3


def test_a_process_sees_its_first_cores_flags_and_the_variables_that_it_was_started_with(tmp_path):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nflags\t\t: fpu avx2 bmi2\n\nflags\t\t: other\n")
    assert processor_flags(cpuinfo) == {"fpu", "avx2", "bmi2"}
    cpuinfo.write_text("Features\t: asimd\n")
    assert processor_flags(cpuinfo) == processor_flags(tmp_path / "absent") == frozenset()
    (tmp_path / "environ").write_bytes(b"ONE=first\0TWO=a=b\0")
    assert start_environment(["ONE", "TWO", "THREE"], tmp_path / "environ") == {"ONE": "first", "TWO": "a=b"}
    assert "ANOTHER" not in start_environment(["ANOTHER"]), "what is set later does not count"


def test_a_folder_is_the_drivers_if_its_file_holds_the_token_and_it_can_be_written(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    proof = str(tmp_path / "out" / "_lock.json")
    Path(proof).write_text(json.dumps({"token": "ours", "beat": 7}))
    assert look_at_folder(proof, "ours", 0) == ""
    assert [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()] == ["_lock.json"]
    assert look_at_folder(proof, "theirs", 0) == "it holds the lock of another run"
    assert look_at_folder(str(tmp_path / "absent" / "_lock.json"), "ours", 0) == "there is no such folder"
    (tmp_path / "empty").mkdir()
    assert look_at_folder(str(tmp_path / "empty" / "_lock.json"), "ours", 0) == "it is another folder"

    def refuse(*_: object) -> int:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "open", refuse)
    assert look_at_folder(proof, "ours", 0) == "it cannot be written (Read-only file system)"


def test_a_node_tells_its_code_or_why_it_has_none(tmp_path):
    assert see((), "", "").code == code_digest()
    cloudpickle.register_pickle_by_value(module)
    try:
        question = cloudpickle.dumps(lambda: see((), "", "").no_code)
    finally:
        cloudpickle.unregister_pickle_by_value(module)
    away = f"import sys; sys.path = [p for p in sys.path if p != {str(ROOT)!r}]; from ray import cloudpickle"
    answer = [sys.executable, "-P", "-c", f"{away}; print(cloudpickle.loads(sys.stdin.buffer.read())())"]
    done = subprocess.run(answer, cwd=tmp_path, input=question, capture_output=True, check=False)
    assert done.stdout.decode().strip() == "No module named 'workers'", done.stderr


# ------------------------------------------------------------------------------------- what is asked, and what is refused

ENVIRONMENT = stack_environment(X86_64_V3)
TERMS = WorkerTerms(tuple(ENVIRONMENT.items()), "c" * 64, "head", "/data/out", "/data/out/_lock.json", "token")
GOOD = Sight("h2", X86_64_V3 | {"sse2"}, ENVIRONMENT, "c" * 64)


def test_a_driver_gives_what_it_has_of_the_stacks_variables_and_no_other(monkeypatch):
    mine = {**ENVIRONMENT, "OMP_NUM_THREADS": "4", "AWS_SECRET_ACCESS_KEY": "secret"}
    assert dict(terms_of_driver(mine).environment) == {**ENVIRONMENT, "OMP_NUM_THREADS": "4"}
    assert {*STACK_ENVIRONMENT, *ON_X86_64_V3} == {name for name, _ in terms_of_driver(mine).environment}
    for others, expected in (({}, {}), ({"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2"}, {}), (FOR_SPEED, FOR_SPEED)):
        assert dict(terms_of_driver(others).environment) == expected
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    terms = terms_of_driver()
    assert ("OPENBLAS_CORETYPE", "Haswell") in terms.environment and "LP_NUM_THREADS" not in dict(terms.environment)
    assert (terms.code, terms.driver) == (code_digest(), socket.gethostname())
    order = ShardOrder.of("out", validate_job({"name": "small", "scenes": 2}, "test"), "j" * 64)
    private = Pattern(order, cast(Catalogue, None), WorkerTerms((("A", "1"),), "", ""))
    assert private.env_vars == {}, "those of a private Ray inherit them"


LESS, NO_CODE = "h2 is below x86-64-v3 (no avx2, fma)", "No module named 'workers'"
OTHER = (
    "h2 has code dddddddddddd, and head, where the run was started, has cccccccccccc: install the same wheel or image"
)
NO_FOLDER = (
    "h2 does not share the output folder /data/out with head, where the run was started: there is no such folder"
)
REFUSALS = [
    ({"flags": X86_64_V3 - {"fma", "avx2"}}, MachineError, [LESS, "head"]),
    ({"code": "d" * 64}, FingerprintError, [OTHER]),
    ({"code": "", "no_code": NO_CODE}, FingerprintError, [f"h2 has no code of this project ({NO_CODE})"]),
    ({"folder": "there is no such folder"}, OutputError, [NO_FOLDER, "NFS", "s3://", "output.layout=tar"]),
]
"""What a node lacks, and what it is told; a worker is told the same."""


def test_a_node_or_a_worker_that_lacks_something_is_told_what_and_what_to_do():
    assert refusal_of(TERMS, GOOD) is None and refusal_of(TERMS, GOOD, True) is None
    assert refusal_of(TERMS, replace(GOOD, environment={})) is None, "a node is not asked for variables"
    for lack, error, words in REFUSALS:
        for refusal in (refusal_of(TERMS, replace(GOOD, **lack)), refusal_of(TERMS, replace(GOOD, **lack), True)):
            assert isinstance(refusal, error)
            assert all(word in str(refusal) for word in words), str(refusal)
    without = replace(TERMS, environment=tuple(stack_environment(frozenset()).items()))
    assert refusal_of(without, replace(GOOD, flags=frozenset())) is None, "its driver does not need them"
    for name in ENVIRONMENT:
        less = {key: value for key, value in ENVIRONMENT.items() if key != name}
        refusal = refusal_of(TERMS, replace(GOOD, environment=less), True)
        assert isinstance(refusal, FingerprintError)
        assert f"{name} is not set there and '{ENVIRONMENT[name]}' here" in str(refusal)
        assert "head" in str(refusal) and "`ray start` on h2" in str(refusal)
        refusal = refusal_of(TERMS, replace(GOOD, environment={**less, name: "other"}), True)
        assert f"{name} is 'other' there" in str(refusal)


def test_every_worker_of_a_new_strict_dataset_is_compared_with_the_driver_and_no_other_dataset_is_touched(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()

    def asked(mode: str, fingerprint: str = "") -> str:
        job = validate_job({"name": "small", "scenes": 2, "run": {"fingerprint": mode}}, "test")
        order = ShardOrder.of(str(store.root), job, "j" * 64)
        order = order.model_copy(update={"terms": order.terms.model_copy(update={"fingerprint": fingerprint})})
        return with_own_stack(store, order).terms.fingerprint

    for mode, committed in (("strict", "f" * 64), ("record", "")):
        assert asked(mode, committed) == committed
        assert store.size(FINGERPRINT_FILE) is None
    mine = asked("strict")
    assert mine == take_fingerprint(shared_renderer(), "raster").digest
    assert Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE)).digest == mine
