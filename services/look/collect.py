"""The figures of a dataset, and of its scenes, the worst first, asked of its tables: their rows are never all in memory."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from schemas.job.assets import SplitShares
from services.dataset.dataset import Splits, collect_ids, split_by_category, strictest
from services.look.charts import DEPTH_M, Histogram
from services.read.dataset_reader import StoredTables
from services.read.query import ask, query

MOST_RANGES = 256
"""Largest number of ranges that are read of a dataset that is not merged; more are sampled evenly."""


@dataclass
class Cost:
    """How often something ran and what it took."""

    runs: int = 0
    seconds: float = 0.0
    timed: int = 0
    """How many of the runs have a time."""
    skips: Counter[str] = field(default_factory=Counter)
    """How often it was left out, by reason."""


@dataclass(frozen=True)
class Failure:
    """Scenes that failed in one way, with an example."""

    reason: str
    kind: str
    stage: str
    scenes: int
    examples: Sequence[int]
    detail: str


@dataclass(frozen=True)
class Figures:
    """What the tables of a dataset say."""

    sampled: bool
    """Whether some of the ranges only were read."""
    by_category: Counter[str]
    """Rows of `scenes` that were read."""
    instances: int
    """Number of different objects; what they stand on is not counted."""
    views: int
    pairs: int
    files: int
    bytes: int
    seconds: float
    visibility: Mapping[str, Histogram]
    """By role."""
    inclination: Mapping[str, Histogram]
    """By role, degrees below the horizontal."""
    distance: Histogram
    """d_z of each pair, metres."""
    effects: Mapping[str, Cost]
    """The costliest first."""
    stages: Mapping[str, Cost]
    """The costliest first."""
    failures: Sequence[Failure]

    @property
    def scenes(self) -> int:
        """Rows of `scenes` that were read."""
        return self.by_category.total()


_VIEWS = """
select count(*) as views, count(*) filter (role = 'input') as pairs, coalesce(sum(len(files)), 0)::bigint as files,
  coalesce(sum(list_sum([file.bytes for file in files])), 0)::bigint as bytes from views
"""
_SKIPS = """
select skip.effect as name, skip.why as why, count(*) as times from (select unnest(skipped) as skip from scenes)
group by all order by times desc, why
"""
_TIMES = """
select time.name as name, sum(time.seconds) as seconds, count(time.seconds) as timed
from (select unnest({}) as time from timings) group by 1
"""
_FAILURES = """
select reason, kind, stage, count(*) as scenes, list(scene_id order by scene_id)[:5] as examples,
  arg_min(detail, scene_id) as detail
