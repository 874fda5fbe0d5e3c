"""Clusters of a real Ray that know nothing of this project's environment: the same bytes, and what each node is asked first."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.dataset.layout import FINGERPRINT_FILE
from schemas.dataset.shard import Fingerprint
from services.run.worker_entry import processor_flags
from tests.kit.ray_head import ROOT, BareCluster, another_node, bare_cluster

pytestmark = [pytest.mark.ray, pytest.mark.minute]

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


def digest_of(done) -> str:
    assert done.returncode == 0, done.stderr
    return re.findall(r"dataset digest (\w{64})", done.stdout)[0]


@pytest.fixture(scope="module")
def private(job, cluster) -> str:
    """The digest of a run without a cluster."""
    return digest_of(cluster.verso("run", str(job), "--out", str(job.parent / "private")))


@pytest.mark.slow
def test_a_cluster_started_in_a_bare_shell_makes_the_same_bytes(cluster, job, private):
    out = job.parent / "cluster"
    assert digest_of(cluster.verso("run", str(job), "--out", str(out), "--address", cluster.address)) == private
    written = Fingerprint.model_validate_json((out / FINGERPRINT_FILE).read_text())
    records = (out / "manifest" / "_commits").glob("*.json")
    assert {json.loads(record.read_text())["terms"]["fingerprint"] for record in records} == {written.digest}


@pytest.mark.slow
def test_a_driver_that_sees_no_avx512_makes_the_same_bytes(cluster, job, private):
    """It is hidden from the C library. numpy, OpenBLAS and Mesa ask the processor itself, and are told by our variables."""
    hidden = "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ,-AVX512CD"
    words = ("run", str(job), "--out", str(job.parent / "hidden"), "--address", cluster.address)
    assert digest_of(cluster.verso(*words, GLIBC_TUNABLES=hidden)) == private


@pytest.mark.slow
def test_a_driver_whose_c_library_rounds_otherwise_is_told_both_stacks(cluster, job):
    if "fma" not in processor_flags():
        pytest.skip("this processor has no fused multiplication")
    words = ("run", str(job), "--out", str(job.parent / "other"), "--address", cluster.address)
    done = cluster.verso(*words, GLIBC_TUNABLES="glibc.cpu.hwcaps=-FMA,-AVX2")
    assert done.returncode == 1
    (told,) = (line for line in done.stderr.splitlines() if line.startswith("verso: "))
    assert "maths: " in told and "the dataset's is " in told and "unset GLIBC_TUNABLES" in told
    assert not list((job.parent / "other").glob("manifest/_commits/*"))


PROBE = """
import json, sys
from dataclasses import replace
from services.run.joining import check_nodes, terms_of_driver
from services.run.ray_cluster import cluster_ray
address, out = sys.argv[1:]
open(f"{out}/_lock.json", "w").write(json.dumps({"token": "ours"}))
terms = replace(terms_of_driver(), environment=(), out=out, proof=f"{out}/_lock.json", token="ours")
with cluster_ray(address, None) as slots:
    said = [slots.now().running]
    for asked in (terms, replace(terms, code="0" * 64), replace(terms, token="theirs")):
        try:
            said.append(check_nodes(asked))
        except Exception as error:
            said.append(f"{type(error).__name__} {error}")
print(*said, sep="\\n")
"""


def test_every_node_is_asked_for_its_code_and_its_folder(cluster, tmp_path):
    def probe() -> list[str]:
        run = [sys.executable, "-c", PROBE, cluster.address, str(tmp_path)]
        environ = {**cluster.shell, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(run, env=environ, cwd="/", capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    assert probe() == ["2", "None", "None", "None"], "the only node asks its own workers"
    with another_node(cluster, tmp_path):
        cores, good, code, folder = probe()
    assert (cores, good) == ("3", "None")
    assert code.startswith("FingerprintError") and "where the run was started, has 000000000000" in code
    assert folder.startswith("OutputError") and "it holds the lock of another run" in folder


@pytest.mark.root
def test_a_job_that_would_write_to_one_hosts_private_disk_is_refused_before_the_first_scene(cluster, job, tmp_path):
    """The second node sees an empty disk of its own where the output folder would be."""
    disk = tmp_path / "disk"
    disk.mkdir()
    own_disk = ("unshare", "-m", "sh", "-c", f'mount -t tmpfs none {disk} && exec "$@"', "sh")
    with another_node(cluster, tmp_path, *own_disk):
        done = cluster.verso("run", str(job), "--out", str(disk / "out"), "--address", cluster.address)
    assert done.returncode == 2, done.stderr
    (told,) = (line for line in done.stderr.splitlines() if line.startswith("verso: "))
    assert "does not share the output folder" in told and "there is no such folder" in told
    assert "NFS" in told and "s3://" in told and "nothing was made" in told
    assert not list((disk / "out").glob("manifest/_commits/*")) and not list((disk / "out").glob("_staging/*/*"))
