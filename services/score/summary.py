"""What the items say together: means with intervals, and who is surely better than whom. Pure.

A mean is over all items of a kind whose truth has something to predict: what is missing, refused or left out counts as worst, and
no value counts as worse than that. Worst is 0 for likenesses and shares of good points; for errors of depth the end of the depths
that the dataset stores, for other lengths the object's diagonal (or its square), 180 degrees, 100 pixels, or 1 for what has no
unit. Intervals are 95 % of the bootstrap over scenes, because the items of a scene are not independent (Efron and Tibshirani
1993, section 8); they are null for a single scene. Coverage is the share of what there is to predict that is predicted.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Final

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import InputError
from services.read.query import LOCKED
from services.score.predictions import KINDS

ITEMS_FILE: Final = "items.parquet"

HEADLINES: Final = (
    *("depth_auc_50mm", "depth_within_2mm", "depth_within_5mm", "depth_within_10mm", "depth_auc_50mm_hidden"),
    *("depth_within_2mm_hidden", "depth_mae_m", "depth_mae_seen_m", "depth_mae_hidden_m", "depth_mae_boundary_m"),
    *("depth_mae_scene_m", "depth_holes", "rgb_ncc", "rgb_psnr_db", "rgb_ssim"),
    *("rgb_ncc_hidden", "rgb_psnr_hidden_db", "rgb_ssim_hidden", "rgb_ncc_boundary"),
    *("rgb_psnr_boundary_db", "rgb_ssim_boundary", "rgb_psnr_image_db", "rgb_ssim_image", "rgb_flip_image"),
    *("shape_chamfer_l1_m", "shape_fscore_2mm", "shape_normal_consistency", "shape_iou"),
    *("volume_iou", "volume_distance_mae_m", "pose_add_m", "pose_add_s_m", "pose_rotation_deg", "pose_translation_m"),
)
"""The metrics that are told first."""

ALWAYS: Final = tuple(
    name
    for name in HEADLINES
    if name not in ("rgb_flip_image", "shape_normal_consistency", "shape_iou", "volume_distance_mae_m")
)
"""What every prediction has. Another metric is left out where no item has it: FLIP where it is not asked for; a cloud has no
volume, and occupancy is no distance."""

_BETTER_HIGH = re.compile(
    r"_(ncc|psnr|ssim|ms_ssim|delta\d|auc_50mm|within_\d+mm|fscore_\w+|iou|normal_consistency)(_[a-z]+)?(_db)?$|^volume_accuracy$"
)
_NO_SCORE = re.compile(r"^pose_id$|_pixels(_[a-z]+)?$|_sampling$")

PSNR_DB: Final = 100.0
"""PSNR of equal images, which has no finite value."""

ITEM: Final = ["kind", "pose_id", "region"]
"""The columns that name an item."""

RESAMPLES: Final = 1000
INTERVAL: Final = (2.5, 97.5)
SEED: Final = 43

Figure = Mapping[str, float | int | None]
"""value, low, high, items, coverage, and worst: the mean of what would count for items that are missing. Value is null where no
item has one."""


def metrics_of(table: pa.Table) -> list[str]:
    """The columns that are scores, headlines first; those of every kind that is predicted also where all of it is refused."""
    columns = [name for name in table.column_names if name.partition("_")[0] in KINDS and not _NO_SCORE.search(name)]
    kinds = set(items_of(table)["kind"].to_pylist())
    always = [name for name in ALWAYS if name.partition("_")[0] in kinds]
    names = dict.fromkeys([*columns, *always])
    return sorted(names, key=lambda name: (HEADLINES.index(name) if name in HEADLINES else len(HEADLINES), name))


def is_better_high(name: str) -> bool:
    """Whether a larger value of a metric is the better one."""
    return _BETTER_HIGH.search(name) is not None


def items_of(table: pa.Table) -> pa.Table:
    """The items of the split, without predictions that are none."""
    return table.filter(pc.is_in(table["status"], pa.array(["ok", "missing", "refused"])))


def values_of(table: pa.Table, names: Sequence[str]) -> dict[str, Array]:
    """By metric [N] float64: of every item as it counts, nan where it does not."""
    return dict(zip(names, _counted(table, names)[0].T, strict=True))


@dataclass(frozen=True)
class Counting:
    """The rules of a metric as SQL over `items` of `ITEMS_SQL`: its value as it counts, the worst value, coverage, its items."""

    value: str
    worst: str
    coverage: str
    where: str

    @classmethod
    def of(cls, name: str, columns: Collection[str]) -> "Counting":
        """Of a metric in a table that has these columns; one that it has not is null."""

        def column(word: str) -> str:
            return word if word in columns else "null"

        kind, part = name.partition("_")[0], _part(name)
        worst = "0" if is_better_high(name) else _worst(name)
        value = f"coalesce({column(name)}, {worst})"
        if "_psnr" in name:
            value = f"least({value}, {PSNR_DB:g})"
        value = f"{'greatest' if is_better_high(name) else 'least'}({value}, {worst})"
        coverage, where, of_part = f"({column(name)} is not null)::int", f"kind = '{kind}'", f"_{part}" * bool(part)
        if kind == "depth":
            coverage += f" * (1 - coalesce({column(f'depth_holes{of_part}')}, 1))"
        if kind in ("depth", "rgb") and part != "image":
            where += f" and {column(f'{kind}_pixels{of_part}')} > 0"
        return cls(value, worst, coverage, where)


ITEMS_SQL: Final = """with scored as (
  from {source} where status in ('ok', 'missing', 'refused')
), edges as (
  select quantile_cont(visible_fraction, [0, 0.25, 0.5, 0.75, 1]) as edge from scored
), items as (
  select *, case when visible_fraction >= edge[4] and edge[4] < edge[5] then 4
    when visible_fraction >= edge[3] and edge[3] < edge[4] then 3
    when visible_fraction >= edge[2] and edge[2] < edge[3] then 2
    when visible_fraction >= edge[1] and edge[1] < edge[2] then 1 end as quarter,
    format('{{:.3g}} to {{:.3g}}', edge[quarter], edge[quarter + 1]) as visible,
    coalesce(farthest_m, (select max(farthest_m) from scored), 1) as worst_depth_m,
    coalesce(diagonal_m, (select max(diagonal_m) from scored), 1) as worst_length_m
  from scored, edges
)"""
"""The items of the split, the quarter of the visible fraction that each is in, and the lengths that count as worst."""

GROUPS: Final = {"category": "category", "visible_fraction": "visible"}
"""The kinds of groups, and the column of `items` that names an item's group."""


