"""The same bytes on a cluster that knows nothing of this project's environment."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.dataset.fingerprint import Fingerprint
from schemas.dataset.layout import FINGERPRINT_FILE
from tests.bare_cluster import BareCluster, bare_cluster

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


@pytest.fixture(scope="module")
def private(job, cluster) -> str:
    """The digest of a run without a cluster."""
    return digest_of(cluster.verso("run", str(job), "--out", str(job.parent / "private")))


def digest_of(done) -> str:
    assert done.returncode == 0, done.stderr
    return re.findall(r"dataset digest (\w{64})", done.stdout)[0]


def test_a_cluster_started_in_a_bare_shell_makes_the_same_bytes(cluster, job, private):
    out = job.parent / "cluster"
    assert digest_of(cluster.verso("run", str(job), "--out", str(out), "--address", cluster.address)) == private
    written = Fingerprint.model_validate_json((out / FINGERPRINT_FILE).read_text())
    records = (out / "manifest" / "_commits").glob("*.json")
    assert {json.loads(record.read_text())["terms"]["fingerprint"] for record in records} == {written.digest}
