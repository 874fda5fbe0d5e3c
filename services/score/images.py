"""Scores of predicted images, colour and depth, on parts of the image, and the alignment of depth. Pure.

True depth counts where it is positive and finite. A hole is a pixel with truth where the prediction is 0, negative or not finite.
"""

import importlib.util
import math
from collections.abc import Mapping
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from schemas.base import Array
from schemas.errors import MachineError, needs_making

Alignment = Literal["none", "scale", "similarity"]
"""Of a prediction with the truth before it is scored, where that is asked for. `none`: as it is. `scale`: one factor.
`similarity`: of depth one factor and one offset, of shapes a factor, a rotation and a translation. RGB, volumes and poses are
never aligned."""

SIGMA_PX, RADIUS_PX = 1.5, 5
"""The Gaussian window of 11 x 11 pixels of Wang et al. 2004."""

C1, C2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2

SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM from the full size to a 16th (Wang, Simoncelli and Bovik 2003, section 3.2)."""


def score_colour(
    predicted: NDArray[np.uint8], true: NDArray[np.uint8], parts: Mapping[str, NDArray[np.bool_]], flip: bool = True
) -> dict[str, float | None]:
    """Likeness of sRGB images [H, W, 3] uint8 of one size, on each part [H, W] and, as `image`, on the whole.

    part.ncc: normalised cross-correlation of the part's codes, the mean of each channel taken off both (Lewis 1995); 0 where one
    of the two is of one colour, 1 where both are: unlike PSNR and SSIM it is not high of a guess without any structure.
    part.psnr_db: 10 log10(255^2 / mean square difference of codes), dB; inf where all are equal.
    part.ssim: mean structural similarity, 1 where equal (Wang, Bovik, Sheikh and Simoncelli 2004, eq. 13 with C3 = C2 / 2):
    Gaussian window of sigma 1.5 and 11 x 11 pixels, K1 = 0.01, K2 = 0.03, weighted moments; mean over the three channels and
    over the windows about the part's pixels, beyond the image's edge mirrored; of the whole, over those that lie in the image.
    image.ms_ssim: the same at five scales (Wang, Simoncelli and Bovik 2003, eq. 7): product of the mean contrast and structure
    at each scale, and of luminance too at the last, to the powers `SCALES`; a scale is the means of 2 x 2 pixels of the one
    before, an odd last row or column left out; a negative mean counts as 0.
    image.flip: mean FLIP of the whole image, 0 where equal (Andersson et al. 2020); None where `flip` is false.

    nan where there is nothing to compare: no pixels (all), no whole window (image.ssim), none at the fifth scale (ms_ssim: images
    below 176 pixels).
    """
    a, b = predicted.astype(np.float64), true.astype(np.float64)
    square = ((a - b) ** 2).mean(axis=2)
    likeness, ssim, ms_ssim = _similarities(a, b)
    scores: dict[str, float | None] = {}
    for name, part in parts.items():
        scores[f"{name}.ncc"] = _correlation(a[part], b[part])
        scores[f"{name}.psnr_db"] = _psnr_db(square[part])
        scores[f"{name}.ssim"] = float(likeness[part].mean()) if part.any() else math.nan
    whole: dict[str, float | None] = {"psnr_db": _psnr_db(square), "ssim": ssim, "ms_ssim": ms_ssim}
    whole["flip"] = None if not flip else _flip(predicted, true) if true.size else math.nan
    return scores | {f"image.{name}": value for name, value in whole.items()}


def _correlation(a: Array, b: Array) -> float:
    """Of colours [N, 3] of N pixels; nan of none."""
    if not len(a):
        return math.nan
    a, b = (each - each.mean(axis=0) for each in (a, b))
    norm = math.sqrt(float((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / norm if norm else float(not (a.any() or b.any()))


def _psnr_db(square: Array) -> float:
    """Of mean square differences, nan where there are none."""
    error = float(square.mean()) if square.size else math.nan
    return math.inf if error == 0.0 else 10.0 * math.log10(255.0**2 / error)


def _similarities(a: Array, b: Array) -> tuple[Array, float, float]:
    """(SSIM of the window about each pixel [H, W], SSIM, MS-SSIM) of images [H, W, 3]."""
    likeness, ssim, product = np.zeros(a.shape[:2]), math.nan, 1.0
    for scale, exponent in enumerate(SCALES):
        if scale:
            a, b = _halve(a), _halve(b)
        maps = _similarity_maps(a, b)
        if not scale:
            likeness = (maps[0] * maps[1]).mean(axis=2)
        if min(a.shape[:2]) <= 2 * RADIUS_PX:  # no whole window
            return likeness, ssim, math.nan
        inner = (slice(RADIUS_PX, -RADIUS_PX),) * 2
        luminance, contrast = (each[inner] for each in maps)
        whole, part = float((luminance * contrast).mean()), float(contrast.mean())
        ssim = ssim if scale else whole
        value = part if scale < len(SCALES) - 1 else whole
        product *= max(value, 0.0) ** exponent
    return likeness, ssim, product


def _similarity_maps(a: Array, b: Array) -> tuple[Array, Array]:
    """(luminance, contrast times structure), both [H, W, 3], of the windows about each pixel."""
    mean_a, mean_b, square_a, square_b, both = (
        ndimage.gaussian_filter(image, SIGMA_PX, axes=(0, 1), radius=RADIUS_PX) for image in (a, b, a * a, b * b, a * b)
    )
    variance_a, variance_b, covariance = square_a - mean_a**2, square_b - mean_b**2, both - mean_a * mean_b
    luminance = (2.0 * (mean_a * mean_b) + C1) / (mean_a**2 + mean_b**2 + C1)
    return luminance, (2.0 * covariance + C2) / (variance_a + variance_b + C2)


def _halve(image: Array) -> Array:
    """Means of 2 x 2 pixels of [H, W, ...]."""
    even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    return (even[0::2, 0::2] + even[0::2, 1::2] + even[1::2, 0::2] + even[1::2, 1::2]) / 4.0


def _flip(predicted: NDArray[np.uint8], true: NDArray[np.uint8]) -> float:
    from services.study.truths import flip_between

    return flip_between(true, predicted)


def require_flip() -> None:
    """Raises MachineError where this installation cannot compute FLIP."""
    with needs_making("FLIP"):
        import services.study.truths  # noqa: F401
    if importlib.util.find_spec("flip_evaluator") is None:
        raise MachineError("--flip needs flip-evaluator: `verso extra study` installs it in a checkout, pip elsewhere")


SLACK_M = 1e-9
"""Keeps rounding from deciding: stored depths are multiples of 0.2 mm, so errors of exactly 1 mm, which is within, are common."""

METRICS = (
    *("mae_m", "rmse_m", "abs_rel", "auc_50mm", "within_1mm", "within_2mm", "within_5mm", "within_10mm"),
    *("delta1", "delta2", "delta3", "holes", "pixels"),
)

AUC_M = 0.05


def score_depth(
    predicted_m: ArrayLike, true_m: ArrayLike, parts: Mapping[str, NDArray[np.bool_]], worst_m: float
) -> dict[str, float]:
    """Errors of depth z [H, W], metres, on each part [H, W] of the image, as `part.metric` (Eigen et al. 2014, section 4.1).

    With d predicted and t true:
    mae_m, rmse_m: mean |d - t|, root of mean (d - t)^2, metres; |d - t| is at most `worst_m`, and that in a hole.
    abs_rel: mean |d - t| / t, which is at most 1, and that in a hole.
    auc_50mm: the mean over limits from 0 to 50 mm of the share of pixels with |d - t| below the limit.
    delta1, delta2, delta3: share with max(d / t, t / d) < 1.25, 1.25^2, 1.25^3.
    within_1mm, within_2mm, within_5mm, within_10mm: share with |d - t| at most that (Knapitsch et al. 2017, of points).
    holes: share without prediction; these count as missed in auc, delta and within. pixels: how many have truth.

    A part without truth has nan, and 0 pixels.
    """
    predicted, true = (np.ascontiguousarray(image, np.float64).ravel() for image in (predicted_m, true_m))
    known = (true > 0.0) & (true < np.inf)
    scores: dict[str, float] = {}
    for name, part in parts.items():
        at = np.flatnonzero(part.ravel() & known)
        blocks = (at[start : start + BLOCK] for start in range(0, len(at), BLOCK))
        sums = sum((_sums_of(predicted[block], true[block], worst_m) for block in blocks), np.zeros(len(METRICS)))
        scores |= {f"{name}.{metric}": value for metric, value in zip(METRICS, _metrics_of(sums), strict=True)}
    return scores


BLOCK: Final = 8192
"""Pixels that are looked at together: what is made of them stays in the processor's cache, which whole images do not."""


