"""The table of all scenes with their splits and figures, the worst first, to sort and filter on the page."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from schemas.errors import command_line, number, plural
from schemas.job.assets import SplitShares
from services.dataset.dataset import Splits, collect_ids, split_by_category, strictest
from services.look.collect import Tables
from services.look.sections import table_html
from services.read.query import query

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

SQL = f"""
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


def read_scene_table(tables: Tables, shares: SplitShares, scenes: int) -> SceneTable:
    """The table of a dataset with so many scenes."""
    if not 0 < scenes <= MOST_RANKED:
        return SceneTable()
    columns = ("instance_id", "category", "split")
    assets = [row for rows in tables.batches("assets", columns) for row in rows.to_pylist()]
    of = Splits(split_by_category(collect_ids([assets]), shares))
    split_of = {row["instance_id"]: of.of(row) for row in assets}
    rows, splits = query(tables.store, SQL).to_pylist(), dict[str, Counter[str]]()
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


def scene_table_html(table: SceneTable, place: str) -> str:
    """The table with a field that filters and headings that sort. `place`: the dataset, of which SQL tells the rest."""
    if not table.rows:
        return ""
    shown = [name for name in COLUMNS if any(row[name] is not None for row in table.rows)]
    rows = [
        (
            str(row["scene_id"]),
            escape(f"{row['category']} {row['name']}".strip()),
            row["split"],
            *(_cell(row[name], name == row["worst"]) for name in shown),
        )
        for row in table.rows
    ]
    all_of_them = f"All: {command_line('query', place, 'select * from scenes')}"
    note = f"{plural(len(rows), 'scene')}, first the worst in some figure (bold). A heading sorts. {all_of_them}"
    field = '<label>Only with <input id="scenes-filter" type="search" placeholder="mug test"></label>'
    html = table_html(("scene", "category", "split", *shown), rows)
    return f'<div class="tools">{field}</div><div id="scenes-table">{html}</div><p class="note">{escape(note)}</p>'


def _cell(value: float | None, is_worst: bool) -> str:
    words = "–" if value is None else number(value)
    return f"<strong>{words}</strong>" if is_worst else words
