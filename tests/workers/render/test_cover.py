"""What a table's top hides, against straight lines to the eye, and images with and without what is left out."""

import numpy as np
import pytest

from schemas.scene.scene import Placed
from tests.workers.render.looks import FLAT, FOUR, RASTER
from tests.workers.render.random_scenes import APPEARANCE, camera, floor, small, table_shape
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import translation
from workers.render.raster import draw_calls
from workers.render.raster.batches import Cover, find_cover, seen_ranges

SQUARE = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
RING = [[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]]


def level(points: object, faces: object, z: float = 0.5) -> np.ndarray:
    """Triangles [F, 3, 3] float32 on one level."""
    flat = np.array(points, np.float32)
    return np.column_stack([flat, np.full(len(flat), z, np.float32)])[np.array(faces)]


def disc(corners: int) -> np.ndarray:
    angles = 2 * np.pi * np.arange(corners) / corners
    points = np.vstack([np.column_stack([np.cos(angles), 0.6 * np.sin(angles)]), [[0.0, 0.0]]])
    return level(points, [[corners, n, (n + 1) % corners] for n in range(corners)])


def test_a_convex_top_without_holes_is_a_cover_and_its_sides_are_its_outline():
    for triangles, sides in ((level(SQUARE, [[0, 1, 2], [0, 2, 3]]), 4), (disc(31), 31)):
        cover = find_cover(triangles)
        assert cover is not None and len(cover.sides) == sides and cover.level_m == pytest.approx(0.5)
        np.testing.assert_allclose(np.hypot(*cover.sides[:, :2].T), 1.0)
        assert (cover.sides[:, 2] < 0).all(), "the middle is inside"


@pytest.mark.parametrize(
    ("points", "faces"),
    [
        ([*SQUARE, [0, 0]], [[0, 1, 4], [1, 2, 4], [2, 3, 4]]),  # not convex
        ([*SQUARE, *[[x + 3, y] for x, y in SQUARE]], [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),  # two islands
        ([*SQUARE, [0, -1]], [[0, 4, 3], [0, 1, 2], [0, 2, 3]]),  # one face over two
        ([*SQUARE, *[[x / 3, y / 3] for x, y in SQUARE]], RING),  # a hole
        ([*SQUARE, [0, 0.1]], [[0, 1, 2], [0, 4, 3], [4, 2, 3]]),  # a gap along the diagonal
    ],
)
def test_tops_with_gaps_holes_and_hollows_are_no_cover(points, faces):
    assert find_cover(level(points, faces)) is None


def test_what_is_left_out_is_hidden_and_nearly_all_that_is_hidden_is_left_out():
    """Points of triangles, against whether the line to the eye meets the square of the cover."""
    rng, cover = np.random.default_rng(3), find_cover(level(SQUARE, [[0, 1, 2], [0, 2, 3]]))
    assert cover is not None
    found = []
    for _ in range(40):
        eye = np.array([*rng.uniform(-4, 4, 2), rng.uniform(-0.5, 4.0)])
        middles = rng.uniform([-1.5, -1.5, -1.0], [1.5, 1.5, 0.55], (300, 1, 3))
        triangles = (middles + rng.normal(0.0, 0.05, (300, 3, 3))).astype(np.float32)
        seen = drawn(triangles, cover, eye)
        weights = rng.dirichlet(np.ones(3), 30)
        points = np.concatenate([triangles, np.einsum("ps,fsd->fpd", weights, triangles)], axis=1).astype(float)
        share = (cover.level_m - eye[2]) / (points[..., 2] - eye[2])
        met = eye[:2] + share[..., None] * (points[..., :2] - eye[:2])
        hidden = ((share > 0) & (share < 1) & (abs(met) < 1).all(axis=2)).all(axis=1)
        assert not (hidden < ~seen).any(), "something that is seen is left out"
        found.append((hidden.sum(), (~seen).sum()))
    hidden_count, left_out = np.sum(found, axis=0)
    assert left_out > 0.8 * hidden_count > 500


def drawn(triangles: np.ndarray, cover: Cover, eye: np.ndarray) -> np.ndarray:
    """Whether each of triangles [F, 3, 3] is drawn, looked at alone, so that none is drawn for its neighbours."""
    faces = np.arange(3, dtype=np.uint32)[None]
    return np.array([bool(seen_ranges(triangle, faces, cover, eye)) for triangle in triangles])


@pytest.mark.parametrize("look", [FLAT, RASTER, FOUR], ids=["flat", "raster", "four samples"])
def test_images_are_the_same_with_all_that_is_hidden(renderer, monkeypatch, look):
    """Tables from far and near, from above, from their own level and from below."""
    rng, drawn_indices, own = np.random.default_rng(11), [], renderer._draw

    def draw(call, textured):
        drawn_indices.append(call.count)
        own(call, textured)

    monkeypatch.setattr(renderer, "_draw", draw)
    counts = {True: 0, False: 0}
    for _ in range(6):
        shape, height = table_shape(rng)
        things = [floor(), Placed(2, shape, translation(0.0, 0.0, 0.0))]
        for inclination in (1.3, 0.8, 0.5, 0.15, 0.0, -0.4):
            middle, away_m = np.array([0.0, 0.0, height]), rng.uniform(0.3, 3.0)
            view = camera(small(96, 72), orbit_pose(middle, inclination, rng.uniform(-3, 3), away_m))
            images = []
            for hides in (True, False):
                with monkeypatch.context() as patch:
                    if not hides:
                        patch.setattr(draw_calls, "seen_ranges", lambda positions, faces, cover, eye: [(0, len(faces))])
                    drawn_indices.clear()
                    images.append(renderer.draw(things, APPEARANCE, view, *look))
                    counts[hides] += sum(drawn_indices)
            for name in ("rgb", "depth_m", "region"):
                np.testing.assert_array_equal(*(getattr(image, name) for image in images))
    assert counts[True] < 0.95 * counts[False]
