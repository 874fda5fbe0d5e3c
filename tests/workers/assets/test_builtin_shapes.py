"""Every built-in category over many instances: closed, faultless, standing, of the right size and form, the same for ever."""

import functools
import math
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from shapely.geometry import Polygon

from schemas.job.assets import CATEGORIES, ProceduralSource, instance_id
from schemas.scene.shape import Mesh
from tests.workers.door.oracles import faulty_rays, hits, support_margin, welded
from workers.assets.builtin import box, camera, closed_vessels, laptop, open_vessels, table
from workers.assets.builtin.make import make_asset, make_model, shape_digest
from workers.assets.builtin.solid import Solid, union
from workers.assets.builtin.sweeps import INSIDE, OUTSIDE
from workers.assets.winding import winding_of_closed

SOURCE = ProceduralSource(source="procedural")
EVERYTHING = (*CATEGORIES, "table")
FEW, MANY = range(6), range(6, 40)
REPOSITORY = Path(__file__).resolve().parents[3]

SIZES_M = {
    "bottle": (0.08, 0.37),
    "camera": (0.1, 0.25),
    "can": (0.06, 0.32),
    "jar": (0.1, 0.55),
    "laptop": (0.33, 0.7),
    "mug": (0.09, 0.22),
    "bowl": (0.15, 0.5),
    "box": (0.08, 0.75),
    "table": (1.2, 2.7),
}
"""Least and largest diagonal that such a thing has."""

DOWN = np.array([0.0, 0.0, -1.0])

asset = functools.cache(lambda category, index: make_asset(category, SOURCE, index, 600.0))


def points_of(solid: Solid, *surfaces: int):
    """Corners of the faces with these surface numbers."""
    return solid.vertices[solid.faces[np.isin(solid.surface, surfaces)]].reshape(-1, 3)


def check_body(category: str, index: int) -> trimesh.Trimesh:
    """One closed body without a fault, with the holes of its kind, that stands on a flat base and weighs as trimesh says."""
    one = asset(category, index)
    whole = welded(one.shape)
    assert whole.is_watertight and whole.is_winding_consistent and whole.volume > 0 and whole.body_count == 1
    assert one.volume_m3 == pytest.approx(whole.volume, rel=1e-9)
    assert faulty_rays(whole.vertices, whole.faces, np.random.default_rng(index), 25) == 0, "overlaps, or lies inside"
    genus = 1 - whole.euler_number // 2
    assert genus in {"mug": (1,), "jar": (0, 2), "table": range(99)}.get(category, (0,)), "a handle, two ears, or none"
    assert support_margin(whole) > 0.004
    whole.density = 600.0
    assert one.mass.com == pytest.approx(whole.center_mass, abs=1e-9)
    assert one.mass.inertia == pytest.approx(whole.moment_inertia, rel=1e-6, abs=1e-12)
    if category in ("mug", "bowl", "jar"):
        assert whole.volume < 0.6 * whole.convex_hull.volume, "it is hollow"
    return whole


def check_asset(category: str, index: int) -> None:
    """Its size, its frame, its normals, its pictures and its faces."""
    one, limits = asset(category, index), SIZES_M[category]
    assert wound_wrongly(make_model(category, 0, index).solid) == 0
    size = float(np.linalg.norm(one.extents_m))
    metric = make_asset(category, SOURCE.model_copy(update={"size": "metric"}), index, 600.0)
    if category == "table":
        assert one.scale == 1.0, "whatever the size of the objects is"
    else:
        assert size == pytest.approx(0.25, abs=1e-9)
        assert float(np.linalg.norm(metric.extents_m)) == pytest.approx(size / one.scale, rel=1e-9)
    assert limits[0] < size / one.scale < limits[1]
    assert one.shape.bounds.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    source = make_model(category, 0, index).solid.vertices * one.scale
    placed = source @ one.T_source_to_object[:3, :3].T + one.T_source_to_object[:3, 3]
    assert placed.min(axis=0) == pytest.approx(one.shape.bounds[0], abs=1e-12)
    assert len(one.shape.faces) <= (3000 if category == "table" else 15_000)
    for part in one.shape.parts:
        a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        area = np.linalg.norm(across, axis=1)
        assert part.normals is not None
        cosine = (across[:, None] * part.normals[part.faces]).sum(axis=2) / np.maximum(area, 1e-300)[:, None]
        assert np.linalg.norm(part.normals, axis=1) == pytest.approx(np.ones(len(part.normals)))
        assert cosine[area > 1e-9].min() > 0.2, part.name
        assert part.uv is None or np.isfinite(part.uv).all()
        assert part.material.texture is None or (part.uv is not None and max(part.material.texture.shape[:2]) <= 256)


