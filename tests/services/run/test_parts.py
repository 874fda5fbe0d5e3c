"""Convex parts are found before the first scene, once for each mesh, and only for jobs that may need them."""

import os

import pytest
import trimesh

from schemas.errors import MachineError
from services.job.job_file import validate_job
from services.run import parts
from tests.services.init.own_meshes import cup, write_mesh
from tests.workers.assets.libraries import library_of
from workers.capture.results import open_sources


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


def looked_at(monkeypatch, job, catalogue, folder):
    """The files that are cut."""
    paths, run = [], parts.run_pool

    def noted(work, cuts, **settings):
        paths.extend(cut.path for cut in cuts)
        return run(work, cuts, **settings)

    monkeypatch.setattr(parts, "run_pool", noted)
    parts.find_parts(job, catalogue, folder)
    return sorted(paths)


@pytest.mark.minute
def test_each_mesh_is_cut_once_and_none_where_nothing_needs_parts(job_of, tmp_path, monkeypatch):
    single, several = job_of(), job_of(objects_per_scene=2)
    assert looked_at(monkeypatch, *single, tmp_path / "kept") == []
    assert looked_at(monkeypatch, *job_of(objects_per_scene=2, physics={"collision": "hull"}), tmp_path / "kept") == []
    assert looked_at(monkeypatch, *several, tmp_path / "kept") == ["box.stl", "cup.stl"]
    assert looked_at(monkeypatch, *several, tmp_path / "kept") == []
    coarser = job_of(objects_per_scene=2, physics={"concavity": 0.2})
    assert looked_at(monkeypatch, *coarser, tmp_path / "kept") == ["box.stl", "cup.stl"], (
        "other parts, of another depth"
    )


def killed(*_):
    os._exit(9)


@pytest.mark.minute
def test_a_process_that_is_killed_is_told_and_its_mesh_is_looked_at_again(job_of, tmp_path, monkeypatch):
    several = job_of(objects_per_scene=2)
    with monkeypatch.context() as patch:
        patch.setattr(parts, "cut_shape", killed)
        with pytest.raises(MachineError, match="what is cut stays"):
            parts.find_parts(*several, tmp_path / "kept")
    assert looked_at(monkeypatch, *several, tmp_path / "kept") == ["box.stl", "cup.stl"]
