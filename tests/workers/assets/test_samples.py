"""Shape targets: distances and insides by brute force and an exact solid, areas by counting, and what a shape cannot have."""

import dataclasses
import functools
import io
import zipfile

import manifold3d
import numpy as np
import pytest
import trimesh
from scipy.stats import chisquare

from schemas.job.assets import CATEGORIES, ProceduralSource
from schemas.job.views import Targets
from schemas.scene.shape import Asset, Material, Mesh, Part, Shape
from tests.judge.nearest import distances_to_faces
from tests.judge.nearest import winding_numbers as exact_winding_numbers
from tests.kit.shapes import asset_of, box
from tests.workers.door.oracles import welded
from workers.assets.builtin.make import make_asset
from workers.assets.samples import draw_samples, encode_samples
from workers.assets.winding import winding_numbers
from workers.scene.rows import stored_samples

BOTH = Targets(shape=("surface", "volume"), points=4_000)
FEW = ("camera", "jar", "mug")
EVERYTHING = [pytest.param(name, marks=() if name in FEW else pytest.mark.slow) for name in (*CATEGORIES, "table")]
SOURCE, METRIC = (ProceduralSource(source="procedural", size=size) for size in ("article", "metric"))

asset = functools.cache(lambda category, index=3: make_asset(category, SOURCE, index, 600.0))
samples = functools.cache(lambda category: draw_samples(asset(category), BOTH).arrays)


class Ends(np.random.Generator):
    """Draws one end of every range; what is counted or chosen is drawn as ever."""

    def __init__(self, stream, upper) -> None:
        super().__init__(np.random.PCG64(stream))
        self.upper = upper

    def uniform(self, low=0.0, high=1.0, size=None):
        return 0.0 * super().uniform(low, high, size) + (high if self.upper else low)


