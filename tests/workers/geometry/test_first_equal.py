"""Equal rows, against a sort of them."""

import numpy as np
import pytest

from workers.geometry.mesh import first_equal


def by_sorting(rows):
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first[inverse.ravel()]


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_the_points_of_a_lattice_are_found_again(scale):
    """They share most of their bits, which is the hardest case for a hash of them."""
    lattice = np.stack(np.meshgrid(*[np.arange(-4.0, 5.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * scale
    rows = np.random.default_rng(4).permutation(np.repeat(lattice, 3, axis=0))
    assert np.array_equal(first_equal(rows.view(np.int64)), by_sorting(rows))


@pytest.mark.parametrize("column", [0, 1, 2])
def test_rows_that_differ_in_one_number_are_not_equal(column):
    """Of so many rows some have the same place in the table."""
    rows = np.full((5000, 3), 7)
    rows[:, column] = np.random.default_rng(column).choice(2**40, 5000, replace=False)
    assert np.array_equal(first_equal(rows), np.arange(5000))
    assert np.array_equal(first_equal(np.concatenate([rows, rows[::-1]]))[5000:], np.arange(5000)[::-1])


def test_no_row_and_one_row():
    assert first_equal(np.zeros((0, 3), np.int64)).tolist() == []
    assert first_equal(np.ones((1, 3), np.int64)).tolist() == [0]