def check_lofts(category: str, index: int) -> None:
    """Lofts reach as far as the shape; no profile crosses itself, and no handle folds at its bends."""
    one = asset(category, index)
    if one.lofted is None:
        return
    if category in ("bottle", "can", "mug", "laptop"):
        points = np.concatenate([loft.rings.reshape(-1, 3) for loft in one.lofted.lofts])
        assert points.min(axis=0) == pytest.approx(one.shape.bounds[0], abs=1e-12)
        assert points.max(axis=0) == pytest.approx(one.shape.bounds[1], abs=1e-12)
    for loft in one.lofted.lofts:
        for profile in loft.profiles if loft.profiles is not None else ():
            assert Polygon(profile).is_valid
        if category in ("mug", "jar") and loft.profiles is None:
            along = np.diff(loft.rings, axis=0)  # from each ring to the next, at each place around
            middle = np.diff(loft.rings.mean(axis=1), axis=0)[:, None]
            assert ((along * middle).sum(axis=2) > 0).all(), "where it folds, its inner side runs back"


def wound_wrongly(solid: Solid) -> int:
    """Faces of a closed body that do not have its inside behind them, once, and nothing before them."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    large = area > 1e-10
    normals, middles = across[large] / area[large, None], (a + b + c)[large] / 3.0
    inside, before = (
        winding_of_closed(middles + side * 2e-7 * normals, Mesh(solid.vertices, solid.faces.astype(np.int32)))
        for side in (-1.0, 1.0)
    )
    return int(((inside != 1) | (before != 0)).sum())


def bottom(solid: Solid) -> tuple[float, float]:
    """Heights at which a ray down through the mouth of an open vessel meets the inner and the outer side of the bottom."""
    top = float(solid.vertices[:, 2].max())
    distances, sides = hits(solid.vertices, solid.faces, np.array([1e-4, 2e-4, top + 1.0]), DOWN)
    assert sides.tolist() == [-1.0, 1.0]
    inner, outer = (top + 1.0 - float(distance) for distance in distances)
    assert 0.002 < inner - outer < 0.012, "as thick as a wall"
    return inner, outer


def check_bottle(solid: Solid) -> None:
    """It narrows from its body to its neck and is closed by a cap."""
    height, cap, body = (
        solid.vertices[:, 2].max(),
        points_of(solid, closed_vessels.CAP),
        points_of(solid, closed_vessels.BODY, closed_vessels.LABEL),
    )
    assert cap[:, 2].max() == height and cap[:, 2].min() > 0.45 * height
    assert np.ptp(cap[:, 0]) <= np.ptp(body[:, 0]) * 1.001
    neck = np.hypot(*body[body[:, 2] > body[:, 2].max() - 0.02 * height][:, :2].T)
    assert neck.max() < 0.5 * np.ptp(body[:, 0])


def check_bowl(solid: Solid) -> None:
    """It is wider than high, and a foot ring lifts its bottom."""
    assert bottom(solid)[1] > 0.0
    assert np.ptp(solid.vertices[:, 0]) > 1.4 * solid.vertices[:, 2].max()


def check_box(solid: Solid) -> None:
    """It fills most of its bounding box, with a seam: some points lie half a millimetre deeper than the convex hull."""
    whole = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert 0.55 < whole.volume / whole.bounding_box.volume < 0.9999
    hull = whole.convex_hull
    offset = -np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
    depth = -(whole.vertices @ hull.face_normals.T + offset).max(axis=1)
    assert depth.max() > 0.0005


def check_camera(solid: Solid) -> None:
    """The lens stands out in front, its glass behind its rim; the display is behind; only the body touches the ground."""
    lens, glass, shell, display = (
        points_of(solid, part) for part in (camera.LENS, camera.GLASS, camera.SHELL, camera.DISPLAY)
    )
    assert lens[:, 1].min() < min(shell[:, 1].min() - 0.004, glass[:, 1].min())
    assert display[:, 1].max() > shell[:, 1].max()
    lowest = solid.vertices[:, 2].min()
    touching = solid.surface[(solid.vertices[solid.faces][:, :, 2] == lowest).any(axis=1)]
    assert set(touching.tolist()) == {camera.SHELL} and lens[:, 2].min() > 0.001


def check_can(solid: Solid) -> None:
    """It is round, and its lid lies below its rim unless it has a cap."""
    extent, top = np.ptp(solid.vertices, axis=0), solid.vertices[:, 2].max()
    assert extent[0] == pytest.approx(extent[1], rel=1e-9) and (solid.surface == closed_vessels.SIDE).any()
    distances, _ = hits(solid.vertices, solid.faces, np.array([1e-4, 2e-4, 1.0]), DOWN)
    middle = 1.0 - distances[0]
    assert middle == pytest.approx(top) if (solid.surface == closed_vessels.TOP).any() else middle < top - 0.0008


def check_jar(solid: Solid) -> None:
    """It is open down to its bottom and has a neck."""
    assert bottom(solid)[1] < 0.004
    points = points_of(solid, OUTSIDE)
    radius, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2] / points[:, 2].max()
    assert radius[(z > 0.78) & (z < 0.93)].min() < 0.97 * radius[z < 0.75].max()


def check_laptop(solid: Solid) -> None:
    """The screen faces the user, at -y, and leans back by 5 to 40 degrees."""
    a, b, c = (solid.vertices[solid.faces[solid.surface == laptop.SCREEN][:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    areas = np.linalg.norm(across, axis=1)
    facing = across[areas.argmax()] / areas.max()
    assert facing[0] == pytest.approx(0, abs=1e-9) and facing[1] < 0
    assert 5.0 <= math.degrees(math.asin(facing[2])) <= 40.0


def check_mug(solid: Solid) -> None:
    """It is open down to its bottom; the handle stays out of the hollow and leaves room for a finger."""
    inner, outer = bottom(solid)
    height = solid.vertices[:, 2].max()
    assert 0.0 <= outer < 0.003 and inner < 0.15 * height
    handle, hollow = points_of(solid, open_vessels.HANDLE), points_of(solid, INSIDE)
    for low, high in ((0.1, 0.5), (0.5, 0.9)):  # compare radii at like heights
        at = [p[(p[:, 2] >= low * height) & (p[:, 2] <= high * height)] for p in (handle, hollow)]
        if len(at[0]) and len(at[1]):
            assert np.hypot(*at[0][:, :2].T).min() > np.hypot(*at[1][:, :2].T).max() - 0.012
    middle = 0.5 * (handle[:, 2].min() + handle[:, 2].max())
    distances, sides = hits(solid.vertices, solid.faces, np.array([1.0, 1e-5, middle]), np.array([-1.0, 0.0, 0.0]))
    assert sides[:3].tolist() == [-1, 1, -1]
    assert distances[2] - distances[1] > 0.012, "from the inside of the handle to the wall"


def check_table(solid: Solid) -> None:
    """The top is level to the last bit, of the right thickness, and under every place of an object."""
    top, size = solid.vertices[:, 2].max(), np.ptp(solid.vertices, axis=0)
    assert 0.45 <= top <= 0.9 and 0.9 <= size[0] <= 1.8 and 0.8 <= size[1] <= 1.8
    for x in (-0.2501, 0.0003, 0.2502):
        for y in (-0.2487, 0.0007, 0.2493):  # off the lines along which round tops are cut
            distances, sides = hits(solid.vertices, solid.faces, np.array([x, y, 2.0]), DOWN)
            assert 2.0 - distances[0] == pytest.approx(top, abs=1e-12)
            assert sides[:2].tolist() == [-1, 1] and distances[1] - distances[0] >= 0.0149
    flat = solid.vertices[solid.vertices[:, 2] > top - 1e-6]
    assert len(flat) > 8 and set(flat[:, 2]) == {top}


FORMS: Mapping[str, Callable[[Solid], None]] = {
    "bottle": check_bottle,
    "bowl": check_bowl,
    "box": check_box,
    "camera": check_camera,
    "can": check_can,
    "jar": check_jar,
    "laptop": check_laptop,
    "mug": check_mug,
    "table": check_table,
}


@pytest.mark.parametrize("instances", [FEW, pytest.param(MANY, marks=pytest.mark.slow)], ids=["few", "many"])
@pytest.mark.parametrize("category", EVERYTHING)
def test_every_instance_is_a_faultless_body_of_the_size_and_form_of_its_kind(category, instances):
    for index in instances:
        check_body(category, index)
        check_asset(category, index)
        check_lofts(category, index)
        FORMS[category](make_model(category, 0, index).solid)
    assert len({asset(category, index).sha256 for index in instances}) == len(instances), "instances differ"


@pytest.mark.minute
@pytest.mark.parametrize("category", ["jar", "mug"])
def test_no_wall_of_a_vessel_crosses_itself_and_no_handle_folds(category):
    for index in range(100, 250):
        check_lofts(category, index)


def test_no_lens_folds_however_short_it_is():
    for kind, height in ((0, 0.066), (1, 0.062), (2, 0.049)):
        for seed in range(40):
            lens = camera._lens(np.random.default_rng(seed), (height / 0.54, 0.3 * height / 0.54, height), kind)
            assert wound_wrongly(lens) == 0, f"kind {kind}, seed {seed}"


def test_the_lid_overhangs_the_box_and_a_ribbon_goes_all_around():
    ribbons = 0
    for seed in range(10):
        solid = box.make_lidded(np.random.default_rng(seed)).solid
        lid, side, ribbon = (points_of(solid, number) for number in (box.LID, box.SIDE, box.EXTRA))
        assert np.ptp(lid[:, 0]) > np.ptp(side[:, 0]) + 0.002
        assert lid[:, 2].min() > 0.4 * side[:, 2].max()
        if len(ribbon):
            ribbons += 1
            assert np.ptp(ribbon[:, 0]) > np.ptp(lid[:, 0])
            assert ribbon[:, 2].min() == 0.0 and ribbon[:, 2].max() > lid[:, 2].max()
        mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
        assert mesh.is_volume and mesh.body_count == 1
    assert 0 < ribbons < 10


@pytest.mark.parametrize("round_top", [False, True])
def test_a_stand_reaches_from_the_ground_into_the_top_and_stays_below_it(round_top):
    plan = table.TableSize(1.2, 1.0, 0.03, 0.74, round_top)
    for seed in range(30):
        joined = union(table.make_base(np.random.default_rng(seed), plan))
        low, high = joined.vertices.min(axis=0), joined.vertices.max(axis=0)
        assert low[2] == 0.0 and plan.under < high[2] < plan.height
        assert (np.maximum(-low, high)[:2] <= [0.5 * plan.width, 0.5 * plan.depth]).all(), seed
        assert set(joined.surface) <= {table.LEG, table.FRAME}


def in_another_process(code: str, **environment: str) -> subprocess.CompletedProcess:
    head = "from workers.assets.builtin.make import *; from schemas.job.assets import CATEGORIES;"
    env = {**os.environ, "PYTHONWARNINGS": "ignore", **environment}
    return subprocess.run([sys.executable, "-c", head + code], capture_output=True, text=True, cwd=REPOSITORY, env=env)


@pytest.mark.minute
def test_the_same_instance_comes_again_from_another_process_with_another_hash_seed():
    code = (
        "s = ProceduralSource(source='procedural');"
        "print(' '.join(make_asset(c, s, 5, 600.0).sha256 for c in (*CATEGORIES, 'table')))"
    )
    out = in_another_process(code, PYTHONHASHSEED="77", OMP_NUM_THREADS="3").stdout
    assert out.split() == [asset(category, 5).sha256 for category in EVERYTHING]


@pytest.mark.minute
def test_shapes_have_the_same_bits_with_and_without_wide_vector_instructions():
    """Dispatch in numpy differs with AVX-512 and AVX2 off; coordinates do not."""
    code = "print(' '.join(str(hash(make_model(c, 0, 5).solid.vertices.tobytes())) for c in (*CATEGORIES, 'table')))"
    digests = []
    for off in ("", "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX2 FMA3"):
        run = in_another_process(code, NPY_DISABLE_CPU_FEATURES=off, PYTHONHASHSEED="0")
        if run.returncode and "CPU" in run.stderr:
            pytest.skip(f"numpy refuses to run without these: {run.stderr[-200:]}")
        assert run.returncode == 0, run.stderr
        digests.append(run.stdout)
    assert digests[0] == digests[1]


def test_another_seed_gives_other_shapes_and_ids_sort_like_their_numbers():
    assert instance_id("mug", 0, 9) == "mug-0-000009" < instance_id("mug", 0, 10)
    assert make_asset("mug", SOURCE.model_copy(update={"seed": 1}), 5, 600.0).sha256 != asset("mug", 5).sha256


def test_the_digest_changes_with_one_vertex_one_pixel_or_one_colour():
    shape = asset("can", 0).shape
    first, *others = shape.parts
    moved, painted = first.vertices.copy(), first.material.texture.copy()
    moved[0, 0] += 1e-15
    painted[0, 0, 0] ^= 1
    changes = [
        replace(first, vertices=moved),
        replace(first, material=replace(first.material, texture=painted)),
        replace(first, material=replace(first.material, roughness=0.123)),
    ]
    digests = {shape_digest(replace(shape, parts=(change, *others))) for change in changes}
    assert len(digests | {asset("can", 0).sha256}) == 4
