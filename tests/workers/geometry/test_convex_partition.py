"""Convex partitions of plane outlines, against shapely's areas and hulls."""

import numpy as np
import pytest
import shapely

from workers.geometry.lathe_decomposition import partition_outlines

L_SHAPE = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], dtype=np.float64)
STAR = np.array([(np.cos(k * np.pi / 7) * r, np.sin(k * np.pi / 7) * r) for k, r in enumerate([2.0, 0.7] * 7)])
COMB = np.array([(x, y) for k in range(5) for x, y in ((k, 0.0), (k + 0.5, 0.0), (k + 0.5, -2.0), (k + 1.0, -2.0))])
OUTLINES = {"l": L_SHAPE, "star": STAR, "comb": np.concatenate([COMB, [(5.0, 1.0), (0.0, 1.0)]])}


def polygons(outline, tolerance=0.0):
    return [shapely.Polygon(outline[cell]) for cell in partition_outlines(outline[None], tolerance)]


@pytest.mark.parametrize("name", OUTLINES)
def test_cells_are_convex_and_tile_the_outline(name):
    cells, whole = polygons(OUTLINES[name]), shapely.Polygon(OUTLINES[name])
    assert all(cell.is_valid for cell in cells)
    assert all(cell.convex_hull.area - cell.area < 1e-12 for cell in cells)
    assert sum(cell.area for cell in cells) == pytest.approx(whole.area, rel=1e-12)
    assert (
        shapely.union_all([shapely.set_precision(cell, 1e-9) for cell in cells]).symmetric_difference(whole).area < 1e-7
    )


def test_there_is_at_most_one_cell_more_than_reflex_corners():
    assert len(polygons(L_SHAPE)) == 2
    assert len(polygons(STAR)) <= 8


def test_a_cut_that_later_cuts_made_needless_is_taken_out():
    """The shortest diagonals of a plus cut off all four arms; two of them and the middle are one bar."""
    plus = [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (2, 2), (2, 3), (1, 3), (1, 2), (0, 2), (0, 1), (1, 1)]
    cells = polygons(np.array(plus, dtype=np.float64))
    assert sorted(cell.area for cell in cells) == pytest.approx([1.0, 1.0, 3.0])


def test_what_is_convex_is_one_cell():
    circle = np.array([(np.cos(t), np.sin(t)) for t in np.linspace(0, 2 * np.pi, 60, endpoint=False)])
    assert len(polygons(circle)) == 1


def test_a_shallow_arc_is_kept_whole_only_within_the_tolerance():
    """Each of its corners is 0.0004 deep, all together 0.04: the hull must not reach over it by more than asked."""
    x = np.linspace(-1.0, 1.0, 21)
    arc = np.stack([x, 0.04 * (x * x - 1.0)], axis=1)[::-1]
    outline = np.concatenate([arc, [(-1.0, -2.0), (1.0, -2.0)]])
    assert len(polygons(outline, 0.041)) == 1
    for cell in polygons(outline, 0.01):
        over = cell.convex_hull.difference(shapely.Polygon(outline))
        assert over.buffer(-0.0051).is_empty
    assert len(polygons(outline, 0.01)) > 1


def test_outlines_that_are_cut_alike_are_all_convex():
    """The second has a reflex corner where the first is straight."""
    first = np.array([(0, 0), (2, 0), (2, 1), (2, 2), (0, 2)], dtype=np.float64)
    second = np.array([(0, 0), (2, 0), (1, 1), (2, 2), (0, 2)], dtype=np.float64)
    found = partition_outlines(np.stack([first, second]), 1e-9)
    assert len(found) == 2
    for outline in (first, second):
        cells = [shapely.Polygon(outline[cell]) for cell in found]
        assert all(cell.convex_hull.area - cell.area < 1e-12 for cell in cells)
        assert sum(cell.area for cell in cells) == pytest.approx(shapely.Polygon(outline).area)
