"""What built-in shapes are made of: curves, closed solids and their unions, walls of vessels, parts, and pictures."""

import math

import numpy as np
import pytest
import trimesh
from shapely.geometry import Polygon

from schemas.scene.shape import Material
from tests.workers.door.oracles import faulty_rays, welded
from workers.assets.builtin import materials
from workers.assets.builtin import solid as solid_module
from workers.assets.builtin.parts import Surface, cut_into_parts, turn_about_z
from workers.assets.builtin.solid import Solid, circle, combine, difference, lathe, smoothing_groups, union, union_at
from workers.assets.builtin.sweeps import (
    BASE,
    INSIDE,
    OUTSIDE,
    bend_radius,
    bevelled_profile,
    prism,
    rod,
    wall_around,
)


def mesh_of(solid: Solid) -> trimesh.Trimesh:
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


def prism_area(count):
    """Of a regular polygon in the unit circle."""
    return 0.5 * count * math.sin(2 * math.pi / count)


def cylinder(radius=1.0, height=2.0, count=64, surface=(0, 0, 0)):
    return lathe(np.array([[0, 0], [radius, 0], [radius, height], [0, height]]), surface, count)


# ------------------------------------------------------------------------------------------------ solids


def test_turned_bent_and_straight_solids_have_the_volumes_of_the_textbook():
    square = np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])
    sectioned = lathe(np.array([[0, 0], [1, 0], [1, 3], [0, 3]]), [0] * 3, section=np.stack([square, square]))
    box = prism(np.array([[0.0, 0.0], [0.0, 0.3]]), (0.4, 0.2), 0.05, [0] * 3, 32)
    turn = np.linspace(0, math.pi, 200)
    path, ends = np.stack([np.cos(turn), np.sin(turn)], axis=1), (np.array([0.0, 1.0]), np.array([0.0, -1.0]))
    for solid, volume, share in (
        (cylinder(), 2.0 * prism_area(64), 1e-12),
        (sectioned, 12.0, 1e-12),
        (box, 0.3 * (0.08 - (4 - math.pi) * 0.0025), 1e-3),
        (rod(path, 0.1 * circle(64), 0, ends), math.pi * math.pi * 0.01, 5e-3),  # Pappus
    ):
        assert mesh_of(solid).is_volume and mesh_of(solid).volume == pytest.approx(volume, rel=share)
    assert mesh_of(box).bounds == pytest.approx(np.array([[-0.2, -0.1, 0.0], [0.2, 0.1, 0.3]]))
    assert bend_radius(0.3 * path, ends) == pytest.approx(0.3, rel=1e-3), "it may be as thick as its bend is wide"
    with pytest.raises(ValueError, match="no room for an inset"):
        prism(np.array([[0.0, 0.0], [0.06, 0.3]]), (0.4, 0.1), 0.01, [0] * 3)
    axes = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    placed = mesh_of(cylinder().placed(axes, np.array([5.0, 0, 0])))
    assert placed.bounds == pytest.approx(np.array([[5, -1, -1], [7, 1, 1]])) and placed.volume > 0


def test_bands_that_bend_sharply_and_flat_ends_are_shaded_apart():
    assert smoothing_groups(np.array([[0, 0], [1, 0], [1, 1], [1.1, 2], [0, 2]])).tolist() == [0, 1, 1, 2]
    soft = np.array([[0, 0], [1, 0], [1.1, 0.01], [1.2, 0.03], [1.2, 1], [1.1, 1.01], [0, 1.01]])
    runs = smoothing_groups(soft)
    assert runs[0] != runs[1] and runs[-1] != runs[-2], "however soft the rim is"


def test_a_union_counts_what_overlaps_once_and_keeps_the_surfaces_apart():
    low, high = cylinder(surface=[3] * 3), cylinder(0.5, surface=[7] * 3).moved(z=1.0)
    joined = union([low, high])
    assert mesh_of(joined).is_watertight
    assert mesh_of(joined).volume == pytest.approx(prism_area(64) * (2.0 + 0.25 * 1.0), rel=1e-9)
    upper = joined.vertices[joined.faces][:, :, 2].min(axis=1) > 2.0
    assert set(joined.surface) == {3, 7} and set(joined.surface[upper]) == {7}
    assert not set(joined.smooth[joined.surface == 3]) & set(joined.smooth[joined.surface == 7])
    with pytest.raises(ValueError, match="not a closed solid"):
        union([Solid(low.vertices, low.faces[1:], low.surface[1:], low.smooth[1:])])