COUNTS_SQL: Final = f"select kind, status, count(*) as items from '{ITEMS_FILE}' group by all order by all"
"""The items of every kind by status."""


def query_of(names: Sequence[str], columns: Collection[str], group: str = "") -> str:
    """SQL that makes value, coverage, worst and items of these metrics from items.parquet, with a kind of groups by group."""
    rules = {name: Counting.of(name, columns) for name in names}
    parts = [
        f"  select '{name}' as metric, {GROUPS.get(group, 'null')} as part, {rule.value} as value,\n"
        f"    {rule.coverage} as coverage, {rule.worst} as worst from items where {rule.where}"
        for name, rule in rules.items()
    ]
    counted = "\n  union all\n".join(parts)
    asked = "part, metric" if group else "metric"
    return (
        f"{ITEMS_SQL.format(source=repr(ITEMS_FILE))}, counted as (\n{counted}\n)\n"
        f"select {asked}, avg(value) as value, avg(coverage) as coverage, avg(worst) as worst, count(*) as items\n"
        f"from counted{' where part is not null' * bool(group)} group by {asked} order by {asked}"
    )


def _counted(table: pa.Table, names: Sequence[str]) -> tuple[Array, Array, Array]:
    """(values as they count, what counts as worst, coverage), each [N, M], nan of items of other kinds and without truth.

    nan of all where no item has the metric, if it is not of `ALWAYS`.
    """
    columns = table.column_names
    rules = [Counting.of(name, columns) for name in names]
    asked = [
        f"if({rule.where}, {expression}, null)::double as {kind}{place}"
        for place, rule in enumerate(rules)
        for kind, expression in (("v", rule.value), ("w", rule.worst), ("c", rule.coverage))
    ]
    answer = _ask(table, ", ".join(asked)) if asked else {}
    there = [name in ALWAYS or (name in columns and table[name].null_count < table.num_rows) for name in names]
    return tuple(  # type: ignore[return-value]
        np.column_stack(
            [np.where(has, answer[f"{kind}{place}"], np.nan) for place, has in enumerate(there)]
            or [np.zeros((table.num_rows, 0))]
        )
        for kind in "vwc"
    )


