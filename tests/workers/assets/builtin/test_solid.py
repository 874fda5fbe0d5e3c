"""Closed solids and their unions, against volumes of the textbook."""

import math

import manifold3d
import numpy as np
import pytest
import trimesh

from tests.workers.assets.oracles import faulty_rays
from workers.assets.builtin import solid as solid_module
from workers.assets.builtin.solid import Solid, circle, combine, difference, lathe, smoothing_groups, union, union_at


def cylinder(radius=1.0, height=2.0, count=64, surface=0):
    return lathe(np.array([[0, 0], [radius, 0], [radius, height], [0, height]]), [surface] * 3, count)


def mesh_of(solid):
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


def prism_area(count):
    """Of a regular polygon in the unit circle."""
    return 0.5 * count * math.sin(2 * math.pi / count)


def test_circle_points_have_radius_one_and_exact_quarters():
    for count in (12, 16, 20, 44, 48):
        points = circle(count)
        assert np.hypot(*points.T) == pytest.approx(np.ones(count), abs=2e-14)
        assert points[:: count // 4].tolist() == [[1, 0], [0, 1], [-1, 0], [0, -1]]
        angles = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
        assert np.diff(angles) == pytest.approx(np.full(count - 1, 2 * math.pi / count), abs=1e-12)


def test_a_turned_rectangle_is_a_closed_prism_that_faces_outwards():
    mesh = mesh_of(cylinder())
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(2.0 * prism_area(64), rel=1e-12)


def test_a_section_turns_the_lathe_into_a_prism_of_that_section():
    square = np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])
    profile = np.array([[0, 0], [1, 0], [1, 3], [0, 3]])
    solid = lathe(profile, [0] * 3, section=np.stack([square, square]))
    assert mesh_of(solid).volume == pytest.approx(12.0)


def test_bands_that_bend_sharply_are_shaded_apart():
    assert smoothing_groups(np.array([[0, 0], [1, 0], [1, 1], [1.1, 2], [0, 2]])).tolist() == [0, 1, 1, 2]


def test_a_flat_end_is_shaded_flat_however_soft_its_rim_is():
    soft = np.array([[0, 0], [1, 0], [1.1, 0.01], [1.2, 0.03], [1.2, 1], [1.1, 1.01], [0, 1.01]])
    runs = smoothing_groups(soft)
    assert runs[0] != runs[1]
    assert runs[-1] != runs[-2]


def test_a_union_counts_what_overlaps_once_and_keeps_the_surfaces_apart():
    low, high = cylinder(surface=3), cylinder(0.5, 2.0, 64, surface=7).moved(z=1.0)
    joined = union([low, high])
    assert mesh_of(joined).is_watertight
    assert mesh_of(joined).volume == pytest.approx(prism_area(64) * (2.0 + 0.25 * 1.0), rel=1e-9)
    assert set(joined.surface) == {3, 7}
    upper = joined.vertices[joined.faces][:, :, 2].min(axis=1) > 2.0
    assert set(joined.surface[upper]) == {7}
    assert not set(joined.smooth[joined.surface == 3]) & set(joined.smooth[joined.surface == 7])


def test_a_difference_gives_the_cut_the_cutters_surface():
    bored = difference(cylinder(surface=1), [cylinder(0.5, 4.0, 64, surface=2).moved(z=-1.0)])
    assert mesh_of(bored).volume == pytest.approx(2.0 * 0.75 * prism_area(64), rel=1e-9)
    assert mesh_of(bored).euler_number == 0
    assert set(bored.surface) == {1, 2}


def test_solids_put_together_stay_apart_and_join_in_one_step():
    legs = combine([cylinder(0.1).moved(x=x) for x in (-0.5, 0.5)])
    joined = union([cylinder(1.0, 0.5).moved(z=1.8), legs])
    assert mesh_of(joined).volume == pytest.approx(prism_area(64) * (0.5 + 2 * 0.01 * 1.8), rel=1e-9)
    assert faulty_rays(joined.vertices, joined.faces, np.random.default_rng(0), 50) == 0