def _sums_of(d: Array, t: Array, worst_m: float) -> Array:
    """The sums over pixels that `METRICS` are means of, squares in place of their root, of predicted and true depth [N]."""
    count = len(t)
    if not (d.min(initial=1.0) > 0.0 and d.max(initial=1.0) < np.inf):
        hit = (d > 0.0) & (d < np.inf)  # a hole is as far off as any, and beyond all ratios
        d, t = d[hit], t[hit]
    holes = count - len(t)
    larger, smaller = np.maximum(d, t), np.minimum(d, t)
    apart = larger - smaller
    error = np.minimum(apart, worst_m)
    near = error[error < AUC_M]
    sums = [error.sum() + holes * worst_m, error @ error + holes * worst_m**2, np.minimum(apart / t, 1.0).sum() + holes]
    sums.append(len(near) - near.sum() / AUC_M)
    sums += [np.count_nonzero(apart <= limit_m + SLACK_M) for limit_m in (0.001, 0.002, 0.005, 0.01)]
    if apart.max(initial=0.0) < 0.25 * smaller.min(initial=np.inf) - SLACK_M:  # of most blocks, at a sixth of the time
        sums += [len(t)] * 3
    else:
        sums += [np.count_nonzero(larger < 1.25**power * smaller - SLACK_M) for power in (1, 2, 3)]
    return np.array([*sums, holes, count], np.float64)


