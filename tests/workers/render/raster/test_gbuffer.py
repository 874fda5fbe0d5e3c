"""Depth and regions of simple scenes, against arithmetic and against the ray caster."""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from tests.workers.render.random_scenes import (
    APPEARANCE,
    EYE,
    VGA,
    WHITE,
    camera,
    facing,
    floor,
    orbit_and_mirror,
    quad,
    random_things,
    shape_of,
    small,
)
from workers.geometry import raycast
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import encode_srgb
from workers.geometry.frames import pose, translation, uniform_rotation
from workers.geometry.raycast import cast_view
from workers.render.raster import draw_calls as programs

PLANE_MM = 0.001
"""float32 depth of a plane some metres away: a few units in the last place."""


def plane_depth(k: Intrinsics, normal, offset: float):
    """Depth of the plane normal . p = offset at every pixel's centre."""
    v, u = np.mgrid[0 : k.height, 0 : k.width] + 0.5
    return offset / (normal[0] * (u - k.cx) / k.fx + normal[1] * (v - k.cy) / k.fy + normal[2])


def test_depth_of_a_floor_of_sixty_metres_is_that_of_its_plane(renderer):
    T = orbit_pose(np.array([0.0, 0.0, 0.7]), 0.7, 1.1, 2.5)
    normal = T[:3, :3].T @ [0.0, 0.0, 1.0]
    seen = renderer.draw([floor()], APPEARANCE, camera(T=T))
    assert (seen.region == 1).all()
    assert np.abs(seen.depth_m - plane_depth(VGA, normal, -T[2, 3])).max() * 1e3 < 2 * PLANE_MM


def test_depth_is_taken_at_pixel_centres(renderer):
    """On a plane this steep half a pixel is 5 mm of depth."""
    normal = np.array([0.0, 1.0, 0.4])
    h = 3.0
    corners = [[x, y, (1.0 - normal[1] * y) / normal[2]] for x, y in ((-h, -0.2), (h, -0.2), (h, 0.9), (-h, 0.9))]
    k = VGA.model_copy(update={"cx": 317.2, "cy": 251.9})
    seen = renderer.draw([Placed(7, quad(corners), EYE)], APPEARANCE, camera(k))
    hit = seen.region == 7
    expected = plane_depth(k, normal, 1.0)
    assert hit.mean() > 0.5
    assert np.abs(seen.depth_m - expected)[hit].max() * 1e3 < PLANE_MM
    assert np.abs(expected[1:] - expected[:-1])[hit[1:]].min() * 1e3 > 1.0, "the plane is too flat to tell half pixels"


def test_a_mask_ends_between_the_pixel_centres_on_both_sides_of_an_edge(renderer):
    k = small(20, 10, fx=10.0, fy=10.0, cx=0.0, cy=0.0)  # at z = 10 a metre is a pixel
    edges = {7.49: 7, 7.51: 8, 7.98: 8, 8.49: 8, 8.51: 9}
    for right, columns in edges.items():
        square = quad([[2, 3, 10], [right, 3, 10], [right, 6, 10], [2, 6, 10]])
        region = renderer.draw([Placed(3, square, EYE)], APPEARANCE, camera(k)).region
        expected = np.zeros((10, 20), bool)
        expected[3:6, 2:columns] = True
        np.testing.assert_array_equal(region == 3, expected, err_msg=f"right edge at {right}")


def test_right_is_right_and_down_is_down(renderer):
    things = [Placed(i, facing(2.0, 0.1), translation(*at, 0.0)) for i, at in ((3, (1, 0)), (4, (0, 1)), (5, (-1, 0)))]
    region = renderer.draw(things, APPEARANCE, camera(small(100, 100))).region
    assert [region[50, 75], region[75, 50], region[50, 25], region[25, 50]] == [3, 4, 5, 0]


def test_a_sphere_of_triangles_agrees_with_rays(renderer):
    things = [Placed(3, shape_of(trimesh.creation.icosphere(4, 0.1)), translation(0.2, -0.1, 1.5))]
    seen = renderer.draw(things, APPEARANCE, camera())
    depth, region, cosine = cast_view(things, camera())
    np.testing.assert_array_equal(seen.region, region)
    steep = cosine > 0.17
    assert np.abs(seen.depth_m - depth)[steep].max() * 1e3 < 0.01
    middle = seen.depth_m[int(240 - 525 * 0.1 / 1.5), int(320 + 525 * 0.2 / 1.5)]
    assert middle == pytest.approx(1.4, abs=2e-3)