def test_the_rays_of_the_tests_see_an_overlap_that_was_not_joined():
    overlapping = combine([cylinder(), cylinder().moved(x=0.5)])
    assert faulty_rays(overlapping.vertices, overlapping.faces, np.random.default_rng(0), 50) > 10


def test_placing_turns_and_moves():
    axes = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    placed = cylinder().placed(axes, np.array([5.0, 0, 0]))
    assert mesh_of(placed).bounds == pytest.approx(np.array([[5, -1, -1], [7, 1, 1]]))
    assert mesh_of(placed).volume > 0


def test_a_solid_with_a_hole_in_its_surface_is_a_bug_and_says_so():
    whole = cylinder()
    holed = Solid(whole.vertices, whole.faces[1:], whole.surface[1:], whole.smooth[1:])
    with pytest.raises(ValueError, match="not a closed solid"):
        union([holed])


def test_manifold_agrees_that_a_lathe_is_a_manifold():
    solid = cylinder()
    mesh = manifold3d.Mesh64(vert_properties=solid.vertices, tri_verts=solid.faces.astype(np.uint64))
    assert manifold3d.Manifold(mesh).volume() == pytest.approx(mesh_of(solid).volume, rel=1e-12)


def arm(reach: float) -> Solid:
    """A rod along x out of the wall of a cylinder of radius 1, from x = 1 - reach to 2."""
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    return cylinder(0.1, 1.0 + reach, 16, surface=2).placed(axes, np.array([1.0 - reach, 0.0, 1.0]))


@pytest.mark.parametrize("reach", [0.05, 0.3, 1.5])
def test_a_union_at_some_faces_is_the_union(reach):
    """Where the arm stays within the fans, and where it goes through them and the whole solid has to go in."""
    body = lathe(np.array([[0, 0], [1, 0], [1, 0.4], [1, 1.6], [1, 2], [0, 2]]), [1] * 5, 40)
    near = (np.abs(body.vertices[:, 1]) < 0.3) & (body.vertices[:, 0] > 0.5)
    touched = near[body.faces].all(axis=1)
    assert 0 < touched.sum() < len(body.faces) / 4
    whole, partly = union([body, arm(reach)]), union_at(body, touched, np.array([0.0, 0.0, 1.0]), [arm(reach)])
    assert mesh_of(partly).is_watertight and mesh_of(partly).is_winding_consistent
    assert mesh_of(partly).volume == pytest.approx(mesh_of(whole).volume, rel=1e-12)
    for number in (1, 2):
        areas = [mesh_of(one).area_faces[one.surface == number].sum() for one in (whole, partly)]
        assert areas[1] == pytest.approx(areas[0], rel=1e-12)
    assert set(partly.surface) == {1, 2}
    assert len(np.unique(partly.faces)) == len(partly.vertices)
    # The rest of the body shades with the faces that went in.
    assert set(partly.smooth[partly.surface == 1]) == set(body.smooth)


def test_a_union_at_some_faces_puts_only_those_in(monkeypatch):
    body, sizes = lathe(np.array([[0, 0], [1, 0], [1, 0.4], [1, 1.6], [1, 2], [0, 2]]), [1] * 5, 40), []
    tagged = solid_module._tagged
    monkeypatch.setattr(
        solid_module, "_tagged", lambda solids: (sizes.append([len(s.faces) for s in solids]), tagged(solids))[1]
    )
    touched = ((np.abs(body.vertices[:, 1]) < 0.3) & (body.vertices[:, 0] > 0.5))[body.faces].all(axis=1)
    aside = cylinder(0.05, 0.5, 8, surface=3).moved(x=1.5, z=1.05)
    both = union_at(body, touched, np.array([0.0, 0.0, 1.0]), [arm(0.1)], [aside])
    assert len(sizes) == 1 and max(sizes[0]) < len(body.faces) / 2
    assert set(both.surface) == {1, 2, 3}
    assert mesh_of(both).body_count == 1
