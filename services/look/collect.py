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
from services.read.query import Question, asking, query

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
    drawn: Mapping[str, Counter[str]]
    """What scenes have of `look`, by what it is and its name; without what no scene has."""
    room: Mapping[str, Histogram]
    """Metres, by side."""
    elevation: Histogram
    """Of the light that casts shadows, degrees above the horizontal."""

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
    with asking(tables) as answer:

        def rows(sql: str) -> list[dict[str, Any]]:
            return answer(sql).read_all().to_pylist()

        def histograms(column: str, low: float, high: float) -> dict[str, Histogram]:
            return {role: of_views(role, column, low, high) for role in ("input", "mirror")}

        def of_views(role: str, column: str, low: float, high: float) -> Histogram:
            return _histogram(answer, column, f"views where role = '{role}'", Histogram(low, high))

        by_category = rows("select category, count(*) as scenes from scenes group by 1 order by 1")
        effects, stages = _read_costs(rows)
        return Figures(
            tables.sampled,
            Counter({row["category"]: row["scenes"] for row in by_category}),
            **rows(f"select count(distinct instance_id) as instances from assets where {_OBJECTS}")[0],
            **rows(_VIEWS)[0],
            **rows("select coalesce(sum(total_s), 0.0) as seconds from timings")[0],
            visibility=histograms("visible_fraction", 0.0, 1.0),
            inclination=histograms("degrees(inclination_rad)", -96.0, 96.0),
            distance=of_views("input", "d_z_m", *DEPTH_M),
            effects=dict(sorted(effects.items(), key=lambda item: (-item[1].seconds, -item[1].runs, item[0]))),
            stages=dict(sorted(stages.items(), key=lambda item: -item[1].seconds)),
            failures=[Failure(**row) for row in rows(_FAILURES)],
            drawn={name: counts for name, sql in DRAWN.items() if (counts := _count_drawn(rows, sql))},
            room={side: _histogram(answer, sql, "scenes", Histogram(*ROOM_M)) for side, sql in _SIDES.items()},
            elevation=_histogram(answer, _ELEVATION, "scenes", Histogram(-96.0, 96.0)),
        )


_OBJECTS = "category not in ('table', 'board')"
"""Of assets; what they stand on is not counted."""


DRAWN = {
    "Environment": "surroundings.environment",
    "Lights": "len(surroundings.lights)",
    "Floor": "surroundings.floor",
    "Table": "surroundings.table",
    "Background": "surroundings.background",
    "Clutter objects": "len(surroundings.clutter)",
}
"""What is drawn of `look` and has a name or a number, by heading, in SQL."""

ROOM_M = (0.0, 60.0)
"""Range of counted sides of rooms, metres: that of `look.room`."""

_SIDES = {side: f"surroundings.room_m[{at}]" for at, side in enumerate(("length", "width"), 1)}
_KEY = "surroundings.lights[1].towards"
_ELEVATION = f"degrees(atan2({_KEY}[3], sqrt({_KEY}[1] ** 2 + {_KEY}[2] ** 2)))"

MOST_LOOKS = 12
_LOOKS = f"""
select scene_id from scenes where surroundings is not null
order by row_number() over (partition by {", ".join(DRAWN.values())} order by scene_id), scene_id limit {MOST_LOOKS}
"""


def choose_looks(tables: StoredTables) -> list[int]:
    """At most `MOST_LOOKS` scenes with surroundings: first those in which something else was drawn than in each before."""
    ids: list[int] = query(tables, _LOOKS)["scene_id"].to_pylist()
    return ids


def _count_drawn(rows: Callable[[str], list[dict[str, Any]]], sql: str) -> Counter[str]:
    """Scenes by what was drawn, in its order."""
    counted = rows(f"select {sql} as name, count(*) as scenes from scenes where name is not null group by 1 order by 1")
    return Counter({str(row["name"]): row["scenes"] for row in counted})


def _histogram(answer: Question, column: str, source: str, histogram: Histogram) -> Histogram:
    """The histogram with a column of rows, batch by batch."""
    for batch in answer(f"select value from (select {column}::double as value from {source}) where value is not null"):
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