def test_moving_the_principal_point_by_whole_pixels_moves_the_image(renderer):
    rng = np.random.default_rng(5)
    things, height = random_things(rng)
    T = orbit_and_mirror(rng, height)[0].T_world_cam
    moved = VGA.model_copy(update={"cx": VGA.cx + 40.0, "cy": VGA.cy - 25.0})
    a, b = (renderer.draw(things, APPEARANCE, camera(k, T)) for k in (VGA, moved))
    assert (a.region[25:, :-40] != b.region[:-25, 40:]).mean() < 1e-4
    assert np.median(np.abs(a.depth_m[25:, :-40] - b.depth_m[:-25, 40:])) * 1e3 < PLANE_MM


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4096, 2), (3, 4096), (641, 479)])
def test_any_image_size_agrees_with_rays(renderer, width, height):
    rng = np.random.default_rng(1)
    f = max(width, height)
    k = Intrinsics(width=width, height=height, fx=0.8 * f, fy=0.9 * f, cx=0.47 * width, cy=0.55 * height)
    things, table = random_things(rng)
    view = Camera(k, orbit_and_mirror(rng, table)[0].T_world_cam)
    seen = renderer.draw(things, APPEARANCE, view)
    depth, region, _ = cast_view(things, view)
    assert seen.rgb.shape == (height, width, 3) and seen.depth_m.shape == seen.region.shape == (height, width)
    different = np.argwhere(seen.region != region)
    assert (raycast.edge_distance_px(things, view, different) < 1 / 64).all()
    floor_seen = (region == 1) & (seen.region == 1)
    assert np.abs(seen.depth_m - depth)[floor_seen].max(initial=0.0) < 2e-6 * max(1.0, depth.max())


def test_both_sides_of_a_face_are_drawn_and_lit(renderer):
    """The same square seen from its front and from its back, lit from the camera's side, with shading normals or none."""
    key = Appearance((0.0, 0.0, 0.0), (Light(frozen_array([0.0, 0.0, -1.0]), (0.5, 0.5, 0.5)),), (0.0, 0.0, 0.0))
    for normals in (None, frozen_array([[0.0, 0.0, 1.0]] * 4)):
        (part,) = facing(2.0).parts
        front = Part("square", part.vertices, part.faces, Material(roughness=1.0), normals)
        back = Part(
            "square", part.vertices, frozen_array(part.faces[:, ::-1], np.int32), Material(roughness=1.0), normals
        )
        seen = [renderer.draw([Placed(3, Shape((p,)), EYE)], key, camera(small(8, 8))) for p in (front, back)]
        assert all((view.region == 3).all() for view in seen)
        np.testing.assert_array_equal(seen[0].rgb, seen[1].rgb)
        assert seen[0].rgb.min() > 60


@pytest.mark.parametrize("turned", [False, True], ids=["same-triangles", "other-triangles"])
def test_of_coplanar_faces_the_lowest_region_id_wins(renderer, turned):
    """Two overlapping squares in one plane, in 60 random poses and seen at up to 80 degrees; the order given is no help."""
    corners = np.array([[-0.4, -0.3, 0.0], [0.4, -0.3, 0.0], [0.4, 0.3, 0.0], [-0.4, 0.3, 0.0]])
    low, high = quad(corners), quad(corners * 0.8 + [0.05, 0.02, 0.0], turned)
    wrong = pixels = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.5, 4.0)]))
        # The second shape stands elsewhere in its own frame, so that its plane is rounded in another way.
        shift = translation(*rng.uniform(-1.0, 1.0, 2), 0.0)
        moved = Shape(tuple(Part("p", frozen_array(p.vertices - shift[:3, 3]), p.faces) for p in high.parts))
        things = [Placed(9, moved, T @ shift), Placed(4, low, T)]
        seen = renderer.draw(things, APPEARANCE, camera())
        inside = renderer.draw(things[1:], APPEARANCE, camera()).region == 4
        wrong += int((inside & (seen.region != 4)).sum())
        pixels += int(inside.sum())
    assert pixels > 500_000
    assert wrong == 0


