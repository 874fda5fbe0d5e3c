"""The same bytes on a cluster that knows nothing of this project's environment."""

import json
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest

from schemas.dataset.layout import FINGERPRINT_FILE
from schemas.dataset.shard import Fingerprint, ShardOrder
from services.job.job_file import validate_job
from services.run.joining import Pattern, terms_of_driver, with_own_stack
from services.run.worker_entry import WorkerTerms, processor_flags
from tests.kit.ray_head import BareCluster, bare_cluster
from workers.assets.catalogue import Catalogue
from workers.render.raster.gbuffer import shared_renderer
from workers.shard.code import code_digest
from workers.shard.fingerprint import take_fingerprint
from workers.store.local import LocalStore

JOB = "name: shapes\nseed: 2024\nscenes: 8\ncategories: [box, can]\nrun: {range_size: 2}\n"
"""Boxes and cans are where numpy's and OpenBLAS's instruction sets were seen to change bits."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[BareCluster]:
    with bare_cluster() as started:
        yield started


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("job") / "shapes.yaml"
    file.write_text(JOB)
    return file


@pytest.fixture(scope="module")
def private(job, cluster) -> str:
    """The digest of a run without a cluster."""
    return digest_of(cluster.verso("run", str(job), "--out", str(job.parent / "private")))


def digest_of(done) -> str:
    assert done.returncode == 0, done.stderr
    return re.findall(r"dataset digest (\w{64})", done.stdout)[0]


HIDDEN = "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ,-AVX512CD"
"""Hides AVX-512 from the C library. numpy, OpenBLAS and Mesa ask the processor itself, and are told by our variables."""


@pytest.mark.ray
@pytest.mark.minute
def test_a_driver_that_sees_no_avx512_makes_the_same_bytes(cluster, job, private):
    out = job.parent / "hidden"
    words = ("run", str(job), "--out", str(out), "--address", cluster.address)
    assert digest_of(cluster.verso(*words, GLIBC_TUNABLES=HIDDEN)) == private


@pytest.mark.ray
@pytest.mark.minute
def test_a_driver_whose_c_library_rounds_otherwise_is_told_both_stacks(cluster, job):
    if "fma" not in processor_flags():
        pytest.skip("this processor has no fused multiplication")
    words = ("run", str(job), "--out", str(job.parent / "other"), "--address", cluster.address)
    done = cluster.verso(*words, GLIBC_TUNABLES="glibc.cpu.hwcaps=-FMA,-AVX2")
    assert done.returncode == 1
    (told,) = (line for line in done.stderr.splitlines() if line.startswith("verso: "))
    assert "maths: " in told and "the dataset's is " in told and "unset GLIBC_TUNABLES" in told
    assert not list((job.parent / "other").glob("manifest/_commits/*"))


@pytest.mark.ray
@pytest.mark.minute
def test_a_cluster_started_in_a_bare_shell_makes_the_same_bytes(cluster, job, private):
    out = job.parent / "cluster"
    assert digest_of(cluster.verso("run", str(job), "--out", str(out), "--address", cluster.address)) == private
    written = Fingerprint.model_validate_json((out / FINGERPRINT_FILE).read_text())
    records = (out / "manifest" / "_commits").glob("*.json")
    assert {json.loads(record.read_text())["terms"]["fingerprint"] for record in records} == {written.digest}


def order_of(store: LocalStore, mode: str, fingerprint: str = "") -> ShardOrder:
    job = validate_job({"name": "small", "scenes": 2, "run": {"fingerprint": mode}}, "test")
    order = ShardOrder.of(str(store.root), job, "j" * 64)
    return order.model_copy(update={"terms": order.terms.model_copy(update={"fingerprint": fingerprint})})


def test_every_worker_of_a_new_strict_dataset_is_compared_with_the_driver(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    mine = with_own_stack(store, order_of(store, "strict")).terms.fingerprint
    assert mine == take_fingerprint(shared_renderer(), "raster").digest
    assert Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE)).digest == mine


@pytest.mark.parametrize(("mode", "committed"), [("strict", "f" * 64), ("record", "")])
def test_a_dataset_that_has_commits_or_takes_any_stack_is_left_as_it_is(tmp_path, mode, committed):
    store = LocalStore(tmp_path)
    store.prepare()
    assert with_own_stack(store, order_of(store, mode, committed)).terms.fingerprint == committed
    assert store.size(FINGERPRINT_FILE) is None


def test_workers_are_to_have_what_the_driver_has(monkeypatch):
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    terms = terms_of_driver()
    assert ("OPENBLAS_CORETYPE", "Haswell") in terms.environment and "LP_NUM_THREADS" not in dict(terms.environment)
    assert (terms.code, terms.driver) == (code_digest(), socket.gethostname())


def test_workers_of_a_private_ray_are_set_no_variables():
    order = ShardOrder.of("out", validate_job({"name": "small", "scenes": 2}, "test"), "j" * 64)
    assert Pattern(order, cast(Catalogue, None), WorkerTerms((("A", "1"),), "", "")).env_vars == {}
