"""What is particular to each built-in category."""

import math

import numpy as np
import pytest
import trimesh
from shapely.geometry import Polygon

from tests.workers.assets.oracles import hits, welded
from workers.assets.builtin.bottle import BODY, CAP, LABEL
from workers.assets.builtin.box import EXTRA, LID, SIDE, make_lidded
from workers.assets.builtin.camera import DISPLAY, GLASS, LENS, SHELL
from workers.assets.builtin.can import SIDE as SIDE_can
from workers.assets.builtin.can import TOP
from workers.assets.builtin.crockery import HANDLE, _body, _handle
from workers.assets.builtin.jar import _glass_jar, _pot
from workers.assets.builtin.laptop import SCREEN
from workers.assets.builtin.make import make_model
from workers.assets.builtin.parts import cut_into_parts
from workers.assets.builtin.solid import union
from workers.assets.builtin.sweeps import INSIDE, OUTSIDE
from workers.assets.builtin.table import FRAME, LEG, TableSize, make_base
from workers.assets.builtin.table import TOP as TOP_table


def bottom_heights(category: str, index: int) -> tuple[float, float]:
    """Heights, true metres, at which a ray down through the mouth meets the inner and the outer side of the bottom."""
    solid = make_model(category, 0, index).solid
    top = float(solid.vertices[:, 2].max())
    distances, sides = hits(solid.vertices, solid.faces, np.array([1e-4, 2e-4, top + 1.0]), np.array([0.0, 0.0, -1.0]))
    assert sides.tolist() == [-1.0, 1.0]
    return top + 1.0 - float(distances[0]), top + 1.0 - float(distances[1])


@pytest.mark.parametrize("index", range(25))
def test_a_bottle_narrows_from_its_body_to_its_neck_and_is_closed_by_a_cap(index):
    solid = make_model("bottle", 0, index).solid
    corners = solid.vertices[solid.faces]
    height = solid.vertices[:, 2].max()
    cap = corners[solid.surface == CAP].reshape(-1, 3)
    body = corners[np.isin(solid.surface, (BODY, LABEL))].reshape(-1, 3)
    widths = [np.ptp(points[:, 0]) for points in (cap, body)]
    assert cap[:, 2].max() == height
    assert cap[:, 2].min() > 0.45 * height
    assert widths[0] <= widths[1] * 1.001
    rings = np.hypot(*body[body[:, 2] > body[:, 2].max() - 0.02 * height][:, :2].T)
    assert rings.max() < 0.5 * widths[1]


@pytest.mark.parametrize("index", range(25))
def test_a_bowl_is_wider_than_high_and_its_bottom_is_a_wall(index):
    inner, outer = bottom_heights("bowl", index)
    size = make_model("bowl", 0, index).solid.vertices
    assert 0.003 < inner - outer < 0.012
    assert outer > 0.0  # the foot ring lifts it
    assert size[:, 0].max() - size[:, 0].min() > 1.4 * size[:, 2].max()


@pytest.mark.parametrize("index", range(25))
def test_a_box_fills_most_of_its_bounding_box_but_has_a_seam_in_it(index):
    model = make_model("box", 0, index)
    whole = welded(cut_into_parts(model.solid, model.surfaces, np.zeros(3), 1.0))
    filled = whole.volume / whole.bounding_box.volume
    assert 0.55 < filled < 0.9999
    # The seam is a fold: some points lie deeper than the convex hull by at least half a millimetre.
    hull = whole.convex_hull
    outward, offset = hull.face_normals, -np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
    depth = -(whole.vertices @ outward.T + offset).max(axis=1)
    assert depth.max() > 0.0005