def test_a_difference_gives_the_cut_the_cutters_surface():
    bored = difference(cylinder(surface=[1] * 3), [cylinder(0.5, 4.0, surface=[2] * 3).moved(z=-1.0)])
    assert mesh_of(bored).volume == pytest.approx(2.0 * 0.75 * prism_area(64), rel=1e-9)
    assert mesh_of(bored).euler_number == 0 and set(bored.surface) == {1, 2}


def test_solids_put_together_stay_apart_and_join_in_one_step():
    legs = combine([cylinder(0.1).moved(x=x) for x in (-0.5, 0.5)])
    joined = union([cylinder(1.0, 0.5).moved(z=1.8), legs])
    assert mesh_of(joined).volume == pytest.approx(prism_area(64) * (0.5 + 2 * 0.01 * 1.8), rel=1e-9)
    assert faulty_rays(joined.vertices, joined.faces, np.random.default_rng(0), 50) == 0
    overlapping = combine([cylinder(), cylinder().moved(x=0.5)])
    faults = faulty_rays(overlapping.vertices, overlapping.faces, np.random.default_rng(0), 50)
    assert faults > 10, "the rays of the tests see what was not joined"


BODY = lathe(np.array([[0, 0], [1, 0], [1, 0.4], [1, 1.6], [1, 2], [0, 2]]), [1] * 5, 40)
TOUCHED = ((np.abs(BODY.vertices[:, 1]) < 0.3) & (BODY.vertices[:, 0] > 0.5))[BODY.faces].all(axis=1)
APEX = np.array([0.0, 0.0, 1.0])


def arm(reach: float) -> Solid:
    """A rod along x out of the wall of a cylinder of radius 1, from x = 1 - reach to 2."""
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    return cylinder(0.1, 1.0 + reach, 16, [2] * 3).placed(axes, np.array([1.0 - reach, 0.0, 1.0]))


@pytest.mark.parametrize("reach", [0.05, 0.3, 1.5])
def test_a_union_at_some_faces_is_the_union(reach):
    """Where the arm stays within the fans, and where it goes through them and the whole solid has to go in."""
    assert 0 < TOUCHED.sum() < len(BODY.faces) / 4
    whole, partly = union([BODY, arm(reach)]), union_at(BODY, TOUCHED, APEX, [arm(reach)])
    assert mesh_of(partly).is_watertight and mesh_of(partly).is_winding_consistent
    assert mesh_of(partly).volume == pytest.approx(mesh_of(whole).volume, rel=1e-12)
    for number in (1, 2):
        areas = [mesh_of(one).area_faces[one.surface == number].sum() for one in (whole, partly)]
        assert areas[1] == pytest.approx(areas[0], rel=1e-12)
    assert set(partly.surface) == {1, 2} and len(np.unique(partly.faces)) == len(partly.vertices)
    # The rest of the body shades with the faces that went in.
    assert set(partly.smooth[partly.surface == 1]) == set(BODY.smooth)


def test_a_union_at_some_faces_puts_only_those_in(monkeypatch):
    sizes, tagged = [], solid_module._tagged
    monkeypatch.setattr(
        solid_module, "_tagged", lambda solids: (sizes.append([len(s.faces) for s in solids]), tagged(solids))[1]
    )
    aside = cylinder(0.05, 0.5, 8, [3] * 3).moved(x=1.5, z=1.05)
    both = union_at(BODY, TOUCHED, APEX, [arm(0.1)], [aside])
    assert len(sizes) == 1 and max(sizes[0]) < len(BODY.faces) / 2
    assert set(both.surface) == {1, 2, 3} and mesh_of(both).body_count == 1