def _metrics_of(sums: Array) -> list[float]:
    """`METRICS` of the sums over all pixels with truth."""
    count = float(sums[-1])
    if not count:
        return [*[math.nan] * (len(METRICS) - 1), 0.0]
    mae, square, *others = (sums[:-1] / count).tolist()
    return [mae, math.sqrt(square), *others, count]


def align_depth(predicted_m: Array, true_m: Array, how: Alignment) -> Array:
    """Predicted depth [H, W], metres, times a factor, and with `similarity` plus an offset; holes stay 0.

    `scale`: the median of true by predicted depth (Zhou et al. 2017, section 4.1). `similarity`: factor and offset of least
    squares (Ranftl et al. 2020, eq. 4, there of disparity). Over all pixels with both; as it is where there are none.
    """
    if how == "none":
        return predicted_m
    both = (predicted_m > 0.0) & (true_m > 0.0) & np.isfinite(predicted_m)
    if not both.any():
        return predicted_m
    d, t = predicted_m[both], true_m[both]
    factor, offset_m = float(np.median(t / d)), 0.0
    if how == "similarity" and np.ptp(d) > 0.0:
        factor = float(np.cov(d, t, bias=True)[0, 1] / d.var())
        offset_m = float(t.mean() - factor * d.mean())
    return np.where(predicted_m > 0.0, factor * predicted_m + offset_m, 0.0)
