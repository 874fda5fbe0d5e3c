"""The ray caster's loops against polygons cut by shapely and the same formulas in numpy, to the last bit."""

import numpy as np
import shapely

from schemas.scene.view import Intrinsics
from workers.geometry.camera import unproject
from workers.geometry.raycast import keep_nearer, meet_planes, pixel_rays, pixels_between, row_spans

K = Intrinsics(width=160, height=120, fx=130.0, fy=140.0, cx=77.3, cy=62.1)


def test_the_span_of_a_row_is_that_of_the_triangles_in_it_and_in_the_rows_beside_it():
    """Triangles in and around the image, some with a level edge; else their corners lie over a row apart."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        u, v = rng.uniform(-60, 220, 6), np.array([-20.0, 17.3, 60.4, 60.4, 101.5, 140.0])
        v += rng.integers(-9, 9)
        faces = rng.permutation(6).reshape(2, 3)
        first, end = row_spans(u, v, faces, K.width, K.height)
        triangles = shapely.multipolygons([shapely.polygons(np.stack([u, v], axis=1)[face]) for face in faces])
        for row in range(K.height):
            parts = [shapely.intersection(t, shapely.box(-999, row - 1, 999, row + 2)) for t in triangles.geoms]
            left, _, right, _ = shapely.total_bounds(parts)
            if np.isnan(left):
                assert end[row] <= first[row]
                continue
            assert abs(first[row] - np.clip(np.floor(left) - 1, 0, K.width)) <= 1
            assert abs(end[row] - np.clip(np.ceil(right) + 1, 0, K.width)) <= 1


def test_every_pixel_with_its_centre_in_a_small_triangle_is_in_a_span():
    rng = np.random.default_rng(5)
    corners = rng.uniform(-5, 25, (400, 1, 2)) + rng.uniform(-2, 2, (400, 3, 2))
    corners[::4, :, 1] = corners[::4, :1, 1]  # level slivers
    u, v = corners.reshape(-1, 2).T.copy()
    centres = shapely.points(np.argwhere(np.ones((20, 20)))[:, ::-1] + 0.5)
    for face in np.arange(1200).reshape(-1, 1, 3):
        inside = shapely.intersects(shapely.polygons(np.stack([u, v], axis=1)[face[0]]), centres)
        cast = pixels_between(*row_spans(u, v, face, 20, 20), 20)
        assert set(np.flatnonzero(inside)) <= set(cast.tolist())


def test_pixels_between_columns_are_numbered_row_by_row():
    rng = np.random.default_rng(1)
    first, end = rng.integers(0, 12, 30), rng.integers(0, 12, 30)
    columns = np.arange(12)
    expected = np.flatnonzero((columns >= first[:, None]) & (columns < end[:, None]))
    np.testing.assert_array_equal(pixels_between(first, end, 12), expected)


def test_rays_of_pixels_are_those_of_unproject():
    pixels = np.random.default_rng(2).permutation(K.width * K.height)[:1000]
    origins, directions = pixel_rays(pixels, K.width, (K.fx, K.fy, K.cx, K.cy), 0.05)
    expected = unproject(*np.divmod(pixels, K.width), np.ones(1000), K)
    np.testing.assert_array_equal(directions, expected)
    np.testing.assert_array_equal(origins, 0.05 * expected)


def test_distances_and_cosines_are_those_of_numpy_to_the_last_bit():
    rng = np.random.default_rng(3)
    normals, offsets = rng.normal(size=(50, 3)), rng.normal(size=50)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals[7] = 0.0  # a face without an area
    face = rng.integers(-1, 50, 5000).astype(np.int32)
    origins, directions = rng.normal(size=(5000, 3)), rng.normal(size=(5000, 3))
    distance, cosine, without = meet_planes(face, (normals, offsets), origins, directions, 1e-2)
    n, hit = normals[face], face >= 0
    towards, length = np.einsum("ij,ij->i", n, directions), np.sqrt(np.einsum("ij,ij->i", directions, directions))
    slant = np.abs(towards) / length
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = np.where(slant > 1e-2, (offsets[face] - np.einsum("ij,ij->i", n, origins)) / towards, np.nan)
    np.testing.assert_array_equal(distance, np.where(hit, exact, np.inf))
    np.testing.assert_array_equal(cosine, np.where(hit, slant, 0.0))
    assert without == np.isnan(distance).sum() > 100


def test_a_hit_replaces_another_where_it_is_nearer_by_more_than_the_gap_over_its_cosine():
    rng = np.random.default_rng(4)
    so_far = rng.choice([1.0, 2.0, np.inf], 5000)
    best = so_far.copy(), np.full(5000, 2, np.uint8), rng.uniform(0, 1, 5000).astype(np.float32)
    before = [array.copy() for array in best]
    rays = rng.permutation(5000)[:3000]
    distance = rng.choice([0.5, 1.0 - 1e-5, 1.0 - 1e-6, 1.0, 1.5, np.inf], 3000)
    cosine = np.where(np.isinf(distance), 0.0, rng.choice([1.0, 0.9, 0.05, 1e-9], 3000))
    keep_nearer(best, rays, (distance, cosine), 5, 1e-6, 1e-6)
    won = distance + 1e-6 / np.maximum(cosine, 1e-6) < before[0][rays]
    for after, old, new in zip(best, before, (distance, 5, cosine), strict=True):
        expected = old.copy()
        expected[rays[won]] = np.broadcast_to(new, won.shape)[won]
        np.testing.assert_array_equal(after, expected)
    assert 500 < won.sum() < 2500