def test_a_wall_is_as_thick_as_it_says_around_its_hollow_and_stands_on_its_foot_ring():
    hollow = np.array([[0.0, 0.01], [0.03, 0.01], [0.04, 0.02], [0.04, 0.1]])
    wall = wall_around(hollow, 0.004, 0.025, 0.004, 0.001)
    assert Polygon(wall.profile).is_valid and set(wall.surface) == {OUTSIDE, INSIDE, BASE}
    assert wall.radius_at(0.099) == pytest.approx(0.044, abs=1e-5)
    assert wall.normal_at(0.06) == pytest.approx([1, 0], abs=1e-2)
    assert wall.profile[1:][wall.surface == INSIDE][-1].tolist() == [0.0, 0.01]
    mesh = mesh_of(lathe(wall.profile, wall.surface, 256))
    ring = np.hypot(*mesh.vertices[mesh.vertices[:, 2] == 0.0][:, :2].T)
    assert mesh.is_volume and [ring.min(), ring.max()] == pytest.approx([0.021, 0.025])


# ------------------------------------------------------------------------------------------------ parts

PLAIN, PICTURE = Material(), Material(texture=np.zeros((2, 2, 3), dtype=np.uint8))
TIN = cylinder(0.1, 0.4, 32, (0, 1, 2))


def named(*wraps, **more):
    pairs = [(PLAIN, "cylinder") if wrap == "none" else (PICTURE, wrap) for wrap in wraps]
    return [Surface(f"s{k}", *pair, **more) for k, pair in enumerate(pairs)]


def test_parts_share_the_very_same_points_and_have_normals_that_point_outwards():
    shape = cut_into_parts(TIN, named("none", "none", "none"), np.array([0.0, 0, 0.2]), 0.7)
    assert [part.name for part in shape.parts] == ["s0", "s1", "s2"] and welded(shape).is_watertight
    assert shape.bounds == pytest.approx(np.array([[-0.07, -0.07, -0.14], [0.07, 0.07, 0.14]]))
    base, wall, lid = shape.parts
    assert wall.normals == pytest.approx(wall.vertices * [1 / 0.07, 1 / 0.07, 0], abs=1e-6)
    for part, z in ((lid, 1.0), (base, -1.0)):
        assert part.normals == pytest.approx(np.tile([0, 0, z], (len(part.vertices), 1)))
    assert not any(array.flags.writeable for array in (wall.vertices, wall.faces, wall.normals))
    some = cut_into_parts(cylinder(surface=(0, 2, 0)), named("none", "none", "none"), np.zeros(3), 1.0)
    assert [part.name for part in some.parts] == ["s0", "s2"], "a surface that nothing has makes no part"
    joined = union([TIN, cylinder(0.1, 0.4, 32, (1, 1, 1)).moved(x=0.05, z=0.1)])
    whole = welded(cut_into_parts(joined, named("box", "cylinder", "none"), np.array([0.1, 0.2, 0.3]), 3.3))
    assert whole.is_watertight and whole.volume > 0


def test_a_cylinder_is_wrapped_once_with_a_seam_and_a_plane_is_laid_by_its_two_vectors():
    base, wall, _ = cut_into_parts(TIN, named("none", "cylinder", "none", low=0.0, high=0.4), np.zeros(3), 1.0).parts
    assert base.uv is None, "its material has no texture"
    assert wall.uv.min(axis=0) == pytest.approx([0, 0]) and wall.uv.max(axis=0) == pytest.approx([1, 1])
    across = wall.uv[wall.faces][:, :, 0]
    assert np.ptp(across, axis=1) == pytest.approx(np.full(64, 1 / 32), abs=1e-9), "no face goes back over the picture"
    angle = np.arctan2(wall.vertices[:, 1], wall.vertices[:, 0]) / (2 * np.pi)
    assert np.exp(2j * np.pi * wall.uv[:, 0]) == pytest.approx(np.exp(2j * np.pi * angle), abs=1e-9)
    assert len(wall.vertices) == 64 + 2 and not wall.uv.flags.writeable
    wrap = {"origin": (-0.1, -0.1, 0.0), "across": (0.2, 0.0, 0.0), "up": (0.0, 0.2, 0.0)}
    lid = cut_into_parts(TIN, named("none", "none", "plane", **wrap), np.zeros(3), 1.0).parts[2]
    assert lid.uv == pytest.approx((lid.vertices[:, :2] + 0.1) / 0.2)


