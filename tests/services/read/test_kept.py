"""A miniature dataset that an earlier version made: what it promised still holds for whatever reads it now.

Where a default has become another one, or a stored table another form, this is a new version: it is said in CHANGELOG.md, and
`python -m tests.services.read.test_kept` makes the miniature anew.
"""

import shutil
from pathlib import Path

from schemas.job.job import job_digest
from services.job.job_file import validate_job
from services.job.record import require_job
from tests.datasets import SMALL, faults_of, overlaid, run_here
from workers.store.local import LocalStore

KEPT = Path(__file__).resolve().parents[2] / "data/kept"
PINHOLE = {"width": 96, "height": 72, "fx": 78.75, "fy": 78.75, "cx": 48.0, "cy": 36.0}
ONE = {"source": "procedural", "instances": 1}
KEYS = {
    "name": "kept",
    "categories": {"box": 2.0},
    "assets": {"objects": [{**ONE, "size": "metric"}], "tables": [{**ONE, "kind": "tray"}]},
    "start": {"pose": "tumbled"},
    "cameras": {"sensor": PINHOLE, "depth": {"enabled": False}},
    "sensor": {"depth_noise": {"offset_m": 0.001}, "rgb_noise": {}},
    "images": {"projection": {"hidden_point_removal": True}},
    "targets": {"views": ["normals"]},
    "check": {"raycast_share": 1.0},
    "output": {"layout": "tar"},
    "run": {"range_size": 2},
}


def test_a_dataset_that_an_earlier_version_made_is_verified_and_its_job_has_the_digest_that_was_written(tmp_path):
    store = LocalStore(shutil.copytree(KEPT, tmp_path / "kept"))
    record = require_job(store)
    assert faults_of(store) == [] and job_digest(record.job, record.catalogue) == record.digest


if __name__ == "__main__":
    shutil.rmtree(KEPT, ignore_errors=True)
    print(run_here(validate_job(overlaid(SMALL, KEYS), "kept"), KEPT, Path("/kept"))[1])