def _ask(table: pa.Table, columns: str) -> dict[str, NDArray]:
    """Columns of `items` as arrays [N], nan for null, in the order of a table's items."""
    with duckdb.connect(":memory:", config={**LOCKED, "threads": 1}) as connection:
        connection.register("given", table)
        answer = connection.sql(f"{ITEMS_SQL.format(source='given')} select {columns} from items").to_arrow_table()
    return {name: answer[name].to_numpy() for name in answer.column_names}


def _part(name: str) -> str:
    """The part of an image that a metric is of; empty for the object."""
    word = name.removesuffix("_m").removesuffix("_db").rpartition("_")[2]
    return word if word in ("scene", "seen", "hidden", "boundary", "image") else ""


def _worst(name: str) -> str:
    """SQL of the error that counts for an item that is missing."""
    length_m = "worst_depth_m" if name.startswith("depth_") else "worst_length_m"
    of_unit = {"_m": length_m, "_m2": f"{length_m} ** 2", "_deg": "180", "_px": "100"}
    return next((of_unit[unit] for unit in of_unit if name.endswith(unit)), "1")


def summarise(table: pa.Table) -> dict[str, Any]:
    """Counts, also by kind; `metrics` of all items; `by` category and quarter of the visible fraction, the headlines alone.

    The groups of a kind have the same items together as the whole has, and count them alike.
    """
    whole, table = table, items_of(table)
    names = metrics_of(table)
    shown = [place for place, name in enumerate(names) if name in HEADLINES]
    values, worst, covered = _counted(table, names)
    groups = _groups(table)
    scenes = scenes_of(table)
    statuses = [_equal(table, "status", word) for word in ("ok", "missing", "refused")]

    def figures_by_name(chosen: Any, places: list[int]) -> dict[str, Figure]:
        return {
            names[place]: {**figure, "coverage": _mean(covered[chosen, place]), "worst": _mean(worst[chosen, place])}
            for place, figure in zip(places, figures(values[chosen][:, places], scenes[chosen]), strict=True)
        }

    return {
        "items": table.num_rows,
        **dict(zip(("scored", "missing", "refused"), (int(one.sum()) for one in statuses), strict=True)),
        **{word: int(_equal(whole, "status", word).sum()) for word in ("unknown", "outside")},
        "kinds": {
            kind: {
                word: int((_equal(table, "kind", kind) & mask).sum())
                for word, mask in zip(("scored", "missing", "refused"), statuses, strict=True)
            }
            for kind in pc.unique(table["kind"]).to_pylist()
        },
        "metrics": figures_by_name(np.ones(table.num_rows, np.bool_), list(range(len(names)))),
        "by": {
            group: {word: figures_by_name(mask, shown) for word, mask in masks.items()}
            for group, masks in groups.items()
        },
    }


