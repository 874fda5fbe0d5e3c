"""How noisy a capture's depth is, by its own residuals: the sigma of a patch, and how much alike the patches of a view err.

Errors of depth are alike over an image (the lens, the distance, the shutter). Hundreds of patches that err together know no
more than a few; so the variance of a term is inflated by what the misfit of whole views says over that of independent patches.
"""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array

MAD = 1.4826
FLOOR_M = 2e-4
"""No patch is taken to be better than this at 1 m: stored depth has a step of 1 mm, and its errors are not all seen."""
FEW_VIEWS = 4
INFLATION_OF_FEW = 30.0
"""Inflation where fewer views than this can tell: about as if a view's patches erred as one."""


def patch_sigma(residual_m: Array, growth: Array) -> float:
    """Sigma of a patch at 1 m, metres, from residuals [P] that grow as `growth` [P] (the distance squared)."""
    return max(FLOOR_M, MAD * float(np.median(np.abs(residual_m / growth)))) if len(residual_m) else FLOOR_M


def inflation(residual: Array, by_view: Array, view: NDArray[np.int64], pose_covariance: Array) -> float:
    """How many times larger the variance of a term is than its patches' sigma says, at least 1.

    residual [N] in sigma, by_view [N, k] derivatives by what a view's patches tell (k numbers), view [N] index;
    pose_covariance [V, k, k]: what is not known of each view beforehand, which makes residuals too. The misfit of a view,
    g^T H^-1 g, is k on average where the patches are independent; the median over the views resists a bad one. It is
    squared: what errs alike within a view does so between views too, of which the misfit of single views shows nothing.
    """
    ratios = []
    for number in np.unique(view):
        J, r = by_view[view == number], residual[view == number]
        strength, directions = np.linalg.eigh(J.T @ J)
        kept = strength > 1e-6 * max(float(strength[-1]), 1e-12)
        rank = int(kept.sum())
        if len(r) < 2 * rank or not rank:
            continue
        weighted = 1.0 / (1.0 + (r / 3.0) ** 2)
        along = directions[:, kept].T @ (J.T @ (weighted * r))
        misfit = float((along**2 / strength[kept]).sum())
        known = float(np.trace(J.T @ J @ pose_covariance[number]))
        ratios.append((misfit - known) / (rank * _median_of_chi_square(rank)))
    if len(ratios) < FEW_VIEWS:
        return INFLATION_OF_FEW
    return max(1.0, float(np.median(ratios))) ** 2


def _median_of_chi_square(degrees: int) -> float:
    """Median over mean of a chi-square distribution (Wilson and Hilferty 1931)."""
    return (1 - 2 / (9 * degrees)) ** 3