@pytest.mark.parametrize(("grain", "sides"), [(0, {0: 1, 1: 0, 2: 0}), (2, {0: 2, 1: 2, 2: 0})])
def test_grain_runs_along_its_axis_on_every_side(grain, sides):
    solid = prism(bevelled_profile(0.3, 0.01), (0.4, 0.2), 0.01, [0] * 5)
    part = cut_into_parts(solid, named("box", size=0.4, grain=grain), np.zeros(3), 1.0).parts[0]
    corners = part.vertices[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    low = solid.vertices.min(axis=0)
    for axis, along in sides.items():
        index = part.faces[np.abs(normals[:, axis]) / np.linalg.norm(normals, axis=1) > 0.999]
        assert part.uv[index][:, :, 0] == pytest.approx((part.vertices[index][:, :, along] - low[along]) / 0.4)


def test_turns_are_the_angles_that_python_finds():
    points = np.concatenate(
        [
            np.random.default_rng(0).normal(size=(5000, 2)),
            [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1]],
        ]
    )
    points = np.concatenate([points, points * [1.0, 1e-9], points * [1e-9, 1.0], [[0.0, 0.0], [1.0, -1e-17]]])
    turns = np.array([turn_about_z(x, y) for x, y in points.tolist()])
    expected = np.array([math.atan2(y, x) / (2 * math.pi) % 1.0 for x, y in points.tolist()])
    assert np.abs((turns - expected + 0.5) % 1.0 - 0.5).max() < 1.1e-14
    assert turns.min() >= 0.0 and turns.max() < 1.0
    assert turns[5000:5007].tolist() == [0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75]


# ------------------------------------------------------------------------------------------------ colours and pictures

A, B = (0.2, 0.4, 0.6), (0.9, 0.8, 0.1)


def test_colours_and_materials_are_within_range_and_ink_can_be_read_on_its_paper():
    rng = np.random.default_rng(0)
    for draw in (materials.vivid, materials.pale, materials.glaze_color, materials.glass_color):
        colors = np.array([draw(rng) for _ in range(300)])
        assert colors.min() >= 0.0 and colors.max() <= 1.0 and len(np.unique(colors, axis=0)) > 200
    for number in range(300):
        paper = materials.vivid(rng) if number % 2 else materials.pale(rng)
        assert max(abs(a - b) for a, b in zip(materials.ink_on(rng, paper), paper, strict=True)) > 0.1
        material = (materials.plastic, materials.steel, materials.metal)[number % 3](rng)
        assert 0.0 <= material.metallic <= 1.0 and 0.05 <= material.roughness <= 1.0 and material.base_color[3] == 1.0


@pytest.mark.parametrize(("smooth", "quarter"), [(False, 0.25), (True, 0.25**2 * (3 - 2 * 0.25))])
def test_a_stretched_lattice_keeps_its_points_and_lies_between_them_otherwise(smooth, quarter):
    lattice = np.array([[0.0, 8.0, 4.0], [2.0, 6.0, 1.0]], np.float32)  # two columns, three rows
    plane = materials.stretched(lattice, 12, 8, smooth)
    assert plane.shape == (12, 8) and np.array_equal(plane[::4, ::4], lattice.T)
    assert plane[0, [1, 2, 5]] == pytest.approx([2.0 * quarter, 1.0, 2.0 - 2.0 * quarter])
    assert plane[[1, 2, 9], 0] == pytest.approx([8.0 * quarter, 4.0, 4.0 - 4.0 * quarter])


def test_every_picture_is_small_of_bytes_has_more_than_one_colour_and_comes_again():
    for draw in (
        lambda rng: materials.wood(rng, A, B, planks=4),
        lambda rng: materials.stone(rng, A, B),
        lambda rng: materials.speckled(rng, A, B, 0.1),
        lambda rng: materials.bands(rng, [A, B, A]),
        lambda rng: materials.upright_stripes(rng, [A, B]),
        lambda rng: materials.dots(rng, A, B),
        lambda rng: materials.label(rng, A, 40),
        lambda rng: materials.label(rng, A, 16, 256, 3),
    ):
        one, again = (draw(np.random.default_rng(3)) for _ in range(2))
        assert one.dtype == np.uint8 and one.ndim == 3 and max(one.shape) <= 256
        assert len(np.unique(one.reshape(-1, 3), axis=0)) > 1 and (one == again).all()
    heights = [materials.band_height(0.0, high, radius) for high, radius in ((0.1, 0.1 / np.pi), (1e-6, 0.1), (9, 0.1))]
    assert heights == [128, 16, 192], "pixels are square on a cylinder"
