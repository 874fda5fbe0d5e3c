"""Edge: `verso score` scores predictions of a dataset, or compares two scores. Writes items.parquet, summary.json, index.html.

The page is one HTML file that needs nothing beside it: the answer first, then tables and distributions.
"""

import argparse
import json
import os
import re
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from schemas.errors import InputError, command_line, number, plural
from services.job.record import read_success, require_dataset, require_job
from services.look.charts import Chart, Histogram, amount, chart_html
from services.look.report import Page, Section, whole_page
from services.look.sections import table_html
from services.read.verdict import explain_damage
from services.run.progress import finish
from services.score.items import Asked
from services.score.predictions import find_predictions
from services.score.run import KEPT, describe_refused, score_dataset
from services.score.summary import (
    COUNTS_SQL,
    HEADLINES,
    ITEMS_FILE,
    Figure,
    compare,
    decide,
    items_of,
    query_of,
    summarise,
    values_of,
)
from workers.pool import alone_in
from workers.store.local import open_store

SUMMARY_FILE, PAGE_FILE = "summary.json", "index.html"

SCORE_VERSION = 3
"""The version of the format of summary.json."""


def main(options: argparse.Namespace) -> int:
    """0 where all of the split is predicted.

    Raises InputError where there is nothing to score, CorruptError where OUT is damaged.
    """
    store = require_dataset(open_store(options.out))
    if options.compare is not None:
        return _compare(options)
    if options.predictions is None:
        raise InputError(
            "name the folder of predictions: verso score OUT PREDICTIONS, or --compare A B for two that are scored"
        )
    given = find_predictions(options.predictions)
    chosen = options.split, options.level, options.volume
    asked = Asked(given.kinds, options.frame, *chosen, align=options.align, flip=options.flip)
    target = options.score or options.predictions / "score"
    with explain_damage(store), alone_in(target, KEPT, "verso score"):
        digest = (read_success(store) or {}).get("digest")  # before: it may be extended meanwhile
        path = score_dataset(store, given, asked, target)
        table = pq.read_table(path)
        head = {
            "verso_score": SCORE_VERSION,
            "dataset": options.out,
            "digest": digest,
            "predictions": str(given.folder),
        }
        rays = "covisible" in require_job(store).job.targets.views
        summary = {**head, "hidden_by": "rays" if rays else "image", **asdict(asked), **summarise(table)}
        write_text(target / SUMMARY_FILE, json.dumps(summary, indent=1) + "\n")
        troubles = describe_refused(path)
        write_text(target / PAGE_FILE, page_of(summary, items_of(table), troubles))
    for line in troubles:
        print(f"verso: {line}", file=sys.stderr)
    for name, figure in summary["metrics"].items():
        if name in HEADLINES and figure["items"]:
            ends, items = interval(name, figure), plural(figure["items"], "item")
            print(f"{name:28}{in_words(name, figure['value']):>12}  {ends:28}{items}, {covered(figure)}")
    print(answer_of(summary))
    print(f"page: {target / PAGE_FILE}")
    answer = {name: summary[name] for name in ("items", "missing", "refused", "unknown", "hidden_by", "metrics")}
    return finish(options, is_whole(summary), **answer, page=str(target / PAGE_FILE))


def check(options: argparse.Namespace) -> int:
    """Says by kind how many items are there and can be read, and what cannot and why; 0 where all of the split can be scored."""
    store = require_dataset(open_store(options.out))
    given = find_predictions(options.predictions)
    asked = Asked(given.kinds, options.frame, options.split, options.level, options.volume, check=True)
    with explain_damage(store), tempfile.TemporaryDirectory() as scratch:
        path = score_dataset(store, given, asked, Path(scratch))
        summary, troubles = summarise(pq.read_table(path)), describe_refused(path)
    for line in troubles:
        print(f"verso: {line}", file=sys.stderr)
    holes = summary["metrics"].get("depth_holes", {"coverage": 1.0})
    for kind, counts in summary["kinds"].items():
        left_out = f", {covered(holes)}" if kind == "depth" else ""
        print(
            f"{kind:8}{', '.join(f'{count} {word}' for word, count in counts.items())}{left_out}".replace(
                "scored", "there"
            )
        )
    whole = holes["coverage"] == 1.0 and not any(summary[word] for word in ("missing", "refused", "unknown"))
    return finish(
        options, whole, **{word: summary[word] for word in ("items", "missing", "refused", "unknown", "kinds")}
    )


def is_whole(summary: Mapping[str, Any]) -> bool:
    """Whether all that there is to predict is predicted, and nothing else is there."""
    headlines = (figure["coverage"] for name, figure in summary["metrics"].items() if name in HEADLINES)
    return not summary["unknown"] and all(share in (None, 1.0) for share in headlines)


