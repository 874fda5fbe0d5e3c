"""Convex parts that are kept: in memory, in files, and across torn files.

The process that runs CoACD: parts of an L, by its exit code and its file. Convex parts, against bodies whose parts
are known, and in processes that must agree.
"""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from schemas.errors import MachineError, MeshError
from schemas.scene.shape import Mesh
from workers.geometry.hull import convex_hull
from workers.geometry.mesh import components, weld
from workers.physics import coacd_process
from workers.physics import convex_parts as module
from workers.physics.convex_parts import Parts, PartsCache, decompose


def digest_of(parts):
    return hashlib.sha256(b"".join(cloud.tobytes() + b"|" for cloud in parts.clouds)).hexdigest()


def test_an_answer_comes_from_memory_then_from_the_folder_and_is_the_same(tmp_path, monkeypatch):
    made = decompose(angle_iron(), "kept", folder=tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(module, "_run", lambda *_: pytest.fail("made once more"))
    assert digest_of(decompose(angle_iron(), "kept", folder=None)) == digest_of(made), "from memory"
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    again = decompose(angle_iron(), "kept", folder=tmp_path)
    assert (again.method, digest_of(again)) == (made.method, digest_of(made))
    assert not again.clouds[0].flags.writeable


@pytest.mark.parametrize("harm", [lambda data: data[:-7], lambda _: b"", lambda data: data[:60] + b"x" + data[61:]])
def test_a_torn_file_is_made_again(tmp_path, monkeypatch, harm):
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    made = decompose(angle_iron(), "torn", folder=tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(harm(whole))
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    assert digest_of(decompose(angle_iron(), "torn", folder=tmp_path)) == digest_of(made)
    assert path.read_bytes() == whole


def test_memory_is_bounded_and_the_latest_stay():
    cache = PartsCache(capacity_bytes=100)
    for key in "abc":
        cache.get(key, None, lambda: Parts((np.zeros((2, 3)),), "convex"))
    for key in "bc":
        cache.get(key, None, lambda: pytest.fail("forgotten"))
    made = []
    for key in ("a", "large", "large"):
        cache.get(
            key, None, lambda key=key: made.append(key) or Parts((np.zeros((9 if key == "large" else 2, 3)),), "convex")
        )
    assert made == ["a", "large", "large"]


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


ROOT = Path(__file__).resolve().parents[4]


def mesh_of(body):
    return Mesh(np.asarray(body.vertices, dtype=np.float64), np.asarray(body.faces, dtype=np.int32))


def angle_iron():
    """An L of two bars 10 mm thick, 0.1 m long each way, as one body."""
    outline = [(0, 0), (0.1, 0), (0.1, 0.01), (0.01, 0.01), (0.01, 0.1), (0, 0.1)]
    points = np.array([(x, y, z) for z in (0.0, 0.05) for x, y in outline])
    caps = [(0, 3, 2), (0, 2, 1), (0, 5, 4), (0, 4, 3)]
    upper = [(a + 6, c + 6, b + 6) for a, b, c in caps]
    sides = [t for k in range(6) for t in ((k, (k + 1) % 6, (k + 1) % 6 + 6), (k, (k + 1) % 6 + 6, k + 6))]
    return Mesh(points, np.array(caps + upper + sides, dtype=np.int32))


def tray():
    """A box of 0.2 x 0.2 x 0.05 m without a lid, its walls and bottom 5 mm thick."""
    outer = trimesh.creation.box((0.2, 0.2, 0.05))
    inner = trimesh.creation.box((0.19, 0.19, 0.05))
    inner.apply_translation((0, 0, 0.005))
    return mesh_of(trimesh.boolean.difference([outer, inner], engine="manifold"))


def holds(cloud, point):
    hull = ConvexHull(cloud)
    return bool((hull.equations[:, :3] @ point + hull.equations[:, 3] <= 1e-9).all())


def test_nothing_stands_in_a_tray_and_nothing_out_of_it():
    mesh = tray()
    parts = decompose(mesh, "tray", folder=None)
    assert parts.method == "coacd"
    hull = convex_hull(mesh.vertices)
    points = np.concatenate(parts.clouds)
    assert (points @ hull.normals.T - (hull.vertices @ hull.normals.T).max(axis=0)).max() < 1e-12
    for x, y, z in ((0, 0, 0), (0.08, 0.08, 0.02), (-0.08, 0, 0.0)):
        assert not any(holds(cloud, np.array([x, y, z])) for cloud in parts.clouds)
    for x, y, z in ((0, 0, -0.0225), (0.0975, 0, 0), (-0.0975, -0.09, 0.02)):
        assert any(holds(cloud, np.array([x, y, z])) for cloud in parts.clouds)


def test_pieces_are_those_that_touch_at_a_vertex_once_seams_are_closed():
    box = trimesh.creation.box((1, 1, 1))
    loose = Mesh(np.asarray(box.vertices)[np.asarray(box.faces).ravel()], np.arange(36, dtype=np.int32).reshape(-1, 3))
    assert len(components(loose)) == 12
    assert len(components(weld(loose))) == 1


@pytest.mark.slow
@pytest.mark.parametrize("flaw", ["open", "inside out", "mixed", "sheet", "double"])
def test_a_flawed_mesh_has_parts_within_its_hull(flaw):
    mesh = tray()
    faces = {
        "open": mesh.faces[2:],
        "inside out": mesh.faces[:, ::-1],
        "mixed": np.concatenate([mesh.faces[:5, ::-1], mesh.faces[5:]]),
        "sheet": mesh.faces[(abs(mesh.vertices[mesh.faces][..., :2]) < 0.096).all(axis=(1, 2))],
        "double": np.concatenate([mesh.faces, mesh.faces]),
    }[flaw]
    parts = decompose(Mesh(mesh.vertices, np.ascontiguousarray(faces)), flaw, threshold=0.3, folder=None)
    assert parts.method == "coacd"
    hull = convex_hull(mesh.vertices)
    points = np.concatenate(parts.clouds)
    assert (points @ hull.normals.T - (hull.vertices @ hull.normals.T).max(axis=0)).max() < 1e-9
    assert not any(holds(cloud, np.array([0.0, 0.0, 0.01])) for cloud in parts.clouds)


def test_where_coacd_gives_up_the_hulls_of_the_pieces_serve(monkeypatch):
    """Its voxels must be at least five; with fewer it throws, which ends its process and not ours."""
    monkeypatch.setattr(module, "OPEN", {"preprocess_mode": "on", "preprocess_resolution": 1})
    mesh = tray()
    parts = decompose(Mesh(mesh.vertices, mesh.faces[2:]), "gives up", folder=None)
    assert parts.method == "pieces"
    assert ConvexHull(parts.clouds[0]).volume == pytest.approx(0.2 * 0.2 * 0.05, rel=1e-6)


def slow_mesh(monkeypatch):
    """An open tray, cut so finely that CoACD takes minutes, with a second of processor time for it."""
    monkeypatch.setattr(module, "OPEN", {"preprocess_mode": "on", "preprocess_resolution": 1000})
    monkeypatch.setattr(module, "LONGEST_S", 1)
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    return Mesh(tray().vertices, tray().faces[2:])


def test_a_mesh_whose_parts_take_too_much_processor_time_is_refused_and_the_refusal_is_kept(monkeypatch, tmp_path):
    mesh = slow_mesh(monkeypatch)
    begun = module._children_s()
    with pytest.raises(MeshError, match=r"no_convex_parts: .* in 1 s of processor time") as refused:
        decompose(mesh, "endless", folder=tmp_path)
    assert refused.value.kind == "intrinsic"
    assert 0.9 < module._children_s() - begun < 2.5
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    monkeypatch.setattr(module, "_run", lambda *_: pytest.fail("tried once more"))
    with pytest.raises(MeshError, match="no_convex_parts"):
        decompose(mesh, "endless", folder=tmp_path)


@pytest.mark.parametrize(("code", "message"), [(3, "not installed"), (-9, "killed")])
def test_a_machine_that_cannot_cut_is_not_taken_for_a_mesh_that_cannot_be_cut(monkeypatch, code, message):
    monkeypatch.setattr(module.subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], code))
    with pytest.raises(MachineError, match=message):
        decompose(angle_iron(), f"machine {code}", folder=None)


