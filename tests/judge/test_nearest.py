"""Distances of FCL against closed forms and against every pair of triangles; depths against FCL's own of convex bodies."""

import fcl
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from schemas.scene.shape import Mesh
from tests.judge.nearest import distance_m, distances_to_faces, winding_numbers
from tests.judge.overlap import least_width_m, overlap_m
from tests.judge.solids import ball, bowl, box, moved, rotation
from tests.judge.surface import Surface, surface

PLACES = [(0.0, 0.0, 0.0), (1.0, -1.0, 1.0)]
GAPS_UM = [0.1, 1.0, 10.0, 100.0]


def placed(mesh: Mesh, where: tuple[float, ...], degrees: float = 33.0) -> Surface:
    return surface(moved(mesh, rotation((1.0, 2.0, -1.0), degrees), where))


@pytest.mark.parametrize("where", PLACES)
@pytest.mark.parametrize("gap_um", GAPS_UM)
def test_the_gap_of_nested_bowls_balls_and_crossing_edges_is_exact(where, gap_um):
    gap = gap_um * 1e-6
    upper = moved(bowl(0.06, 0.005), at=(0.0, 0.0, 0.005 + gap))  # bottom over bottom, nearer than wall to wall
    ridge = moved(box((0.05, 0.05, 0.3)), rotation((1.0, 0.0, 0.0), 90.0) @ rotation((0.0, 0.0, 1.0), 45.0))
    across = moved(moved(ridge, rotation((0.0, 0.0, 1.0), 90.0)), at=(0.0, 0.0, 0.05 * 2**0.5 + gap))
    pairs = [
        (bowl(0.06, 0.005), upper, gap * np.cos(np.arctan(1.0 / np.cos(np.pi / 64)))),
        (ball(0.05), ball(0.03, (0.0, 0.0, 0.08 + gap)), gap),
        (ridge, across, gap),
    ]
    for a, b, expected in pairs:
        assert distance_m(placed(a, where), placed(b, where)) <= gap + 1e-12
        if b is not upper:
            assert distance_m(placed(a, where), placed(b, where)) == pytest.approx(expected, abs=1e-12)


def cloud(rng: np.random.Generator, count: int = 24) -> Mesh:
    points = rng.standard_normal((count, 3)) * [0.03, 0.02, 0.04]
    hull = ConvexHull(points)
    middle = points.mean(axis=0)
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    out = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - middle) > 0.0
    return Mesh(points, np.where(out[:, None], hull.simplices, hull.simplices[:, ::-1]).astype(np.int32))


def test_the_distance_of_random_bodies_is_the_least_of_all_pairs_of_edges_and_of_corners_to_faces():
    rng = np.random.default_rng(5)
    for _ in range(40):
        a = surface(cloud(rng))
        b = surface(moved(cloud(rng), at=tuple(rng.standard_normal(3) * 0.1 + [0.12, 0.0, 0.0])))
        found = distance_m(a, b)
        least = min(distances_to_faces(a.vertices, b.corners).min(), distances_to_faces(b.vertices, a.corners).min())
        least = min(least, _edges_apart(a, b))
        if overlap_m(a, b) == 0.0:
            assert found == pytest.approx(least, abs=1e-12)
        else:
            assert found == 0.0


def _edges_apart(a: Surface, b: Surface) -> float:
    """The least distance of two edges where it is between their insides; the corners are in another's keeping."""
    p, q = (s.vertices[s.edges] for s in (a, b))
    u, v, w = (p[:, 1] - p[:, 0])[:, None], (q[:, 1] - q[:, 0])[None], p[:, None, 0] - q[None, :, 0]
    uu, uv, vv, uw, vw = ((x * y).sum(axis=-1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    area = uu * vv - uv**2
    s, t = (uv * vw - vv * uw) / area, (uu * vw - uv * uw) / area
    inside = (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    apart = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    return float(np.where(inside, apart, np.inf).min())


def _penetration_m(a: Surface, b: Surface) -> float:
    """FCL's own depth of two convex bodies."""
    pair = []
    for each in (a, b):
        faces = np.column_stack([np.full(len(each.faces), 3), each.faces]).reshape(-1)
        pair.append(fcl.CollisionObject(fcl.Convex(each.vertices, len(each.faces), faces), fcl.Transform()))
    answer = fcl.CollisionResult()
    fcl.collide(*pair, fcl.CollisionRequest(num_max_contacts=1, enable_contact=True), answer)
    return float(answer.contacts[0].penetration_depth)


def test_shallow_depths_of_random_convex_bodies_agree_with_the_penetration_by_fcl():
    """A corner or an edge in a face: the piece is as deep along the face's normal as the body must be moved."""
    rng = np.random.default_rng(6)
    for deep in np.geomspace(1e-6, 1e-4, 12):
        body = surface(cloud(rng))
        slab = surface(box((0.5, 0.5, 0.1), (0.0, 0.0, body.bounds[0, 2] - 0.05 + deep)))
        assert overlap_m(body, slab) == pytest.approx(deep, rel=1e-6)
        assert _penetration_m(body, slab) == pytest.approx(deep, rel=1e-3)


@pytest.mark.parametrize("where", PLACES)
def test_the_least_width_of_a_sliver_is_exact(where):
    """A slab 5 nm thick, a leaning one, and a tetrahedron between two crossing edges."""
    corners = np.array([(x, y, z) for x in (0.0, 0.1) for y in (0.0, 0.2) for z in (0.0, 5e-9)])
    turn = rotation((1.0, 1.0, 3.0), 20.0)
    assert least_width_m(corners @ turn.T + where) == pytest.approx(5e-9, rel=1e-6)
    crossing = np.array([(-0.1, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, -0.1, 1e-6), (0.0, 0.1, 1e-6)])
    assert least_width_m(crossing @ turn.T + where) == pytest.approx(1e-6, rel=1e-6)


def test_the_distance_to_a_triangle_is_that_to_its_inside_its_edge_or_its_corner():
    triangle = np.array([[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]])
    points = np.array([(0.2, 0.2, 0.5), (0.5, -2.0, 0.0), (-3.0, -4.0, 0.0), (1.0, 1.0, 0.0)])
    assert distances_to_faces(points, triangle) == pytest.approx([0.5, 2.0, 5.0, 2**-0.5])


def test_triangles_go_once_round_what_is_inside():
    cube = surface(box((1.0, 1.0, 1.0)))
    assert winding_numbers(np.array([(0.0, 0.0, 0.0), (0.6, 0.0, 0.0)]), cube.corners) == pytest.approx([1.0, 0.0])
