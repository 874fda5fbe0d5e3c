"""Convex parts, against bodies whose parts are known, and in processes that must agree."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from schemas.errors import MachineError, MeshError
from schemas.job.assets import ProceduralSource
from schemas.job.job import Run
from schemas.scene.shape import Mesh
from workers.assets.builtin.make import make_asset
from workers.geometry.hull import convex_hull
from workers.geometry.mesh import components, concavity_m, weld
from workers.physics import convex_parts as module
from workers.physics.convex_parts import PartsCache, decompose

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


def test_a_convex_body_is_its_own_part():
    for body in (trimesh.creation.box((0.1, 0.2, 0.3)), trimesh.creation.icosphere(3, 0.05)):
        parts = decompose(mesh_of(body), "convex", folder=None)
        assert parts.method == "convex"
        assert len(parts.clouds) == 1
        assert (parts.clouds[0] == convex_hull(np.asarray(body.vertices)).vertices).all()


def test_an_l_is_two_bars():
    parts = decompose(angle_iron(), "l", folder=None)
    assert parts.method == "coacd"
    assert len(parts.clouds) == 2
    solid = sum(ConvexHull(cloud).volume for cloud in parts.clouds)
    assert solid == pytest.approx((0.1 * 0.01 + 0.09 * 0.01) * 0.05, rel=0.02)


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


@pytest.mark.parametrize("category", ["laptop", "bottle"])
def test_the_parts_of_a_shape_have_its_hull(category):
    mesh = make_asset(category, ProceduralSource(source="procedural"), 0, 600.0).shape.mesh
    points = np.concatenate(decompose(mesh, category, threshold=0.1, folder=None).clouds)
    assert ConvexHull(points).volume == pytest.approx(ConvexHull(mesh.vertices).volume, rel=1e-12)


def test_every_piece_is_cut_by_itself():
    balls = [trimesh.creation.icosphere(2, 0.02).apply_translation((x, 0, 0)) for x in (0.0, 0.03, 1.0)]
    parts = decompose(mesh_of(trimesh.util.concatenate(balls)), "balls", folder=None)
    assert parts.method == "convex"
    assert sorted(round(float(cloud[:, 0].mean()), 9) for cloud in parts.clouds) == [0.0, 0.03, 1.0]


def test_pieces_are_those_that_touch_at_a_vertex_once_seams_are_closed():
    box = trimesh.creation.box((1, 1, 1))
    loose = Mesh(np.asarray(box.vertices)[np.asarray(box.faces).ravel()], np.arange(36, dtype=np.int32).reshape(-1, 3))
    assert len(components(loose)) == 12
    assert len(components(weld(loose))) == 1


def test_a_dent_is_as_deep_as_it_is():
    mesh = tray()
    assert concavity_m(mesh) == pytest.approx(0.045, abs=1e-9)
    assert concavity_m(mesh_of(trimesh.creation.icosphere(3, 0.05))) < 1e-12
    flat = Mesh(np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], dtype=np.float64), np.array([(0, 1, 2)], dtype=np.int32))
    assert concavity_m(flat) < 1e-12


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


def test_a_flat_sheet_and_a_single_triangle_have_one_part():
    for points in ([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 0, 0), (1, 0, 0), (0, 1, 0.5)]):
        faces = np.array([(0, 1, 2), (0, 2, 3)][: len(points) - 2], dtype=np.int32)
        parts = decompose(Mesh(np.array(points, dtype=np.float64), faces), "flat", folder=None)
        assert (parts.method, len(parts.clouds)) == ("convex", 1)


def test_a_flat_sheet_that_is_not_convex_has_a_part_all_the_same():
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 0.2, 0), (0.2, 0.2, 0), (0.2, 1, 0), (0, 1, 0)], dtype=np.float64)
    faces = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)], dtype=np.int32)
    parts = decompose(Mesh(points, faces), "flat l", folder=None)
    assert np.ptp(np.concatenate(parts.clouds), axis=0) == pytest.approx([1, 1, 0], abs=1e-9)


def test_where_coacd_gives_up_the_hulls_of_the_pieces_serve(monkeypatch):
    """Its voxels must be at least five; with fewer it throws, which ends its process and not ours."""
    monkeypatch.setattr(module, "OPEN", {"preprocess_mode": "on", "preprocess_resolution": 1})
    mesh = tray()
    parts = decompose(Mesh(mesh.vertices, mesh.faces[2:]), "gives up", folder=None)
    assert parts.method == "pieces"
    assert ConvexHull(parts.clouds[0]).volume == pytest.approx(0.2 * 0.2 * 0.05, rel=1e-6)


SCRAPS = {
    "triangle": [(0, 0, 0.2), (0.01, 0, 0.2), (0, 0.01, 0.2)],
    "needle": [(0, 0, 0.2), (0.1, 1e-8, 0.2), (0.05, 0, 0.2 + 1e-8), (0.02, 1e-8, 0.2 - 1e-8)],
    "dust": [(0, 0, 0.2), (1e-15, 0, 0.2), (0, 1e-15, 0.2), (0, 0, 0.2 + 1e-15)],
}


@pytest.mark.parametrize("scrap", SCRAPS)
def test_a_loose_scrap_beside_a_body_has_a_part_with_a_hull_or_none(scrap):
    """A part without a hull ended the whole job: a body is built of the hulls of its parts."""
    body, points = angle_iron(), np.array(SCRAPS[scrap])
    start = len(body.vertices)
    faces = [(start, start + 1, start + 2), *([(start, start + 1, start + 3)] if len(points) > 3 else [])]
    mesh = Mesh(np.concatenate([body.vertices, points]), np.concatenate([body.faces, np.array(faces, dtype=np.int32)]))
    parts = decompose(mesh, scrap, folder=None)
    assert len(parts.clouds) >= 2
    hull = ConvexHull(mesh.vertices, qhull_options="Qt")
    for cloud in parts.clouds:
        convex_hull(cloud)
        assert (cloud @ hull.equations[:, :3].T + hull.equations[:, 3]).max() < 1e-7


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


def test_a_mesh_in_many_pieces_has_no_more_time_than_one_in_one(monkeypatch):
    mesh = slow_mesh(monkeypatch)
    monkeypatch.setattr(module, "LONGEST_S", 2)
    shifts = [np.array([k, 0.0, 0.0]) for k in range(5)]
    many = Mesh(
        np.concatenate([mesh.vertices + shift for shift in shifts]),
        np.concatenate([mesh.faces + k * len(mesh.vertices) for k in range(5)]).astype(np.int32),
    )
    begun = module._children_s()
    with pytest.raises(MeshError, match="no_convex_parts"):
        decompose(many, "many", folder=None)
    assert module._children_s() - begun < 4


def test_parts_are_looked_for_in_half_of_a_scene_s_time():
    assert Run().scene_timeout_s >= 2 * module.LONGEST_S


def test_where_coacd_has_too_little_memory_the_hulls_of_the_pieces_serve(monkeypatch):
    """With 400 MiB it can be loaded and cuts an L, but has no room for 400 voxels along each axis."""
    monkeypatch.setattr(module, "MEMORY_MB", 400)
    assert decompose(angle_iron(), "enough memory", folder=None).method == "coacd"
    monkeypatch.setattr(module, "OPEN", {"preprocess_mode": "on", "preprocess_resolution": 400})
    mesh = tray()
    assert decompose(Mesh(mesh.vertices, mesh.faces[2:]), "no memory", folder=None).method == "pieces"


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


def test_another_mesh_under_the_same_digest_is_another_mesh():
    """A digest may be that of a source file, which is the same at every scale."""
    small, large = angle_iron(), angle_iron()
    large = Mesh(large.vertices * 2.0, large.faces)
    assert np.ptp(np.concatenate(decompose(small, "same").clouds), axis=0).max() == pytest.approx(0.1)
    assert np.ptp(np.concatenate(decompose(large, "same").clouds), axis=0).max() == pytest.approx(0.2)