SCRIPT = """
import os, sys, hashlib
os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: int(sys.argv[1])]))
import numpy as np
from schemas.scene.shape import Mesh
from schemas.job.assets import ProceduralSource
from workers.assets.builtin.make import make_asset
from workers.physics.convex_parts import decompose
for category in sys.argv[2:]:
    mesh = make_asset(category, ProceduralSource(source="procedural"), 1, 600.0).shape.mesh
    parts = decompose(mesh, category, 0.2, None)
    print(category, len(parts.clouds), hashlib.sha256(b"".join(c.tobytes() + b"|" for c in parts.clouds)).hexdigest())
"""


@pytest.mark.slow
def test_parts_are_the_same_bytes_on_one_core_and_two_and_after_other_meshes():
    """Without the variable that tells OpenMP to use one thread, too."""
    told = {**os.environ, "PYTHONPATH": str(ROOT)}
    free = {key: value for key, value in told.items() if key != "OMP_NUM_THREADS"}

    def run(environment, *arguments):
        command = [sys.executable, "-c", SCRIPT, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, env=environment)
        return sorted(done.stdout.splitlines())

    first = run(told, "1", "laptop", "camera")
    assert first[0].startswith("camera") and int(first[0].split()[1]) > 2
    assert run(free, "2", "camera", "laptop") == first