def test_the_base_of_a_thing_on_a_table_belongs_to_the_table_seen_from_below(renderer):
    """A single-sided table top without thickness, and a box that stands on it with no gap, seen from under the table."""
    top = Placed(2, quad([[-0.5, -0.4, 0.7], [0.5, -0.4, 0.7], [0.5, 0.4, 0.7], [-0.5, 0.4, 0.7]]), np.eye(4))
    box = Placed(3, shape_of(trimesh.creation.box((0.2, 0.15, 0.1))), translation(0.03, 0.02, 0.75))
    beyond = Placed(4, shape_of(trimesh.creation.box((0.2, 0.2, 0.1))), translation(0.5, 0.0, 0.75))
    view = camera(T=orbit_pose(np.array([0.0, 0.0, 0.7]), -0.6, 0.4, 1.2))
    seen = renderer.draw([box, beyond, top], APPEARANCE, view)
    depth, region, _ = cast_view([box, beyond, top], view)
    assert not (region == 3).any()
    assert (region == 4).sum() > 1000, "half of the second box hangs over the edge"
    same = seen.region == region
    assert (raycast.edge_distance_px([box, beyond, top], view, np.argwhere(~same)) < 1 / 64).all()
    assert np.abs(seen.depth_m - depth)[same].max() * 1e3 < 0.05


def test_a_gap_of_a_twentieth_of_a_millimetre_is_a_gap(renderer):
    """A tile that lies 0.05 mm above a table is seen whole, although its region id is the higher one."""
    table = Placed(2, facing(2.0, 1.0), EYE)
    tile = Placed(40, facing(2.0, 0.201), translation(0, 0, -5e-5))
    seen = renderer.draw([table, tile], APPEARANCE, camera())
    v, u = np.mgrid[0:480, 0:640] + 0.5
    inside = (np.abs(u - 320) < 0.201 / 2 * 525) & (np.abs(v - 240) < 0.201 / 2 * 525)
    np.testing.assert_array_equal(seen.region == 40, inside)


def test_what_is_nearer_than_the_near_plane_is_not_seen_by_renderer_or_rays(renderer):
    assert programs.NEAR_M == raycast.NEAR_M
    things = [Placed(3, facing(0.049), EYE), Placed(4, facing(0.051, 0.02), EYE), Placed(5, facing(1.0), EYE)]
    seen = renderer.draw(things, APPEARANCE, camera(small(64, 64)))
    depth, region, _ = cast_view(things, camera(small(64, 64)))
    assert set(np.unique(region)) == {4, 5}
    np.testing.assert_array_equal(seen.region, region)
    np.testing.assert_allclose(seen.depth_m, depth, atol=1e-6)


def test_where_nothing_is_hit_region_and_depth_are_zero_and_the_background_shows(renderer):
    seen = renderer.draw([], APPEARANCE, camera(small(5, 4)))
    assert not seen.region.any() and not seen.depth_m.any()
    expected = np.round(encode_srgb(np.array(APPEARANCE.background)) * 255)
    np.testing.assert_array_equal(seen.rgb, np.broadcast_to(expected, (4, 5, 3)))


def test_every_region_id_of_a_byte_comes_back(renderer):
    """255 squares side by side in front of a larger one of id 1, each a region of its own."""
    spots = {i: ((i % 16 - 7.5) / 10.0, (i // 16 - 7.5) / 10.0) for i in range(2, 256)}
    things = [Placed(i, facing(1.0, 0.04), translation(x, y, 0.0)) for i, (x, y) in spots.items()]
    seen = renderer.draw([*things, Placed(1, facing(1.1), EYE)], WHITE, camera(small(320, 320)))
    for i, (x, y) in spots.items():
        row, column = int(160 + 160 * y), int(160 + 160 * x)
        assert seen.region[row, column] == i
    assert set(np.unique(seen.region)) == set(range(1, 256)), "and nothing is blended between neighbours"