def _compare(options: argparse.Namespace) -> int:
    """Prints which of two scores is surely better by each metric, and by how much."""
    a, b = map(str, options.compare)
    (one, head), (other, its_head) = (read_score(options.out, path) for path in options.compare)
    require_alike(options.out, a, head, b, its_head)
    metrics = compare(one, other, HEADLINES)
    decide(metrics.values())
    better = {"a": f"{a} is better", "b": f"{b} is better", None: "not decided"}
    for name, row in ((name, row) for name, row in metrics.items() if name in HEADLINES):
        verdict = better[row["better"]] if row["coverage"] == 1.0 else f"no verdict below full {covered(row)}"
        print(
            f"{name:28}{in_words(name, row['a']):>12}{in_words(name, row['b']):>12}  b - a: {interval(name, row):28}{verdict}"
        )
    return finish(options, True, a=a, b=b, metrics=metrics)


def require_alike(out: str, a: str, one: Mapping[str, Any], b: str, other: Mapping[str, Any]) -> None:
    """Raises InputError where two summaries are of different datasets, alignments, splits or levels."""
    if one["digest"] != other["digest"] or one["dataset"] != other["dataset"] != out:
        raise InputError(f"{a} and {b} are scores of different datasets")
    for key in ("align", "split", "level"):
        if one[key] != other[key]:
            raise InputError(f"{a} and {b} were scored with --{key} {one[key]} and {other[key]}: score both alike")


def read_score(out: str, path: Path) -> tuple[pa.Table, dict[str, Any]]:
    """The items and the summary of a folder of predictions or of its score. Raises InputError where it is not scored."""
    for folder in (path, path / "score"):
        if (folder / ITEMS_FILE).is_file() and (folder / SUMMARY_FILE).is_file():
            summary = json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
            if summary["verso_score"] == SCORE_VERSION:
                return pq.read_table(folder / ITEMS_FILE), summary
            again = command_line("score", out, path)
            raise InputError(f"{folder} was scored by the rules of another version: score it again with {again}")
    raise InputError(f"{path} has no score: make one with {command_line('score', out, path)}")


