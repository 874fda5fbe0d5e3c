"""Rows of a sparse least-squares problem over the poses of V views and the parameters that they share."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.capture.poses.shared import NAMES

POSE = 6
SHARED = len(NAMES)


@dataclass(frozen=True, eq=False)
class Rows:
    """N residuals in standard deviations, each of one view or of two.

    first, second [N]: index of the view (second -1 for none); by_first, by_second [N, 6] derivatives by small motions;
    by_shared [N, 9]; weight [N]: robust weight over the inflation of the term's variance; cost: robust, of all rows.
    """

    residual: Array
    first: NDArray[np.int64]
    by_first: Array
    second: NDArray[np.int64]
    by_second: Array
    by_shared: Array
    weight: Array
    cost: float


def normal_equations(terms: Sequence[Rows], views: int) -> tuple[Array, Array]:
    """(J^T W J [D, D], J^T W r [D]), D = 6 V + 9, the shared parameters last."""
    size = POSE * views + SHARED
    blocks = np.zeros((views, POSE, views, POSE))
    mixed = np.zeros((views, POSE, SHARED))
    shared, gradient = np.zeros((SHARED, SHARED)), np.zeros((views, POSE))
    shared_gradient = np.zeros(SHARED)
    for rows in terms:
        weighted = rows.by_shared * rows.weight[:, None]
        shared += weighted.T @ rows.by_shared
        shared_gradient += weighted.T @ rows.residual
        _add(rows, rows.first, rows.by_first, blocks, mixed, gradient)
        if (rows.second >= 0).any():
            _add(rows, rows.second, rows.by_second, blocks, mixed, gradient)
            _add_pairs(rows, blocks)
    matrix = np.zeros((size, size))
    poses = POSE * views
    matrix[:poses, :poses] = blocks.reshape(poses, poses)
    matrix[:poses, poses:] = mixed.reshape(poses, SHARED)
    matrix[poses:, :poses] = matrix[:poses, poses:].T
    matrix[poses:, poses:] = shared
    return matrix, np.concatenate([gradient.ravel(), shared_gradient])


def _add(rows: Rows, view: NDArray[np.int64], by_view: Array, blocks: Array, mixed: Array, gradient: Array) -> None:
    """Adds what one side of the rows says of its own view."""
    order = np.argsort(view, kind="stable")
    order = order[view[order] >= 0]
    starts = np.flatnonzero(np.diff(view[order], prepend=-1))
    for start, stop in zip(starts, [*starts[1:], len(order)], strict=True):
        index = order[start:stop]
        number, J = view[index[0]], by_view[index]
        weighted = J * rows.weight[index, None]
        blocks[number, :, number] += weighted.T @ J
        mixed[number] += weighted.T @ rows.by_shared[index]
        gradient[number] += weighted.T @ rows.residual[index]


def _add_pairs(rows: Rows, blocks: Array) -> None:
    """Adds what rows of two views say of both."""
    index = np.flatnonzero(rows.second >= 0)
    key = rows.first[index] * len(blocks) + rows.second[index]
    order = index[np.argsort(key, kind="stable")]
    outer = (rows.by_first[order] * rows.weight[order, None])[:, :, None] * rows.by_second[order][:, None]
    starts = np.flatnonzero(np.diff(np.sort(key, kind="stable"), prepend=-1))
    sums = np.add.reduceat(outer, starts, axis=0)
    first, second = rows.first[order[starts]], rows.second[order[starts]]
    for a, b, block in zip(first, second, sums, strict=True):
        blocks[a, :, b] += block
        blocks[b, :, a] += block.T
