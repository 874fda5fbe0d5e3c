"""Convex parts of built-in shapes, by their making, and of meshes from outside, by halving; how they are kept.

Partitions are held against shapely, parts against manifold3d's booleans, rays and Qhull.
"""

import hashlib
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import shapely
import trimesh
from scipy.spatial import ConvexHull

from schemas.job.assets import CATEGORIES, ProceduralSource
from schemas.scene.shape import Mesh
from tests.kit.contacts import mesh_of
from tests.kit.shapes import box
from workers.assets.builtin.make import make_asset
from workers.geometry.distance import distance_to_mesh
from workers.geometry.hull import convex_hull, wrap
from workers.geometry.lathe_decomposition import COARSE
from workers.geometry.mesh import mesh_of as surface_of
from workers.geometry.mesh import weld
from workers.geometry.outlines import partition_outlines
from workers.physics import convex_parts as module
from workers.physics.convex_parts import decompose, parts_of

ROOT = Path(__file__).resolve().parents[3]


def built_in(category, number):
    return make_asset(category, ProceduralSource(source="procedural"), number, 600.0)


# ---------------------------------------------------------------------------------------------- outlines

COMB = np.array([(x, y) for k in range(5) for x, y in ((k, 0.0), (k + 0.5, 0.0), (k + 0.5, -2.0), (k + 1.0, -2.0))])
OUTLINES = {
    "l": np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], dtype=np.float64),
    "star": np.array([(np.cos(k * np.pi / 7) * r, np.sin(k * np.pi / 7) * r) for k, r in enumerate([2.0, 0.7] * 7)]),
    "comb": np.concatenate([COMB, [(5.0, 1.0), (0.0, 1.0)]]),
}


def are_convex_tiles_of(outline, cells) -> bool:
    tiles, whole = [shapely.Polygon(outline[cell]) for cell in cells], shapely.Polygon(outline)
    union = shapely.union_all([shapely.set_precision(tile, 1e-9) for tile in tiles])
    assert sum(tile.area for tile in tiles) == pytest.approx(whole.area, rel=1e-12)
    convex = all(tile.is_valid and tile.convex_hull.area - tile.area < 1e-12 for tile in tiles)
    return convex and union.symmetric_difference(whole).area < 1e-7


def test_cells_are_convex_and_tile_the_outline_also_of_outlines_that_are_cut_alike():
    """Of the last two, the second has a reflex corner where the first is straight."""
    for name, outline in OUTLINES.items():
        assert are_convex_tiles_of(outline, partition_outlines(outline[None], 0.0)), name
    alike = np.array([[(0, 0), (2, 0), corner, (2, 2), (0, 2)] for corner in ((2, 1), (1, 1))], dtype=np.float64)
    cells = partition_outlines(alike, 1e-9)
    assert len(cells) == 2 and all(are_convex_tiles_of(outline, cells) for outline in alike)


# ---------------------------------------------------------------------------------------------- built-in shapes

AIM_M = 5e-5
"""Largest distance that parts of a shape 0.25 m along its diagonal may stand out, or leave uncovered."""

TWISTED_M = 1.7e-4
"""Soft squares that turn into circles have twisted facets, which may stand out by four times the tolerance."""

TWISTED = [("bowl", 2), ("jar", 0), ("bottle", 1)]
ROUND = [("mug", 2), ("bowl", 3), ("jar", 1), ("can", 0), ("bottle", 0)]
ANGULAR = [("box", 4), ("laptop", 1), ("camera", 0)]
OUTLINES_THAT_MEET = [("camera", 100026), ("camera", 500199), ("box", 500231)]
"""Sides that lie on one another but for the last bits, or cross: one camera of a hundred, and fewer boxes."""


def outside_m(points, mesh):
    """How far points are outside of a closed mesh at most, by rays."""
    away = points[~trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).contains(points)]
    return float(distance_to_mesh(away, mesh)[0].max(initial=0.0))


def middles_of(parts):
    """At most 4,000 of the middles of the parts' faces and of their edges."""
    points = []
    for part in parts:
        corners = part[ConvexHull(part).simplices]
        points += [corners.mean(axis=1), corners[:, :2].mean(axis=1), corners[:, 1:].mean(axis=1)]
    return np.random.default_rng(0).permutation(np.concatenate(points))[:4000]


def uncovered_m(parts, points):
    """How far points lie outside of all parts, at most."""
    planes = [ConvexHull(part).equations for part in parts]
    away = [(points @ plane[:, :3].T + plane[:, 3]).max(axis=1) for plane in planes]
    return float(np.min(away, axis=0).max())


