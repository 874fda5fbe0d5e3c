"""Convex parts are found before the first scene, once for each mesh, and only for jobs that may need them."""

import signal

import pytest
import trimesh

from schemas.errors import MachineError
from services.job.job_file import validate_job
from services.run import parts
from tests.services.init.own_meshes import cup, write_mesh
from tests.workers.assets.libraries import library_of
from workers.capture.results import open_sources
from workers.pool import Answers


@pytest.fixture
def job_of(tmp_path):
    """A job with a cup and a box of files, and its catalogue."""
    write_mesh(tmp_path / "meshes" / "cup.stl", cup())
    write_mesh(tmp_path / "meshes" / "box.stl", trimesh.creation.box((0.1, 0.1, 0.1)))

    def make(**changes):
        source = library_of(tmp_path / "meshes", "thing")
        tree = {"verso": 1, "name": "t", "categories": ["thing"], "assets": {"objects": [source]}, **changes}
        job = validate_job(tree, "t")
        return job, open_sources(job, tmp_path)

    return make


def count_cut(job, catalogue, folder):
    """How many shapes were cut, and not known from before."""
    before = len(Answers(folder / "cut"))
    parts.find_parts(job, catalogue, folder)
    return len(Answers(folder / "cut")) - before


@pytest.mark.minute
def test_each_mesh_is_cut_once_and_none_where_nothing_needs_parts(job_of, tmp_path):
    single, several = job_of(), job_of(objects_per_scene=2)
    assert count_cut(*single, tmp_path / "kept") == 0
    assert count_cut(*job_of(objects_per_scene=2, physics={"collision": "hull"}), tmp_path / "kept") == 0
    assert count_cut(*several, tmp_path / "kept") == 2
    assert count_cut(*several, tmp_path / "kept") == 0
    coarser = job_of(objects_per_scene=2, physics={"concavity": 0.2})
    assert count_cut(*coarser, tmp_path / "kept") == 2, "other parts, of another depth"


def killed(*_):
    signal.raise_signal(signal.SIGKILL)


def crash(*_):
    signal.raise_signal(signal.SIGSEGV)


@pytest.mark.minute
def test_a_process_that_is_killed_is_told_and_its_mesh_cut_again_and_one_that_crashes_is_told_of_its_mesh(
    job_of, tmp_path, monkeypatch, capsys
):
    several = job_of(objects_per_scene=2)
    with monkeypatch.context() as patch:
        patch.setattr(parts, "cut_shape", killed)
        with pytest.raises(MachineError, match="what is cut stays"):
            parts.find_parts(*several, tmp_path / "kept")
        patch.setattr(parts, "cut_shape", crash)
        parts.find_parts(*several, tmp_path / "other")
    message = capsys.readouterr().err
    assert all(f"{name}: cannot be cut: it crashes its process" in message for name in ("box.stl", "cup.stl"))
    assert count_cut(*several, tmp_path / "kept") == 2
