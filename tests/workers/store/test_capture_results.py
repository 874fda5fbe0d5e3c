"""Files of a processed capture: read back as written, ours told from the user's, and no file of the user's lost."""

import numpy as np
import pytest
import trimesh

from schemas.errors import CaptureError
from workers.capture.results import cloud_ply, mesh_ply, own_files, read_cloud, read_mesh, read_record, write_results

RNG = np.random.default_rng(5)
POINTS = RNG.normal(0, 0.1, (50, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1)[:, None]
COLORS = RNG.integers(0, 256, (50, 3)).astype(np.uint8)
VIEWS = RNG.integers(1, 40, 50).astype(np.int32)
FACES = RNG.integers(0, 50, (30, 3)).astype(np.int32)


def test_a_cloud_is_read_back_and_trimesh_reads_it_too(tmp_path):
    (tmp_path / "cloud.ply").write_bytes(cloud_ply(POINTS, NORMALS, COLORS, VIEWS))
    points, normals, colors, views = read_cloud(tmp_path)
    assert np.allclose(points, POINTS, atol=1e-7) and np.allclose(normals, NORMALS, atol=1e-6)
    assert np.array_equal(colors, COLORS) and np.array_equal(views, VIEWS)
    other = trimesh.load(tmp_path / "cloud.ply")
    assert np.allclose(other.vertices, POINTS, atol=1e-7) and np.array_equal(np.asarray(other.colors)[:, :3], COLORS)


def test_a_mesh_is_read_back_and_trimesh_reads_it_too(tmp_path):
    (tmp_path / "mesh.ply").write_bytes(mesh_ply(POINTS, FACES, COLORS))
    vertices, faces, colors = read_mesh(tmp_path)
    assert np.allclose(vertices, POINTS, atol=1e-7) and np.array_equal(faces, FACES) and np.array_equal(colors, COLORS)
    other = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert np.allclose(other.vertices, POINTS, atol=1e-7) and np.array_equal(other.faces, FACES)


def test_files_that_were_changed_or_given_are_the_users(tmp_path):
    (tmp_path / "mask_00000.png").write_bytes(b"given")
    users = write_results(tmp_path, {"mask_00000.png": b"a", "mask_00001.png": b"b", "cloud.ply": b"c"}, {"note": 1})
    assert users == ["mask_00000.png"] and (tmp_path / "mask_00000.png").read_bytes() == b"given"
    assert own_files(tmp_path) == {"mask_00001.png", "cloud.ply"}
    (tmp_path / "mask_00001.png").write_bytes(b"changed")
    assert own_files(tmp_path) == {"cloud.ply"}
    users = write_results(tmp_path, {"mask_00001.png": b"z"}, {})
    assert users == ["mask_00001.png"] and (tmp_path / "mask_00001.png").read_bytes() == b"changed"
    assert not (tmp_path / "cloud.ply").exists()  # ours, and not made this time
    assert read_record(tmp_path) == {"files": {}}


def test_a_run_that_was_cut_off_leaves_no_file_that_looks_given(tmp_path, monkeypatch):
    import os

    real, calls = os.replace, []

    def fail(source, target):
        calls.append(target)
        if len(calls) == 3:
            raise OSError("cut off")
        real(source, target)

    monkeypatch.setattr("workers.capture.results.os.replace", fail)
    with pytest.raises(OSError, match="cut off"):
        write_results(tmp_path, {"a.png": b"1", "b.png": b"2", "c.png": b"3"}, {})
    assert own_files(tmp_path) == {"a.png"}
    monkeypatch.undo()
    assert write_results(tmp_path, {"a.png": b"1", "b.png": b"2"}, {}) == []
    assert own_files(tmp_path) == {"a.png", "b.png"}


def test_what_is_missing_or_damaged_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="verso capture process"):
        read_cloud(tmp_path)
    (tmp_path / "cloud.ply").write_bytes(b"ply nonsense")
    with pytest.raises(CaptureError, match="no PLY that"):
        read_cloud(tmp_path)
    (tmp_path / "cloud.ply").write_bytes(cloud_ply(POINTS, NORMALS, COLORS, VIEWS)[:-1])
    with pytest.raises(CaptureError, match="ends early"):
        read_cloud(tmp_path)
    assert read_record(tmp_path) is None
    for text in ("{", "[]", '{"files": 3}'):
        (tmp_path / "process.json").write_text(text)
        with pytest.raises(CaptureError, match=r"process\.json"):
            read_record(tmp_path)