@pytest.mark.parametrize(
    ("category", "number"),
    [
        ("mug", 2),
        ("camera", 0),
        *(pytest.param(*one, marks=pytest.mark.minute) for one in (*ROUND[1:], *ANGULAR[:2], *TWISTED)),
    ],
)
def test_parts_of_a_built_in_shape_are_the_shape(category, number):
    asset = built_in(category, number)
    mesh, parts = weld(asset.shape.mesh), parts_of(asset)
    assert outside_m(middles_of(parts), mesh) <= (TWISTED_M if (category, number) in TWISTED else AIM_M)
    inside, _ = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), 1500, seed=0)
    assert uncovered_m(parts, np.concatenate([inside, mesh.vertices])) <= AIM_M
    assert ConvexHull(np.concatenate(parts)).volume == pytest.approx(ConvexHull(mesh.vertices).volume, rel=1e-12)


def test_built_in_shapes_are_not_halved(monkeypatch):
    monkeypatch.setattr(module, "_decompose", lambda *_: pytest.fail("halved"))
    for category in CATEGORIES:
        assert len(parts_of(built_in(category, 7))) > 1


def test_a_shape_whose_outlines_meet_or_cross_has_parts_all_the_same():
    for category, number in OUTLINES_THAT_MEET:
        asset = built_in(category, number)
        parts = parts_of(asset)
        assert len(parts) > (category == "camera")
        for bound in (np.min, np.max):
            corners = bound(np.concatenate(parts), axis=0)
            assert corners == pytest.approx(bound(asset.shape.vertices, axis=0), abs=1e-9)


@pytest.mark.minute
def test_a_solid_that_large_tolerances_leave_with_more_faces_is_made_coarser_in_turn_and_it_ends(monkeypatch):
    """What wraps an open ring: at once by ever larger tolerances it never has fewer than 1,796 faces."""
    ring = trimesh.creation.annulus(0.06, 0.1, 0.1, sections=96)
    solid, _ = wrap(weld(Mesh(np.ascontiguousarray(ring.vertices), ring.faces[ring.face_normals[:, 2] < 0.5])))
    step_m, surface = 5e-4, surface_of(solid)
    assert min(solid.simplify(step_m * 2**k).num_tri() for k in range(20)) > 1500
    for most, ends in ((1500, 1500), (4, 1500)):
        monkeypatch.setattr(module, "MOST_FACES", most)
        simpler, moved_m = module._simplified(solid, step_m)
        assert simpler.num_tri() <= ends
        assert distance_to_mesh(surface_of(simpler).vertices, surface)[0].max() <= moved_m


def test_coarser_parts_are_fewer_and_reach_out_no_further_than_they_may():
    """A hundredth of 0.25 m."""
    for category in ("mug", "jar"):
        asset = built_in(category, 1)
        coarse = parts_of(asset, share=COARSE)
        assert len(coarse) < 0.5 * len(parts_of(asset))
        middles = np.concatenate([(part[:-1] + part[1:]) / 2 for part in coarse])
        assert outside_m(middles, asset.shape.mesh) < 2.5e-3


# ---------------------------------------------------------------------------------------------- meshes from outside


def digest_of(parts):
    return hashlib.sha256(b"".join(cloud.tobytes() + b"|" for cloud in parts.clouds)).hexdigest()


def angle_iron():
    """An L of two bars 10 mm thick, 0.1 m long each way, as one body."""
    outline = shapely.Polygon([(0, 0), (0.1, 0), (0.1, 0.01), (0.01, 0.01), (0.01, 0.1), (0, 0.1)])
    return mesh_of(trimesh.creation.extrude_polygon(outline, 0.05))


def tray():
    """A box of 0.2 x 0.2 x 0.05 m without a lid, its walls and bottom 5 mm thick."""
    return mesh_of(trimesh.boolean.difference([box(0.2, 0.2, 0.05), box(0.19, 0.19, 0.05, (0, 0, 0.005))]))


OPEN_TRAY = Mesh(tray().vertices, tray().faces[2:])


def holds(parts, point) -> bool:
    return uncovered_m(parts.clouds, np.array([point], dtype=np.float64)) <= 1e-9


def beyond_m(parts, mesh) -> float:
    """How far parts reach out of the mesh's hull."""
    hull = convex_hull(mesh.vertices)
    return float((np.concatenate(parts.clouds) @ hull.normals.T - (hull.vertices @ hull.normals.T).max(axis=0)).max())


@pytest.mark.parametrize(
    "flaw",
    ["inside out", "double", *(pytest.param(one, marks=pytest.mark.minute) for one in ("open", "mixed", "sheet"))],
)
def test_a_flawed_mesh_has_parts_within_its_hull_and_nothing_in_its_hollow(flaw):
    mesh = tray()
    faces = {
        "open": mesh.faces[2:],
        "inside out": mesh.faces[:, ::-1],
        "mixed": np.concatenate([mesh.faces[:5, ::-1], mesh.faces[5:]]),
        "sheet": mesh.faces[(abs(mesh.vertices[mesh.faces][..., :2]) < 0.096).all(axis=(1, 2))],
        "double": np.concatenate([mesh.faces, mesh.faces]),
    }[flaw]
    parts = decompose(Mesh(mesh.vertices, np.ascontiguousarray(faces)), flaw, folder=None)
    assert len(parts.clouds) > 4 and all(ConvexHull(cloud).volume > 0.0 for cloud in parts.clouds)
    assert beyond_m(parts, mesh) < 1e-9
    assert not holds(parts, (0.0, 0.0, 0.01))


