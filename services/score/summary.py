"""What the items say together: means with intervals, and two predictions compared. Pure.

A mean is over the items of a kind that are scored or refused; missing ones are counted and not in it. A refused item, and
one that predicts nothing where there is truth, counts as worst: 0 for likenesses and shares of good points; for errors the
largest of all scored items, and no less than the object's diagonal (or its square), 180 degrees, 100 pixels, or 1 for what
has no unit. Intervals are 95 % of the bootstrap over scenes, because the items of a scene are not independent (Efron and
Tibshirani 1993, section 8); they are null for a single scene.
"""

import re
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from schemas.base import Array
from services.score.predictions import KINDS

HEADLINES: Final = (
    *("depth_mae_m", "depth_mae_seen_m", "depth_mae_hidden_m", "depth_mae_boundary_m", "depth_mae_scene_m"),
    *("depth_within_2mm", "depth_within_2mm_hidden", "depth_holes", "rgb_psnr_db", "rgb_ssim", "rgb_flip"),
    *("shape_chamfer_l1_m", "shape_fscore_2mm", "shape_normal_consistency", "shape_iou"),
    *("volume_iou", "volume_distance_mae_m", "pose_add_m", "pose_add_s_m", "pose_rotation_deg", "pose_translation_m"),
)
"""The metrics that are told first."""

_BETTER_HIGH = re.compile(
    r"_(psnr_db|ssim|ms_ssim|delta\d|within_\d+mm|fscore_\w+|iou|normal_consistency)(_[a-z]+)?$|^volume_accuracy$"
)
_NO_SCORE = re.compile(r"^pose_id$|_pixels(_[a-z]+)?$|_sampling$")

PSNR_DB: Final = 100.0
"""PSNR of equal images, which has no finite value."""

RESAMPLES: Final = 1000
INTERVAL: Final = (2.5, 97.5)
SEED: Final = 43

Figure = Mapping[str, float | int | None]
"""value, low, high and items; value is null where no item has one."""


def metrics_of(table: pa.Table) -> list[str]:
    """The columns that are scores, headlines first."""
    names = [name for name in table.column_names if name.partition("_")[0] in KINDS and not _NO_SCORE.search(name)]
    return sorted(names, key=lambda name: (HEADLINES.index(name) if name in HEADLINES else len(HEADLINES), name))


def is_better_high(name: str) -> bool:
    """Whether a larger value of a metric is the better one."""
    return _BETTER_HIGH.search(name) is not None


def values_of(table: pa.Table, name: str) -> Array:
    """[N] float64: the metric of every item as it counts, nan where it does not."""
    values = _numbers(table, name)
    own = _equal(table, "kind", name.partition("_")[0])
    ok, refused = own & _equal(table, "status", "ok"), own & _equal(table, "status", "refused")
    if name.endswith("psnr_db"):
        values = np.minimum(values, PSNR_DB)
    empty = ok & ~np.isfinite(values) & _has_truth(table, name, values)
    values[empty | refused] = _worst(table, name, values[ok & np.isfinite(values)])[empty | refused]
    values[~own | ~(ok | refused)] = np.nan
    values[ok & ~empty & ~np.isfinite(values)] = np.nan
    return values


def _has_truth(table: pa.Table, name: str, values: Array) -> NDArray[np.bool_]:
    """[N]: where a scored item without a value predicts nothing, and not: has nothing to be held against."""
    if not name.startswith("depth_"):
        without_volume = pc.is_valid(table["reason"]).to_numpy() if name == "shape_iou" else False
        return np.isinf(values) | without_volume
    part = next((one for one in ("scene", "seen", "hidden", "boundary") if f"_{one}" in name), "")
    return _numbers(table, f"depth_pixels{part and '_'}{part}") > 0.0


def _worst(table: pa.Table, name: str, scored: Array) -> Array:
    """[N]: what counts for an item that is refused."""
    if is_better_high(name):
        return np.zeros(table.num_rows)
    diagonal = _numbers(table, "diagonal_m")
    known = diagonal[np.isfinite(diagonal)]
    diagonal = np.where(np.isfinite(diagonal), diagonal, known.max() if len(known) else 0.0)
    least = {
        "_m": diagonal,
        "_m2": diagonal**2,
        "_deg": np.full(len(diagonal), 180.0),
        "_px": np.full(len(diagonal), 100.0),
    }
    unit = next((one for one in least if name.endswith(one)), "")
    return np.maximum(least.get(unit, np.ones(len(diagonal))), scored.max() if len(scored) else 0.0)


