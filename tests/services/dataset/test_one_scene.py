"""A scene made in memory is the scene that a run stores."""

import subprocess
import sys

import numpy as np
import pytest
import yaml

from schemas.errors import JobError, SceneError
from services.dataset.dataset import open_dataset
from services.dataset.one_scene import make_scene
from services.job.job_file import validate_job
from tests.datasets import SMALL, overlaid
from tests.services.dataset.conftest import CHANGES

KEYS = overlaid(SMALL, CHANGES)


def test_a_scene_in_memory_is_the_stored_one(files, tmp_path):
    path = tmp_path / "job.yaml"
    path.write_text(yaml.safe_dump(KEYS))
    stored = open_dataset(files.root).scene(2)
    for job in (KEYS, path, str(path), validate_job(KEYS, "test")):
        made = make_scene(job, 2)
        assert [pair.pose_id for pair in made] == [pair.pose_id for pair in stored] == [8, 10]
        for mine, theirs in zip(made, stored, strict=True):
            assert mine.scene == theirs.scene and mine.input.row == theirs.input.row
            for role in ("input", "aligned", "mirror", "projected"):
                a, b = getattr(mine, role), getattr(theirs, role)
                assert np.array_equal(a.rgb(), b.rgb()) and np.array_equal(a.depth(), b.depth())
            assert np.array_equal(mine.input.patch().segment(), theirs.input.patch().segment())
            assert mine.mesh().bounds == pytest.approx(theirs.mesh().bounds, abs=1e-12)


def test_changes_are_those_of_the_command_line(tmp_path):
    path = tmp_path / "job.yaml"
    path.write_text(yaml.safe_dump(KEYS))
    (pair,) = make_scene(path, 0, ["pairs_per_scene=1", "start.pose=placed"])
    assert pair.scene["pose"] == "placed"
    with pytest.raises(JobError, match="there is no such key"):
        make_scene(path, 0, ["start.poze=placed"])


def test_a_scene_that_cannot_be_made_says_why():
    with pytest.raises(SceneError, match="scene 0 cannot be made"):
        make_scene(overlaid(KEYS, {"cameras": {"sensor": {"fx": 90_000.0, "fy": 90_000.0}}}), 0)


def test_neither_ray_nor_a_renderer_is_loaded_to_read():
    code = (
        "import sys; import services.dataset.dataset; loaded = set(sys.modules) & {'ray', 'pybullet', 'OpenGL', 'duckdb'};"
        "import services.dataset.one_scene; print(loaded, 'ray' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["set()", "False"]
