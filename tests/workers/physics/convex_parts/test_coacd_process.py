"""The process that runs CoACD: parts of an L, by its exit code and its file."""

import json
import subprocess
import sys

import numpy as np
import trimesh

from workers.physics import coacd_process

OPTIONS = {
    "threshold": 0.05,
    "preprocess_mode": "off",
    "seed": 0,
    "mcts_iterations": 10,
    "mcts_nodes": 6,
    "mcts_max_depth": 1,
}


def test_an_l_is_cut_into_parts_within_its_bounds(tmp_path):
    outline = [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]
    vertices = np.array([[x, y, z] for z in (0.0, 1.0) for x, y in outline])
    sides = [f for k in range(6) for f in ([k, (k + 1) % 6, 6 + (k + 1) % 6], [k, 6 + (k + 1) % 6, 6 + k])]
    cap = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    faces = np.array([*sides, *(f[::-1] for f in cap), *([6 + v for v in f] for f in cap)], np.int32)
    assert trimesh.Trimesh(vertices, faces).volume > 2.9
    np.savez(tmp_path / "request.npz", vertices=vertices, faces=faces, options=json.dumps(OPTIONS))
    done = subprocess.run(
        [sys.executable, "-P", coacd_process.__file__, str(tmp_path), "60", "4096"], capture_output=True
    )
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "parts.npz") as parts:
        assert len(parts["counts"]) >= 2 and parts["counts"].sum() == len(parts["vertices"])
        assert np.allclose(
            [parts["vertices"].min(axis=0), parts["vertices"].max(axis=0)], [[0, 0, 0], [2, 2, 1]], atol=0.02
        )


def test_a_package_without_its_library_is_missing_and_no_mesh_that_cannot_be_cut(tmp_path, monkeypatch):
    """coacd 1.0.14 without its library is imported, and fails at its first call."""
    (tmp_path / "coacd.py").write_text("def set_log_level(level):\n    _lib.CoACD_setLogLevel(level)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    command = [sys.executable, "-P", coacd_process.__file__, str(tmp_path), "60", "4096"]
    done = subprocess.run(command, capture_output=True)
    assert done.returncode == coacd_process.MISSING, done.stderr
