"""Likeness of a predicted colour image. Pure."""

import importlib.util
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array

SIGMA_PX, RADIUS_PX = 1.5, 5
"""The Gaussian window of 11 x 11 pixels of Wang et al. 2004."""

C1, C2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2

SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM from the full size to a 16th (Wang, Simoncelli and Bovik 2003, section 3.2)."""


def score_colour(
    predicted: NDArray[np.uint8], true: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None, flip: bool = True
) -> dict[str, float | None]:
    """Likeness of sRGB images [H, W, 3] uint8 of one size; with a mask [H, W], of its pixels.

    psnr_db: 10 log10(255^2 / mean square difference of codes), dB; inf where all are equal.
    ssim: mean structural similarity, 1 where equal (Wang, Bovik, Sheikh and Simoncelli 2004, eq. 13 with C3 = C2 / 2): Gaussian
    window of sigma 1.5 and 11 x 11 pixels, K1 = 0.01, K2 = 0.03, weighted moments; mean over the three channels and over the
    windows that lie in the image.
    ms_ssim: the same at five scales (Wang, Simoncelli and Bovik 2003, eq. 7): product of the mean contrast and structure at
    each scale, and of luminance too at the last, to the powers `SCALES`; a scale is the means of 2 x 2 pixels of the one before,
    an odd last row or column left out; a negative mean counts as 0.
    flip: mean FLIP of the whole image, 0 where equal (Andersson et al. 2020); None with a mask, where
    `flip` is false, and without flip-evaluator.

    nan where there is nothing to compare: no pixels (all), no whole window (ssim), none at the fifth scale (ms_ssim: images below
    176 pixels). A window counts by its middle pixel, at coarse scales by that pixel's share in the mask. Raises ValueError where
    sizes differ.
    """
    for image in (predicted, true):
        if image.shape != true.shape or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"colours are [H, W, 3] uint8 of one size, not {image.shape} {image.dtype}")
    weights = np.ones(true.shape[:2]) if mask is None else mask.astype(np.float64)
    if weights.shape != true.shape[:2]:
        raise ValueError(f"a mask of {weights.shape} pixels of an image of {true.shape[:2]}")
    a, b = predicted.astype(np.float64), true.astype(np.float64)
    error, (ssim, ms_ssim) = _mean((a - b) ** 2, weights), _similarities(a, b, weights)
    return {
        "psnr_db": math.inf if error == 0.0 else 10.0 * math.log10(255.0**2 / error),
        "ssim": ssim,
        "ms_ssim": ms_ssim,
        "flip": None if mask is not None or not flip else _flip(predicted, true),
    }


def _similarities(a: Array, b: Array, weights: Array) -> tuple[float, float]:
    """(SSIM, MS-SSIM) of images [H, W, 3] at pixels with weights [H, W]."""
    ssim, product = math.nan, 1.0
    for scale, exponent in enumerate(SCALES):
        if scale:
            a, b, weights = _halve(a), _halve(b), _halve(weights)
        if min(a.shape[:2]) <= 2 * RADIUS_PX:  # no whole window
            return ssim, math.nan
        inner = (slice(RADIUS_PX, -RADIUS_PX),) * 2
        luminance, contrast = (each[inner] for each in _similarity_maps(a, b))
        whole, part = _mean(luminance * contrast, weights[inner]), _mean(contrast, weights[inner])
        ssim = ssim if scale else whole
        value = part if scale < len(SCALES) - 1 else whole
        product *= value if math.isnan(value) else max(value, 0.0) ** exponent
    return ssim, product


def _similarity_maps(a: Array, b: Array) -> tuple[Array, Array]:
    """(luminance, contrast times structure), both [H, W, 3], of the windows about each pixel."""
    mean_a, mean_b, square_a, square_b, both = (
        cv2.GaussianBlur(image, (2 * RADIUS_PX + 1,) * 2, SIGMA_PX) for image in (a, b, a * a, b * b, a * b)
    )
    variance_a, variance_b, covariance = square_a - mean_a**2, square_b - mean_b**2, both - mean_a * mean_b
    luminance = (2.0 * (mean_a * mean_b) + C1) / (mean_a**2 + mean_b**2 + C1)
    return luminance, (2.0 * covariance + C2) / (variance_a + variance_b + C2)


def _halve(image: Array) -> Array:
    """Means of 2 x 2 pixels of [H, W, ...]."""
    even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    return (even[0::2, 0::2] + even[0::2, 1::2] + even[1::2, 0::2] + even[1::2, 1::2]) / 4.0


def _mean(values: Array, weights: Array) -> float:
    """Mean of values [H, W, 3] over channels, and pixels with weights [H, W]; nan where all weigh nothing."""
    total = float(weights.sum())
    return float((values * weights[:, :, None]).sum()) / (3.0 * total) if total > 0.0 else math.nan


def _flip(predicted: NDArray[np.uint8], true: NDArray[np.uint8]) -> float | None:
    if importlib.util.find_spec("flip_evaluator") is None:
        return None
    from services.study.colour import flip_between  # loads what makes data

    return flip_between(true, predicted) if true.size else math.nan