@pytest.mark.parametrize("seed", range(25))
def test_the_lid_overhangs_the_box_and_a_ribbon_goes_all_around(seed):
    solid = make_lidded(np.random.default_rng(seed)).solid
    corners = solid.vertices[solid.faces]
    lid, side = (corners[solid.surface == s].reshape(-1, 3) for s in (LID, SIDE))
    assert np.ptp(lid[:, 0]) > np.ptp(side[:, 0]) + 0.002
    assert lid[:, 2].min() > 0.4 * side[:, 2].max()
    ribbon = corners[solid.surface == EXTRA].reshape(-1, 3)
    if len(ribbon):
        assert np.ptp(ribbon[:, 0]) > np.ptp(lid[:, 0])
        assert ribbon[:, 2].min() == 0.0
        assert ribbon[:, 2].max() > lid[:, 2].max()
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert mesh.is_volume
    assert mesh.body_count == 1


def points_of(solid, *surfaces):
    return solid.vertices[solid.faces[np.isin(solid.surface, surfaces)]].reshape(-1, 3)


@pytest.mark.parametrize("index", range(25))
def test_the_lens_stands_out_in_front_with_its_glass_behind_its_rim_and_the_display_is_behind(index):
    solid = make_model("camera", 0, index).solid
    lens, glass, shell, display = (points_of(solid, s) for s in (LENS, GLASS, SHELL, DISPLAY))
    assert lens[:, 1].min() < shell[:, 1].min() - 0.004
    assert lens[:, 1].min() < glass[:, 1].min()
    assert display[:, 1].max() > shell[:, 1].max()


@pytest.mark.parametrize("index", range(25))
def test_only_the_base_of_the_body_touches_the_ground(index):
    solid = make_model("camera", 0, index).solid
    lowest = solid.vertices[:, 2].min()
    touching = {int(s) for s in solid.surface[(solid.vertices[solid.faces][:, :, 2] == lowest).any(axis=1)]}
    assert touching == {SHELL}
    assert points_of(solid, LENS)[:, 2].min() > 0.001


@pytest.mark.parametrize("index", range(25))
def test_a_can_is_round_and_its_lid_lies_below_its_rim_unless_it_has_a_cap(index):
    solid = make_model("can", 0, index).solid
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    assert (high - low)[0] == pytest.approx((high - low)[1], rel=1e-9)
    distances, _ = hits(solid.vertices, solid.faces, np.array([1e-4, 2e-4, 1.0]), np.array([0.0, 0.0, -1.0]))
    middle = 1.0 - distances[0]
    has_cap = bool((solid.surface == TOP).any())
    assert middle == pytest.approx(high[2]) if has_cap else middle < high[2] - 0.0008
    assert (solid.surface == SIDE_can).any()


@pytest.mark.parametrize("index", range(25))
def test_a_jar_is_open_down_to_a_bottom_as_thick_as_a_wall(index):
    inner, outer = bottom_heights("jar", index)
    assert 0.002 < inner - outer < 0.012
    assert outer < 0.004


@pytest.mark.parametrize("index", range(25))
def test_a_jar_has_a_neck(index):
    solid = make_model("jar", 0, index).solid
    points = solid.vertices[solid.faces[solid.surface == OUTSIDE]].reshape(-1, 3)
    radius, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2] / points[:, 2].max()
    neck = radius[(z > 0.78) & (z < 0.93)]
    assert neck.min() < 0.97 * radius[z < 0.75].max()


@pytest.mark.parametrize("make", [_glass_jar, _pot])
def test_no_wall_crosses_itself(make):
    for seed in range(300):
        assert Polygon(make(np.random.default_rng(seed)).profile).is_valid, seed