def asset_at(category: str, upper: bool) -> Asset:
    """The least or the largest of a category, in true metres."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(np.random, "default_rng", lambda stream: Ends(stream, upper))
        return make_asset(category, METRIC, 1, 600.0)  # box 0 is a tin: those below 24 mm of height overlap themselves


def open_asset(mesh: trimesh.Trimesh) -> Asset:
    return dataclasses.replace(
        asset_of(box(1, 1, 1)), shape=Shape((Part("part", mesh.vertices, mesh.faces),)), watertight=False
    )


def inside_solid(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """[N]: around which points [N, 3] a cube of 0.6 micrometres meets the solid, by booleans that are exact to rounding."""
    solid = manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))
    assert solid.status() == manifold3d.Error.NoError
    cube = manifold3d.Manifold.cube((6e-7, 6e-7, 6e-7), True)
    cubes = manifold3d.Manifold.compose([cube.translate(point) for point in points])
    met = (cubes ^ solid).to_mesh64().vert_properties[:, :3]
    apart = np.abs(points[:, None] - met[None]).max(axis=2).min(axis=1) if len(met) else np.full(len(points), np.inf)
    return apart < 6e-7


def errors_of(one: Asset) -> tuple[float, float]:
    """Metres: the worst signed distance, and how far a point is from the surface that is on the wrong side of it.

    Of every tenth point, half of them from the box and half from near the surface.
    """
    mesh, drawn = welded(one.shape), draw_samples(one, BOTH).arrays
    points, signed, occupied = (drawn[f"volume_{name}"][::10] for name in ("points", "distance", "occupancy"))
    assert ((signed < 0.0) == occupied).all()
    assert 0.05 < occupied[len(points) // 2 :].mean() < 0.95, "points near the surface lie on both sides"
    points = points.astype(np.float64)
    exact, solid = distances_to_faces(points, mesh.triangles), inside_solid(points, mesh)
    return float(np.abs(signed - np.where(solid, -exact, exact)).max()), float(
        exact[occupied != solid].max(initial=0.0)
    )


@pytest.mark.parametrize("category", FEW)
def test_distances_and_insides_are_those_of_brute_force_and_of_the_exact_solid(category):
    assert max(errors_of(asset(category))) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("category", [*CATEGORIES, "table"])
def test_the_same_holds_at_both_ends_of_every_range_and_between_in_fifty_shapes(category):
    drawn = [asset(category, index) for index in range(10, 10 if category == "table" else 14)]
    for one in (*drawn, asset_at(category, False), asset_at(category, True)):
        assert max(errors_of(one)) < 1e-6, one.instance_id


@pytest.mark.parametrize("category", EVERYTHING)
def test_points_of_the_surface_lie_on_it_with_the_normals_and_colours_of_their_faces(category):
    mesh, drawn = welded(asset(category).shape), samples(category)
    points, normals = (drawn[f"surface_{name}"][::10].astype(np.float64) for name in ("points", "normals"))
    assert distances_to_faces(points, mesh.triangles).max() < 1e-6
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() < 1e-6
    out, within = (inside_solid(points + sign * 5e-6 * normals, mesh) for sign in (1.0, -1.0))
    assert (within & ~out).mean() > 0.99, "not beside a sharp edge"
    half = np.asarray(asset(category).extents_m) / 2.0
    assert np.abs((drawn["volume_points"][: BOTH.points // 2]) / half).max(axis=0) == pytest.approx(1.05, rel=0.02)
    assert drawn["loc"] == pytest.approx(0.0, abs=1e-12) and drawn["scale"] == asset(category).extents_m.max()


def test_points_are_uniform_by_area_and_have_the_colour_of_their_place():
    """A box of three colours: faces in four cells each, counted; and a face whose texture is black on the left."""
    size = np.array([0.1, 0.2, 0.4])
    mesh = box(*size)
    drawn = draw_samples(asset_of(mesh), Targets(shape=("surface",), points=48_000)).arrays
    points = drawn["surface_points"] / size
    axis = np.abs(points).argmax(axis=1)
    face = 2 * axis + (points[np.arange(len(points)), axis] > 0.0)
    u, v = (points[np.arange(len(points)), (axis + k) % 3] > 0.0 for k in (1, 2))
    counts = np.bincount(4 * face + 2 * u + v, minlength=24)
    share = np.repeat(size.prod() / size, 8)
    assert chisquare(counts, share / share.sum() * len(points)).pvalue > 1e-3
    assert (
        drawn["surface_normals"][np.arange(len(points)), axis] == np.sign(points[np.arange(len(points)), axis])
    ).all()

    texture = np.zeros((1, 256, 3), np.uint8)
    texture[:, 128:] = 255
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    flat, faces = np.column_stack([uv, np.zeros(4)]), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    half = dataclasses.replace(Material(), base_color=(0.4, 1.0, 0.0, 1.0), texture=texture)
    sheet = dataclasses.replace(open_asset(mesh), shape=Shape((Part("sheet", flat, faces, half, uv=uv),)))
    drawn = draw_samples(sheet, Targets(shape=("surface",), points=1_000)).arrays
    x = drawn["surface_points"][:, 0]
    assert (drawn["surface_colors"][(x > 0.51) & (x < 0.99)] == [102, 255, 0]).all()
    assert not drawn["surface_colors"][(x > 0.01) & (x < 0.49)].any()


@pytest.mark.minute
def test_an_opened_sphere_has_the_winding_numbers_of_its_solid_angle_and_says_how_much_is_open():
    ball = trimesh.creation.icosphere(4, 0.1)
    opened = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.06], process=False)
    points = np.random.default_rng(0).uniform(-0.11, 0.11, (2_000, 3))
    number = winding_numbers(points, Mesh(opened.vertices, opened.faces.astype(np.int32)))
    assert np.abs(number - exact_winding_numbers(points, opened.triangles)).max() < 0.01
    centre = winding_numbers(np.zeros((1, 3)), Mesh(opened.vertices, opened.faces.astype(np.int32)))
    assert centre == pytest.approx(1.0 - (1.0 - 0.6) / 2.0, abs=0.02), "the share of directions that a cap leaves"
    drawn = draw_samples(open_asset(opened), Targets(shape=("volume",), points=1_000))
    exact = exact_winding_numbers(drawn.arrays["volume_points"].astype(np.float64), opened.triangles)
    assert (
        drawn.open_share == pytest.approx(((exact > 0.1) & (exact < 0.9)).mean(), abs=0.03) and drawn.open_share > 0.2
    )
    assert (drawn.arrays["volume_occupancy"] == (exact > 0.5))[np.abs(exact - 0.5) > 0.01].all()


def test_bodies_that_overlap_are_one_solid_without_walls_inside():
    """Two boxes that together are one, whose signed distance is known."""
    two = asset_of(box(0.3, 0.2, 0.1, (-0.05, 0, 0)), box(0.3, 0.2, 0.1, (0.05, 0, 0)))
    drawn = draw_samples(two, BOTH).arrays
    half = np.array([0.2, 0.1, 0.05])
    beyond = np.abs(drawn["volume_points"].astype(np.float64)) - half
    signed = np.linalg.norm(beyond.clip(min=0.0), axis=1) + beyond.max(axis=1).clip(max=0.0)
    assert np.abs(drawn["volume_distance"] - signed).max() < 1e-6
    assert np.abs(np.abs(drawn["surface_points"]) - half).min(axis=1).max() < 1e-6


def test_the_same_bytes_come_for_each_target_whatever_else_is_asked_and_whenever():
    mug = asset("mug")
    data = encode_samples(draw_samples(mug, BOTH).arrays)
    for member in zipfile.ZipFile(
        io.BytesIO(data)
    ).infolist():  # what patch versions of Python write each in their own way
        assert (member.extract_version, member.extra, member.flag_bits) == (20, b"", 0)
        assert data[member.header_offset + 18 : member.header_offset + 22] == member.compress_size.to_bytes(4, "little")
    again = make_asset("mug", ProceduralSource(source="procedural"), 3, 600.0)
    assert encode_samples(draw_samples(again, BOTH).arrays) == data
    assert {one.date_time for one in zipfile.ZipFile(io.BytesIO(data)).infolist()} == {(1980, 1, 1, 0, 0, 0)}
    volume = draw_samples(mug, Targets(shape=("volume",), points=BOTH.points)).arrays
    assert set(samples("mug")) - set(volume) == {"surface_points", "surface_normals", "surface_colors"}
    assert all((array == samples("mug")[name]).all() for name, array in volume.items())
    with np.load(io.BytesIO(data)) as stored:
        kinds = {name: array.dtype.str for name, array in stored.items()}
    assert kinds == {
        **dict.fromkeys(("surface_points", "surface_normals", "volume_points", "volume_distance"), "<f4"),
        "surface_colors": "|u1",
        "volume_occupancy": "|u1",
        "loc": "<f8",
        "scale": "<f8",
    }


def test_a_shape_without_a_target_has_none_and_says_why():
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    volume = Targets(shape=("volume",), points=200)
    kept_back = dataclasses.replace(asset("mug"), shareable=False)
    cases = (open_asset(flat), volume, "enclose none"), (open_asset(line), BOTH, "area"), (kept_back, BOTH, "passed")
    for one, targets, why in cases:
        stored = stored_samples(one, targets)
        assert (stored.file, stored.column) == (None, None) and why in "".join(stored.notes)
    surface = draw_samples(open_asset(flat), BOTH)
    assert "surface_points" in surface.arrays and "volume_points" not in surface.arrays
    assert (surface.open_share, len(surface.notes)) == (None, 1)
