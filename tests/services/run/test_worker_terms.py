"""Which nodes and workers are refused, and what they are told."""

from dataclasses import replace

import pytest

from schemas.environment import FOR_SPEED, ON_X86_64_V3, STACK_ENVIRONMENT, X86_64_V3, stack_environment
from schemas.errors import FingerprintError, MachineError, OutputError
from services.run.worker_entry import Sight, WorkerTerms, refusal_of, refusal_of_worker, worker_environment

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