def summarise(table: pa.Table) -> dict[str, Any]:
    """Counts, also by kind; `metrics` of all items; `by` category and quarter of the visible fraction, the headlines alone."""
    names = metrics_of(table)
    shown = [place for place, name in enumerate(names) if name in HEADLINES]
    values = np.stack([values_of(table, name) for name in names], axis=1) if names else np.zeros((table.num_rows, 0))
    categories = {
        name: np.asarray(pc.equal(table["category"], name).fill_null(False).to_numpy(), np.bool_)
        for name in sorted(filter(None, pc.unique(table["category"]).to_pylist()))
    }
    scenes, groups = _scenes(table), {"category": categories, "visible_fraction": _quarters(table)}
    statuses = [_equal(table, "status", word) for word in ("ok", "missing", "refused")]
    return {
        "items": table.num_rows,
        **dict(zip(("scored", "missing", "refused"), (int(one.sum()) for one in statuses), strict=True)),
        "kinds": {
            kind: {
                word: int((_equal(table, "kind", kind) & mask).sum())
                for word, mask in zip(("scored", "missing", "refused"), statuses, strict=True)
            }
            for kind in pc.unique(table["kind"]).to_pylist()
        },
        "metrics": dict(zip(names, figures(values, scenes), strict=True)),
        "by": {
            group: {
                word: dict(
                    zip([names[place] for place in shown], figures(values[mask][:, shown], scenes[mask]), strict=True)
                )
                for word, mask in masks.items()
            }
            for group, masks in groups.items()
        },
    }


def figures(values: Array, scenes: NDArray[np.int64]) -> list[Figure]:
    """A figure for each column of values [N, M]; scenes [N]: the number of each item's."""
    if not values.shape[1]:
        return []
    counts = np.isfinite(values)
    there, at = np.unique(scenes, return_inverse=True)
    number = len(there)
    sums, items = (
        np.stack([np.bincount(at, column, number) for column in array.T], axis=1)
        for array in (np.where(counts, values, 0.0), counts.astype(np.float64))
    )
    rng = np.random.default_rng(SEED)
    draws = [
        np.bincount(rng.integers(0, number, number), minlength=number) for _ in range(RESAMPLES if number > 1 else 0)
    ]
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.array([(weights @ sums) / (weights @ items) for weights in draws]).reshape(-1, values.shape[1])
        value = sums.sum(axis=0) / items.sum(axis=0)
    return [
        _figure(one, means[:, place], int(items[:, place].sum()), int((items[:, place] > 0).sum()))
        for place, one in enumerate(value)
    ]


def _figure(value: float, means: Array, items: int, scenes: int) -> Figure:
    means = means[np.isfinite(means)]
    low, high = np.percentile(means, INTERVAL) if len(means) and scenes > 1 else (None, None)
    ends = {"low": None if low is None else float(low), "high": None if high is None else float(high)}
    return {"value": float(value) if items else None, **ends, "items": items}


def compare(a: pa.Table, b: pa.Table) -> dict[str, Any]:
    """By metric: `a`, `b`, `difference` b - a with its paired interval over the items that neither misses, and the `better`."""
    both = pa.concat_tables([a, b], promote_options="default")
    names, place = metrics_of(both), dict[tuple[Any, ...], list[int]]()
    for number, row in enumerate(both.select(["kind", "pose_id", "region"]).to_pylist()):
        place.setdefault(tuple(row.values()), []).append(number)
    pairs = np.array([rows for rows in place.values() if len(rows) == 2 and rows[0] < a.num_rows <= rows[1]]).reshape(
        -1, 2
    )
    scenes = _scenes(both)[pairs[:, 0]]
    answer: dict[str, Any] = {}
    for name in names:
        values = values_of(both, name)[pairs]
        values[~np.isfinite(values).all(axis=1)] = np.nan
        columns = np.column_stack([values, values[:, 1] - values[:, 0]])
        mine, theirs, apart = figures(columns, scenes)
        if apart["value"] is None:
            continue
        better, low, high = None, apart["low"], apart["high"]
        if low is not None and high is not None and (low > 0.0 or high < 0.0):
            better = "b" if (low > 0.0) == is_better_high(name) else "a"
        answer[name] = {"a": mine["value"], "b": theirs["value"], "difference": apart["value"]} | {
            "low": low, "high": high, "items": apart["items"], "better": better
        }  # fmt: skip
    return answer


def _numbers(table: pa.Table, name: str) -> Array:
    """[N] float64, nan for null and for a column that is not there."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.array(table[name].cast(pa.float64()).to_numpy(), np.float64)


def _equal(table: pa.Table, name: str, word: str) -> NDArray[np.bool_]:
    return np.asarray(pc.equal(table[name], word).to_numpy(), np.bool_)


def _scenes(table: pa.Table) -> NDArray[np.int64]:
    """[N] numbers of scenes from 0 up; items without a scene are one together."""
    return np.unique(_numbers(table, "scene_id"), return_inverse=True)[1].reshape(-1)


def _quarters(table: pa.Table) -> dict[str, NDArray[np.bool_]]:
    """Items by quarters of the visible fraction, as far as it differs."""
    seen = _numbers(table, "visible_fraction")
    known = seen[np.isfinite(seen)]
    edges = np.unique(np.percentile(known, (0, 25, 50, 75, 100))) if len(known) else np.array([])
    quarters = {}
    for low, high in pairwise(edges):
        inside = (seen >= low) & ((seen < high) | (high == edges[-1]) & (seen <= high))
        if inside.any():
            quarters[f"{low:.3g} to {high:.3g}"] = inside
    return quarters