def normals_of(solid, surface):
    a, b, c = (solid.vertices[solid.faces[solid.surface == surface][:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    return across / np.linalg.norm(across, axis=1)[:, None], np.linalg.norm(across, axis=1)


@pytest.mark.parametrize("index", range(25))
def test_the_screen_faces_the_user_and_leans_back_between_5_and_40_degrees(index):
    solid = make_model("laptop", 0, index).solid
    normals, areas = normals_of(solid, SCREEN)
    facing = normals[areas.argmax()]
    assert facing[0] == pytest.approx(0, abs=1e-9)
    assert facing[1] < 0  # the user sits at -y
    lean = math.degrees(math.asin(facing[2]))
    assert 5.0 <= lean <= 40.0


@pytest.mark.parametrize("index", range(25))
def test_a_mug_is_open_down_to_a_bottom_as_thick_as_a_wall(index):
    inner, outer = bottom_heights("mug", index)
    height = make_model("mug", 0, index).solid.vertices[:, 2].max()
    assert 0.0 <= outer < 0.003
    assert 0.002 < inner - outer < 0.012
    assert inner < 0.15 * height


@pytest.mark.parametrize("index", range(25))
def test_the_handle_stays_out_of_the_hollow_and_leaves_room_for_a_finger(index):
    solid = make_model("mug", 0, index).solid
    points = solid.vertices[solid.faces[solid.surface == HANDLE]].reshape(-1, 3)
    inner = solid.vertices[solid.faces[solid.surface == INSIDE]].reshape(-1, 3)
    for low, high in ((0.1, 0.5), (0.5, 0.9)):  # compare radii at like heights
        z = solid.vertices[:, 2].max() * np.array([low, high])
        at = [p[(p[:, 2] >= z[0]) & (p[:, 2] <= z[1])] for p in (points, inner)]
        if len(at[0]) and len(at[1]):
            assert np.hypot(*at[0][:, :2].T).min() > np.hypot(*at[1][:, :2].T).max() - 0.012
    middle = 0.5 * (points[:, 2].min() + points[:, 2].max())
    distances, sides = hits(solid.vertices, solid.faces, np.array([1.0, 1e-5, middle]), np.array([-1.0, 0.0, 0.0]))
    gap = distances[2] - distances[1]  # from the inside of the handle to the wall
    assert sides[:3].tolist() == [-1, 1, -1]
    assert gap > 0.012


def test_no_wall_crosses_itself_and_no_handle_folds_at_its_bends():
    for seed in range(600):
        rng = np.random.default_rng(seed)
        wall = _body(rng)
        assert Polygon(wall.profile).is_valid, seed
        handle = _handle(rng, wall)
        rings = handle.vertices[:-2].reshape(-1, 12, 3)
        along = np.diff(rings, axis=0)  # from each ring to the next, at twelve places around
        middle = np.diff(rings.mean(axis=1), axis=0)[:, None]
        assert ((along * middle).sum(axis=2) > 0).all(), seed  # where it folds, its inner side runs back


@pytest.mark.parametrize("index", range(30))
def test_the_top_is_level_to_the_last_bit_of_the_right_thickness_and_under_every_place_of_an_object(index):
    solid = make_model("table", 0, index).solid
    top = solid.vertices[:, 2].max()
    assert 0.45 <= top <= 0.9
    size = np.ptp(solid.vertices, axis=0)
    assert 0.9 <= size[0] <= 1.8
    assert 0.8 <= size[1] <= 1.8
    for x in (-0.2501, 0.0003, 0.2502):
        for y in (-0.2487, 0.0007, 0.2493):  # off the lines along which round tops are cut
            distances, sides = hits(solid.vertices, solid.faces, np.array([x, y, 2.0]), np.array([0.0, 0.0, -1.0]))
            assert 2.0 - distances[0] == pytest.approx(top, abs=1e-12)
            assert sides[:2].tolist() == [-1, 1]
            assert distances[1] - distances[0] >= 0.0149
    flat = solid.vertices[solid.vertices[:, 2] > top - 1e-6]
    assert len(flat) > 8
    assert set(flat[:, 2]) == {top}


@pytest.mark.parametrize("round_top", [False, True])
def test_a_stand_reaches_from_the_ground_into_the_top_and_stays_below_it(round_top):
    plan = TableSize(1.2, 1.0, 0.03, 0.74, round_top)
    for seed in range(30):
        joined = union(make_base(np.random.default_rng(seed), plan))
        assert joined.vertices[:, 2].min() == 0.0
        assert plan.under < joined.vertices[:, 2].max() < plan.height
        assert (np.abs(joined.vertices[:, 0]) <= 0.5 * plan.width).all(), seed
        assert (np.abs(joined.vertices[:, 1]) <= 0.5 * plan.depth).all(), seed
        assert set(joined.surface) <= {LEG, FRAME}
        assert TOP_table not in joined.surface