def cup(sections):
    """A drinking glass 0.12 m high with a wall of 3 mm, as manifold3d cuts one cylinder out of another."""
    outer = manifold3d.Manifold.cylinder(0.12, 0.03, 0.04, sections)
    return of_solid(outer - manifold3d.Manifold.cylinder(0.12, 0.027, 0.037, sections).translate((0.0, 0.0, 0.004)))


def of_solid(solid):
    mesh = solid.to_mesh64()
    return Mesh(np.array(mesh.vert_properties)[:, :3].copy(), np.array(mesh.tri_verts, dtype=np.int32))


def joined(*meshes):
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])[:-1]
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.int32))


def slab_with_open_pegs():
    """A slab of 0.2 m and sixteen pegs of 1 cm on it, each without its bottom."""
    peg, at = mesh_of(box(0.01, 0.01, 0.01)), [(x, y) for x in range(4) for y in range(4)]
    peg = Mesh(peg.vertices, peg.faces[~(peg.vertices[peg.faces][..., 2] < 0.0).all(axis=1)])
    pegs = [Mesh(peg.vertices + np.array((0.04 * x - 0.06, 0.04 * y - 0.06, 0.0101)), peg.faces) for x, y in at]
    return joined(mesh_of(box(0.2, 0.2, 0.01)), *pegs)


def thin_angle():
    """Two plates of 0.2 m and 0.02 mm."""
    return of_solid(manifold3d.Manifold.cube((0.2, 0.2, 2e-5)) + manifold3d.Manifold.cube((2e-5, 0.2, 0.2)))


def fine_torus():
    return mesh_of(trimesh.creation.torus(0.05, 0.02, major_sections=160, minor_sections=60))


SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=np.float64)
TURN = trimesh.transformations.random_rotation_matrix(np.random.default_rng(3).random(3))[:3, :3]
HOLLOWS = {
    **{f"cup of {n}": (partial(cup, n), (6, 64)) for n in (24, 32, 48, 64, 257)},
    "cup aslant": (lambda: Mesh(np.ascontiguousarray(cup(48).vertices @ TURN), cup(48).faces), (6, 64)),
    "pegs": (slab_with_open_pegs, (17, 17)),
    "fine torus": (fine_torus, (6, 64)),
    "angle thinner than the tolerance": (thin_angle, (2, 2)),
    "flat sheet": (lambda: Mesh(SQUARE, np.array([(0, 1, 2), (0, 2, 3)], np.int32)), (1, 1)),
}


QUICK = {"cup of 48", "pegs", "angle thinner than the tolerance", "flat sheet"}


@pytest.mark.parametrize(
    "hollow", [one if one in QUICK else pytest.param(one, marks=pytest.mark.minute) for one in HOLLOWS]
)
def test_every_mesh_has_parts_and_they_fill_no_deeper_hollow_than_they_say(hollow):
    """Asked for is a fortieth of the longest side; what sticks out of the mesh is measured by rays."""
    make, (fewest, most) = HOLLOWS[hollow]
    mesh = make()
    begun = time.process_time()
    parts = decompose(mesh, hollow, folder=None)
    assert time.process_time() - begun < 10.0
    assert fewest <= len(parts.clouds) <= most
    assert beyond_m(parts, mesh) < 1e-9 or hollow == "flat sheet"  # which has no hull
    size_m = float(np.ptp(mesh.vertices, axis=0).max())
    assert parts.depth_m <= (0.025 + 2 * module.SIMPLER) * size_m
    if trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight:
        assert outside_m(middles_of(parts.clouds), mesh) <= parts.depth_m + 1e-9


def test_parts_come_from_memory_then_from_the_folder_and_a_torn_file_is_made_again(tmp_path, monkeypatch):
    made = decompose(angle_iron(), "kept", folder=tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()

    def read_again():
        module._kept.cache.clear()
        return decompose(angle_iron(), "kept", folder=tmp_path)

    with monkeypatch.context() as patch:
        patch.setattr(module, "_decompose", lambda *_: pytest.fail("made once more"))
        assert digest_of(decompose(angle_iron(), "kept", folder=None)) == digest_of(made), "from memory"
        again = read_again()
        assert (again.depth_m, digest_of(again)) == (made.depth_m, digest_of(made))
        assert not again.clouds[0].flags.writeable
    for torn in (whole[:-7], b"", whole[:200] + b"x" + whole[201:]):
        path.write_bytes(torn)
        assert digest_of(read_again()) == digest_of(made)
        assert path.read_bytes().endswith(whole.rstrip(b"\n")[-500:] + b"\n"), "kept again"


SCRIPT = """
import os, sys, hashlib
os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: int(sys.argv[1])]))
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
