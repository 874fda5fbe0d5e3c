"""Clusters of a real Ray that know nothing of this project's environment: what each node is asked first."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.kit.ray_head import ROOT, BareCluster, another_node, bare_cluster

pytestmark = [pytest.mark.ray, pytest.mark.minute]

JOB = "name: shapes\nseed: 2024\nscenes: 8\ncategories: [box, can]\nrun: {range_size: 2}\n"


@pytest.fixture(scope="module")
def cluster() -> Iterator[BareCluster]:
    with bare_cluster() as started:
        yield started


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("job") / "shapes.yaml"
    file.write_text(JOB)
    return file


PROBE = """
import json, sys
from dataclasses import replace
from services.run.ray_cluster import check_nodes, cluster_ray
from services.run.worker_entry import terms_of_driver
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