def write_text(path: Path, text: str) -> None:
    """Whole or not at all."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


SHOWN: Final = (
    "depth_auc_50mm",
    "depth_mae_m",
    "rgb_ncc",
    "shape_chamfer_l1_m",
    "volume_iou",
    "pose_add_m",
    "depth_mae_hidden_m",
)
"""The metrics of each kind that are told first."""

_CHARTS: Final = (
    ("Depth of the object", {"seen": "depth_mae_seen_m", "hidden": "depth_mae_hidden_m"}),
    ("Depth within 2 mm", {"": "depth_within_2mm"}),
    ("Cross-correlation of the object's colours", {"": "rgb_ncc"}),
    ("PSNR of the object", {"": "rgb_psnr_db"}),
    ("SSIM of the object", {"": "rgb_ssim"}),
    ("Chamfer distance", {"": "shape_chamfer_l1_m"}),
    ("F-score at 2 mm", {"": "shape_fscore_2mm"}),
    ("IoU", {"": "shape_iou"}),
    ("IoU at the volume's points", {"": "volume_iou"}),
    ("ADD", {"": "pose_add_m"}),
    ("Rotation", {"": "pose_rotation_deg"}),
)

_HIDDEN_BY: Final = {
    "rays": "by rays from the input camera, the stored image covisible",
    "image": "by the pixels of the input image, which leave some hundredths too many hidden",
}

_UNITS: Final = {"_m": (1e3, "mm"), "_m2": (1e6, "mm²"), "_deg": (1.0, "°"), "_px": (1.0, "px"), "_db": (1.0, "dB")}

_ACRONYMS: Final = (
    "auc",
    "mae",
    "rmse",
    "rgb",
    "ncc",
    "psnr",
    "ssim",
    "ms",
    "flip",
    "l1",
    "l2",
    "add",
    "s",
    "mssd",
    "mspd",
)
_WORDS: Final = {word: word.upper() for word in _ACRONYMS} | {"iou": "IoU", "fscore": "F-score", "1pct": "1 %"}
"""What is not written as in the names of columns."""

_STYLE: Final = (
    "table, pre { display: block; overflow-x: auto; } table { margin-bottom: 1rem; } details { margin: 0 0 2rem; } "
    "@media (max-width: 44rem) { th code { display: none; } }"
)


def in_words(name: str, value: float | int | None) -> str:
    """A value of a metric in words: lengths in millimetres; a dash for none."""
    if value is None or not np.isfinite(value):
        return "–"
    times, unit = _UNITS.get(name[name.rfind("_") :], (1.0, ""))
    return amount(value * times, unit) if unit else number(value)


def interval(name: str, figure: Figure) -> str:
    """`279 to 309 mm`; empty where there is none."""
    if figure["low"] is None:
        return ""
    low, high = (in_words(name, figure[end]) for end in ("low", "high"))
    unit = _UNITS.get(name[name.rfind("_") :], (1.0, ""))[1]
    return f"{low.removesuffix(unit).rstrip()} to {high}"


def covered(figure: Figure) -> str:
    """`coverage 97.3 %`; never 100 where anything is left out."""
    share = figure["coverage"] or 0.0
    return f"coverage {100.0 if share == 1.0 else min(100.0 * share, 99.99):.4g} %"


def words(name: str) -> str:
    """The name of a metric for readers: `depth MAE hidden`."""
    parts = re.sub("_(m2?|deg|db|px)$", "", name).split("_")
    return re.sub(r"(\d)mm", r"\1 mm", " ".join(_WORDS.get(part, part) for part in parts))


def answer_of(summary: Mapping[str, Any]) -> str:
    """One line with the first metric of every kind, and the numbers of items."""
    numbers = ", ".join(f"{summary[word]:,} {word}" for word in ("scored", "missing", "refused"))
    lines = []
    for name in SHOWN:
        if figure := summary["metrics"].get(name):
            ends = interval(name, figure)
            left_out = "" if figure["coverage"] == 1.0 else f", {covered(figure)}"
            lines.append(f"{words(name)} {in_words(name, figure['value'])}{ends and f' ({ends})'}{left_out}")
    return ". ".join([*lines, f"{plural(summary['items'], 'item')}: {numbers}"]) + "."


def page_of(summary: Mapping[str, Any], table: pa.Table, troubles: Sequence[str]) -> str:
    """The whole page. `troubles`: a line for each refused or missing item that is named."""
    items = "".join(f"<li>{escape(line)}</li>" for line in troubles)
    answer = f'<p class="lead">{escape(answer_of(summary))}</p><ul class="troubles">{items}</ul>'
    note = (
        "Means over all items of the split, and below them 95 % intervals by a bootstrap over scenes. What is missing, refused "
        "or a hole counts as worst. "
        "Seen and hidden: the object's pixels whose surface the input view sees, and does not, "
        f"{_HIDDEN_BY[summary['hidden_by']]}. "
        f"The queries make the numbers of each table, in metres, from {ITEMS_FILE} in the folder of this page, with DuckDB; the "
        "intervals alone are by resampling and not by a query."
    )
    names = table.column_names
    sections = [
        Section("answer", "Answer", answer + _query_html(COUNTS_SQL)),
        Section("metrics", "Metrics", f'{_metrics(summary["metrics"], names)}<p class="note">{note}</p>'),
        Section("groups", "By group", "".join(_group(name, of, names) for name, of in summary["by"].items())),
        Section("distributions", "Distributions", _charts(table)),
    ]
    page = Page(
        f"Score of {Path(summary['predictions']).name}",
        f"Against {summary['dataset']}; " + ", ".join(f"{key}: {summary[key]}" for key in ("split", "level", "align")),
        sections,
        "",
    )
    return whole_page(page, ("page.js",), _STYLE)


def _query_html(sql: str) -> str:
    return f"<details><summary>Query</summary><pre><code>{escape(sql)}</code></pre></details>"


def _with_interval(name: str, figure: Figure) -> str:
    return f"{in_words(name, figure['value'])}<small>{interval(name, figure)}</small>"


def _metrics(metrics: Mapping[str, Figure], columns: Sequence[str]) -> str:
    rows = {
        name: (
            f"{words(name)}<small><code>{name}</code></small>",
            _with_interval(name, figure),
            covered(figure).removeprefix("coverage "),
            in_words(name, figure["worst"]),
            f"{figure['items']:,}",
        )
        for name, figure in metrics.items()
        if figure["items"]
    }
    head = ("metric", "mean", "coverage", "at worst", "items")
    first, rest = (
        table_html(head, [rows[name] for name in names]) + _query_html(query_of(names, columns)) if names else ""
        for names in ([name for name in rows if (name in HEADLINES) == is_first] for is_first in (True, False))
    )
    count = sum(name not in HEADLINES for name in rows)
    return first + f"<details><summary>{plural(count, 'more metric')}</summary>{rest}</details>" * bool(rest)


def _group(title: str, groups: Mapping[str, Mapping[str, Figure]], columns: Sequence[str]) -> str:
    names = [name for name in SHOWN if any(group.get(name, {}).get("items") for group in groups.values())]
    rows = [(escape(word), *(_with_interval(name, group[name]) for name in names)) for word, group in groups.items()]
    if not names:
        return ""
    table = table_html((title.replace("_", " "), *map(words, names)), rows)
    return table + _query_html(query_of(names, columns, title))


def _charts(table: pa.Table) -> str:
    every = [name for _, columns in _CHARTS for name in columns.values() if name in table.column_names]
    figures, of_name = [], values_of(table, every)
    for title, columns in _CHARTS:
        values = {word: of_name[name] for word, name in columns.items() if name in of_name}
        known = np.concatenate([*(one[np.isfinite(one)] for one in values.values()), np.empty(0)])
        if len(known):
            top = float(known.max()) or 1.0
            series = {word: Histogram(0.0, top).add(one) for word, one in values.items()}
            name = next(iter(columns.values()))
            figures.append(chart_html(Chart(title, series, f"Of an item; {words(name)}.", partial(in_words, name))))
    return f'<div class="charts">{"".join(figures)}</div>' if figures else ""