from failures group by reason, kind, stage order by scenes desc, min(scene_id)
"""


def collect(tables: StoredTables) -> Figures:
    """The figures of all rows."""

    def rows(sql: str) -> list[dict[str, Any]]:
        return query(tables, sql).to_pylist()

    def histograms(column: str, low: float, high: float) -> dict[str, Histogram]:
        return {role: _histogram(tables, column, role, Histogram(low, high)) for role in ("input", "mirror")}

    by_category = rows("select category, count(*) as scenes from scenes group by 1 order by 1")
    ((instances,),) = (row.values() for row in rows(f"select count(distinct instance_id) from assets where {_OBJECTS}"))
    ((seconds,),) = (row.values() for row in rows("select coalesce(sum(total_s), 0.0) from timings"))
    effects, stages = _read_costs(rows)
    return Figures(
        tables.sampled,
        Counter({row["category"]: row["scenes"] for row in by_category}),
        instances,
        **rows(_VIEWS)[0],
        seconds=seconds,
        visibility=histograms("visible_fraction", 0.0, 1.0),
        inclination=histograms("degrees(inclination_rad)", -96.0, 96.0),
        distance=_histogram(tables, "d_z_m", "input", Histogram(*DEPTH_M)),
        effects=dict(sorted(effects.items(), key=lambda item: (-item[1].seconds, -item[1].runs, item[0]))),
        stages=dict(sorted(stages.items(), key=lambda item: -item[1].seconds)),
        failures=[Failure(**row) for row in rows(_FAILURES)],
    )


_OBJECTS = "category not in ('table', 'board')"
"""Of assets; what they stand on is not counted."""


def _histogram(tables: StoredTables, column: str, role: str, histogram: Histogram) -> Histogram:
    """The histogram with a column of the views of a role, batch by batch."""
    with ask(
        tables, f"select {column}::double as value from views where role = '{role}' and value is not null"
    ) as batches:
        for batch in batches:
            histogram = histogram.add(batch.column("value"))
    return histogram


def _read_costs(rows: Callable[[str], list[dict[str, Any]]]) -> tuple[dict[str, Cost], dict[str, Cost]]:
    """(effects that ran or were left out, stages), by name."""
    effects, stages = defaultdict[str, Cost](Cost), defaultdict[str, Cost](Cost)
    for row in rows("select unnest(effects) as name, count(*) as runs from scenes group by 1"):
        effects[row["name"]].runs = row["runs"]
    for row in rows(_SKIPS):
        effects[row["name"]].skips[row["why"]] = row["times"]
    for row in rows(_TIMES.format("stages")):
        stages[row["name"]] = Cost(0, row["seconds"], row["timed"])
    for row in rows(_TIMES.format("effects")):
        if row["name"] in effects:
            effects[row["name"]].seconds, effects[row["name"]].timed = row["seconds"], row["timed"]
    return effects, stages


COLUMNS: Mapping[str, tuple[str, bool | None]] = {
    "visible, %": ("100 * v.visible", False),
    "sides disagree, mm": ("v.disagree", True),
    "penetration, mm": ("s.penetration_mm", True),
    "hover, mm": ("s.hover_gap_mm", True),
    "support margin, mm": ("s.support_margin_mm", False),
    "processor, s": ("t.seconds", None),
    "corner error, px": ("s.capture.reprojection_px", True),
    "pose, mm": ("s.capture.pose_mm", True),
    "cloud, mm": ("s.capture.cloud_median_mm", True),
    "complete, %": ("100 * s.capture.completeness", False),
    "measured, %": ("100 * s.capture.measured_share", False),
    "views left out": ("len(s.capture.left_out)", True),
}
"""By heading: the figure in SQL, and whether more is worse, None for neither. Those that no scene has are not shown."""

_SCENE_ROWS = f"""
select s.scene_id, s.category, coalesce(s.capture.name, '') as name, s.instance_id,
  [body.instance_id for body in s.bodies] as bodies, {", ".join(f'round({sql}, 3) as "{n}"' for n, (sql, _) in COLUMNS.items())}
from scenes s
left join (select scene_id, min(visible_fraction) filter (role in ('input', 'mirror')) as visible,
  max(mirror_agreement.median_mm) as disagree from views group by 1) v using (scene_id)
left join (select scene_id, max(total_s) as seconds from timings group by 1) t using (scene_id) order by 1
"""

MOST_RANKED, MOST_ROWS = 200_000, 500
"""Scenes that are ranked at most, and rows of the page."""


@dataclass(frozen=True)
class SceneTable:
    """The worst scenes, worst first, each with `split`, `worst` (a heading) and its figures by heading, None where unknown.

    `splits`: scenes by category and split, of all; empty where the dataset is too large to be ranked.
    """

    rows: Sequence[Mapping[str, Any]] = ()
    splits: Mapping[str, Counter[str]] | None = None


def read_scene_table(tables: StoredTables, shares: SplitShares, scenes: int) -> SceneTable:
    """The table of a dataset with so many scenes."""
    if not 0 < scenes <= MOST_RANKED:
        return SceneTable()
    assets = query(tables, "select instance_id, category, split from assets").to_pylist()
    of = Splits(split_by_category(collect_ids([assets]), shares))
    split_of = {row["instance_id"]: of.of(row) for row in assets}
    rows, splits = query(tables, _SCENE_ROWS).to_pylist(), dict[str, Counter[str]]()
    for row in rows:
        row["split"] = strictest(split_of[name] for name in row["bodies"] or [row["instance_id"]])
        splits.setdefault(row["category"], Counter())[row["split"]] += 1
    return SceneTable(worst_first(rows)[:MOST_ROWS], splits)


def worst_first(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The rows by the figure in which each is worse than most others (`worst`): by the share of scenes that do better there."""
    shares = np.zeros((len(COLUMNS), len(rows)))
    for share, (name, (_, more)) in zip(shares, COLUMNS.items(), strict=True):
        badness = np.array([row[name] for row in rows], float) * (1 if more else -1)
        known = np.isfinite(badness) & (more is not None)
        share[known] = np.searchsorted(np.sort(badness[known]), badness[known]) / max(1, len(rows))
    ranked = [{**row, "worst": [*COLUMNS][at]} for row, at in zip(rows, shares.argmax(axis=0), strict=True)]
    return [ranked[place] for place in np.argsort(-shares.max(axis=0), kind="stable")]
