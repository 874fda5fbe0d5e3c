import numpy as np
import pytest

from workers.capture.poses.terms import Rows, normal_equations

V, N = 4, 60


def dense(rows):
    """[N, 6 V + 9]: the Jacobian written out."""
    J = np.zeros((len(rows.residual), 6 * V + 9))
    for n in range(len(J)):
        J[n, 6 * rows.first[n] : 6 * rows.first[n] + 6] = rows.by_first[n]
        if rows.second[n] >= 0:
            J[n, 6 * rows.second[n] : 6 * rows.second[n] + 6] = rows.by_second[n]
    J[:, 6 * V :] = rows.by_shared
    return J


def made(seed, paired):
    rng = np.random.default_rng(seed)
    first = rng.integers(0, V, N)
    second = (first + rng.integers(1, V, N)) % V if paired else np.full(N, -1)
    return Rows(
        rng.normal(size=N),
        first,
        rng.normal(size=(N, 6)),
        second,
        rng.normal(size=(N, 6)) * (second >= 0)[:, None],
        rng.normal(size=(N, 9)),
        rng.uniform(0.1, 1, N),
        0.0,
    )


def test_blocks_add_up_to_the_dense_product():
    terms = [made(0, False), made(1, True)]
    matrix, gradient = normal_equations(terms, V)
    J = np.concatenate([dense(rows) for rows in terms])
    w, r = (np.concatenate([getattr(rows, name) for rows in terms]) for name in ("weight", "residual"))
    assert matrix == pytest.approx(J.T @ (w[:, None] * J))
    assert gradient == pytest.approx(J.T @ (w * r))


def test_no_terms_are_no_information():
    matrix, gradient = normal_equations([], V)
    assert matrix.shape == (33, 33) and not matrix.any() and not gradient.any()