def _mean(values: Array) -> float | None:
    """Of what is no nan; None where nothing is."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None


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


def compare(a: pa.Table, b: pa.Table, tested: Collection[str]) -> dict[str, dict[str, Any]]:
    """By metric of kinds that both predict: `a`, `b`, and their `difference` b - a with its paired interval over all items.

    `p` is that of Wilcoxon's signed-rank test of the means over a scene's items; None of a metric that is not `tested`, and where
    either leaves anything out: `coverage` is the lesser of the two. `better` is a or b, for `decide` to take away. Raises
    InputError where the two have other items.
    """
    tables = [items_of(each).sort_by([(name, "ascending") for name in ITEM]) for each in (a, b)]
    kinds = pa.array(sorted(set.intersection(*(set(each["kind"].to_pylist()) for each in tables))), pa.string())
    a, b = (each.filter(pc.is_in(each["kind"], kinds)) for each in tables)
    if a.select(ITEM) != b.select(ITEM):
        raise InputError("the two scores are not of the same items: score both with the same --split")
    scenes, answer = scenes_of(a), dict[str, dict[str, Any]]()
    names = [name for name in metrics_of(a) if name in metrics_of(b)]
    (mine, _, covered), (theirs, _, also_covered) = (_counted(each, names) for each in (a, b))
    for place, (name, apart) in enumerate(zip(names, figures(theirs - mine, scenes), strict=True)):
        if apart["value"] is not None:
            one, other, *shares = (_mean(each[:, place]) or 0.0 for each in (mine, theirs, covered, also_covered))
            p = _wilcoxon((theirs - mine)[:, place], scenes) if name in tested and min(shares) == 1.0 else None
            better = "b" if (other > one) == is_better_high(name) else "a"
            answer[name] = {"a": one, "b": other, "difference": apart["value"]} | {
                "low": apart["low"], "high": apart["high"], "items": apart["items"],
                "coverage": min(shares), "p": p, "better": better,
            }  # fmt: skip
    return answer


LEVEL: Final = 0.05
"""Of the whole family of comparisons."""


def decide(rows: Collection[dict[str, Any]]) -> None:
    """Corrects the p of the rows of `compare` for their number (Holm 1979), and takes the `better` away where that is not sure.

    Over all metrics and pairs of predictions that are told together (Demsar 2006, sections 3.1.3 and 3.2.2).
    """
    tested = sorted((row for row in rows if row["p"] is not None), key=itemgetter("p"))
    last = 0.0
    for rank, row in enumerate(tested):
        row["p"] = last = max(last, min(1.0, row["p"] * (len(tested) - rank)))
    for row in rows:
        row["better"] = row["better"] if row["p"] is not None and row["p"] < LEVEL else None


def _wilcoxon(differences: Array, scenes: NDArray[np.int64]) -> float:
    """The p-value of the means over the items [N] of each scene; 1 where none differs."""
    from scipy.stats import wilcoxon  # takes half a second, which a score need not wait for

    known = np.isfinite(differences)
    there, at = np.unique(scenes[known], return_inverse=True)
    means = np.bincount(at, differences[known], len(there)) / np.bincount(at, minlength=len(there))
    return float(wilcoxon(means).pvalue) if means.any() else 1.0


def _equal(table: pa.Table, name: str, word: str) -> NDArray[np.bool_]:
    return np.asarray(pc.equal(table[name], word).to_numpy(), np.bool_)


def scenes_of(table: pa.Table) -> NDArray[np.int64]:
    """[N] numbers of scenes from 0 up; items without a scene are one together."""
    return np.unique(table["scene_id"].cast(pa.float64()).to_numpy(), return_inverse=True)[1].reshape(-1)


def _groups(table: pa.Table) -> dict[str, dict[str, NDArray[np.bool_]]]:
    """The items [N] of each group by the kind of group, in order; a group of the visible fraction is a quarter of the items."""
    answer = _ask(table, "category, visible, quarter")
    groups = {}
    for kind, order in {"category": "category", "visible_fraction": "quarter"}.items():
        words = answer[GROUPS[kind]]
        names = {(at, word) for at, word in zip(answer[order], words, strict=True) if word is not None}
        groups[kind] = {word: words == word for _, word in sorted(names)}
    return groups
