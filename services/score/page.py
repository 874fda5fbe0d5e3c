"""The page of a score: one HTML file that needs nothing beside it. The answer first, then tables, distributions and cases."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import number, plural
from schemas.scene.shape import REGION_FIRST_OBJECT
from services.dataset.dataset import Dataset
from services.look.charts import Chart, Histogram, amount, chart_html
from services.look.pictures import Picture, depth_span, picture_of_codes, picture_of_colour, picture_of_depth, viridis
from services.look.report import POLICY, Page, Section, fill_page, read_web
from services.score.predictions import Predictions, read_image
from services.score.summary import HEADLINES, Figure, is_better_high, metrics_of, values_of

CASES: Final = 3
"""Worst cases, and median ones, of each kind of image."""

MARGIN: Final = 0.3
"""Shown about an object, as a share of its size."""

LEAST_SCALE_M: Final = 0.001
GREY: Final = 128
"""The colour of holes in the picture of a difference."""

RGB_SCALE: Final = 64

_SHOWN: Final = ("depth_mae_m", "rgb_psnr_db", "shape_chamfer_l1_m", "volume_iou", "pose_add_m")
"""The metric of each kind that is told first, and by which cases are chosen."""

_CHARTS: Final = (
    ("Depth of the object", {"seen": "depth_mae_seen_m", "hidden": "depth_mae_hidden_m"}),
    ("Depth within 2 mm", {"": "depth_within_2mm"}),
    ("PSNR", {"": "rgb_psnr_db"}),
    ("SSIM", {"": "rgb_ssim"}),
    ("Chamfer distance", {"": "shape_chamfer_l1_m"}),
    ("F-score at 2 mm", {"": "shape_fscore_2mm"}),
    ("IoU", {"": "shape_iou"}),
    ("IoU at the volume's points", {"": "volume_iou"}),
    ("ADD", {"": "pose_add_m"}),
    ("Rotation", {"": "pose_rotation_deg"}),
)

_UNITS: Final = {"_m": (1e3, "mm"), "_m2": (1e6, "mm²"), "_deg": (1.0, "°"), "_px": (1.0, "px"), "_db": (1.0, "dB")}

_STYLE: Final = (
    ".table { overflow-x: auto; margin-bottom: 2rem; } .case { margin-top: 2rem; } .case > div { display: grid; gap: .5rem; "
    "grid-template-columns: repeat(3, 1fr); max-width: 48rem; } .case img { width: 100%; image-rendering: pixelated; "
    "border-radius: 3px; } .case figcaption { font-size: .8125rem; } .case h3 { margin-bottom: .5rem; }"
)


def told(name: str, value: float | int | None) -> str:
    """A value of a metric in words: lengths in millimetres; a dash for none."""
    if value is None or not np.isfinite(value):
        return "–"
    times, unit = _UNITS.get(name[name.rfind("_") :], (1.0, ""))
    return amount(value * times, unit) if unit else number(value)


def interval(name: str, figure: Figure) -> str:
    """`low to high`; empty where there is none."""
    return "" if figure["low"] is None else f"{told(name, figure['low'])} to {told(name, figure['high'])}"


def words(name: str) -> str:
    """The name of a metric for readers: `depth mae hidden`."""
    return name.removesuffix("_m").removesuffix("_deg").removesuffix("_db").replace("_", " ")


def answer_of(summary: Mapping[str, Any]) -> str:
    """One line with the first metric of every kind, and the numbers of items."""
    numbers = ", ".join(f"{summary[word]} {word}" for word in ("scored", "missing", "refused"))
    figures = [
        (name, summary["metrics"][name]) for name in (*_SHOWN, "depth_mae_hidden_m") if name in summary["metrics"]
    ]
    lines = [f"{words(name)} {told(name, one['value'])}{_in_brackets(interval(name, one))}" for name, one in figures]
    return ". ".join([*lines, f"{plural(summary['items'], 'item')}: {numbers}"]) + "."


def _in_brackets(text: str) -> str:
    return f" ({text})" if text else ""


def page_of(
    summary: Mapping[str, Any], table: pa.Table, troubles: Sequence[str], dataset: Dataset, given: Predictions
) -> str:
    """The whole page. `troubles`: a line for each refused or missing item that is named."""
    answer = f'<p class="lead">{escape(answer_of(summary))}</p>' + _troubles(troubles)
    note = (
        "Means over items, 95 % intervals by a bootstrap over scenes. Refused items count as worst, missing ones not. "
        "Seen and hidden: the object's pixels whose surface the input view sees, and does not."
    )
    sections = [
        Section("answer", "Answer", answer),
        Section("metrics", "Metrics", f'{_metrics(summary["metrics"])}<p class="note">{note}</p>'),
        Section("groups", "By group", "".join(_group(name, of) for name, of in summary["by"].items())),
        Section("distributions", "Distributions", _charts(table)),
        Section("cases", "Cases", "".join(_cases(table, dataset, given))),
    ]
    page = Page(
        f"Score of {given.folder.name}", f"Against {summary['dataset']}; alignment: {summary['align']}", sections, ""
    )
    icon = f"data:image/svg+xml,{quote(read_web('icon.svg').strip())}"
    style = f"<style>{read_web('page.css')}{_STYLE}</style>"
    return fill_page(
        page, policy=POLICY, style=style, icon=icon, scripts=f"<script>{read_web('page.js')}</script>", data=""
    )


def _troubles(lines: Sequence[str]) -> str:
    return f'<ul class="troubles">{"".join(f"<li>{escape(line)}</li>" for line in lines)}</ul>' if lines else ""


def _metrics(metrics: Mapping[str, Figure]) -> str:
    rows = [
        (
            f"{words(name)}<small><code>{name}</code></small>",
            told(name, one["value"]),
            interval(name, one) or "–",
            str(one["items"]),
        )
        for name, one in metrics.items()
        if one["items"]
    ]
    first, rest = rows[: sum(name in HEADLINES for name in metrics)], rows[sum(name in HEADLINES for name in metrics) :]
    head = ("metric", "mean", "95 % interval", "items")
    more = (
        f"<details><summary>{plural(len(rest), 'more metric')}</summary>{_table(head, rest)}</details>" if rest else ""
    )
    return _table(head, first) + more


def _group(title: str, groups: Mapping[str, Mapping[str, Figure]]) -> str:
    names = [name for name in HEADLINES if any(group.get(name, {}).get("items") for group in groups.values())][:6]
    rows = [
        (
            escape(word),
            *(f"{told(name, group[name]['value'])}<small>{interval(name, group[name])}</small>" for name in names),
        )
        for word, group in groups.items()
    ]
    return _table((title.replace("_", " "), *map(words, names)), rows) if rows else ""


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of HTML cells; the first is the row's name."""
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
        for first, *cells in rows
    )
    return f'<div class="table"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def _charts(table: pa.Table) -> str:
    figures = []
    for title, columns in _CHARTS:
        values = {word: values_of(table, name) for word, name in columns.items() if name in table.column_names}
        known = np.concatenate([*(one[np.isfinite(one)] for one in values.values()), np.empty(0)])
        if len(known):
            top = float(known.max()) or 1.0
            series = {word: Histogram(0.0, top).add(one) for word, one in values.items()}
            name = next(iter(columns.values()))
            figures.append(chart_html(Chart(title, series, f"Of an item; {words(name)}.", partial(told, name))))
    return f'<div class="charts">{"".join(figures)}</div>' if figures else ""


def _cases(table: pa.Table, dataset: Dataset, given: Predictions) -> Iterator[str]:
    """Worst and median items of depth and RGB in pictures: truth, prediction, difference."""
    for kind, name, draw in (("depth", "depth_mae_m", _depth_pictures), ("rgb", "rgb_psnr_db", _rgb_pictures)):
        for title, pose_id, value in choose_cases(table, kind, name):
            path = given.folder / kind / given.found[kind, pose_id, 0][0]
            images, scale = draw(dataset, pose_id, path)
            cells = "".join(
                f'<figure><img width="{one.width}" height="{one.height}" alt="{escape(one.words)}" src="{one.inline}">'
                f"<figcaption>{escape(one.words)}</figcaption></figure>"
                for one in images
            )
            head = (
                f'<h3>{kind}, {title}: {pose_id:05d} <span class="count">{words(name)} {told(name, value)}</span></h3>'
            )
            yield f'<div class="case">{head}<div>{cells}</div><p class="legend"><span>0 {_RAMP} {escape(scale)}</span></p></div>'


_RAMP: Final = (
    '<span class="ramp" style="background: linear-gradient(to right, '
    + ", ".join(f"rgb({r} {g} {b})" for r, g, b in viridis()[:: 255 // 5].tolist())
    + ')"></span>'
)


def choose_cases(table: pa.Table, kind: str, name: str) -> list[tuple[str, int, float]]:
    """(`worst` or `median`, pose id, value) of scored items of a kind, the worst first; none twice."""
    if name not in metrics_of(table):
        return []
    ok = np.array(
        [
            one == kind and status == "ok"
            for one, status in zip(*(table[c].to_pylist() for c in ("kind", "status")), strict=True)
        ]
    )
    values, ids = values_of(table, name), table["pose_id"].to_pylist()
    places = np.flatnonzero(ok & np.isfinite(values))
    order = places[np.argsort(values[places] if is_better_high(name) else -values[places], kind="stable")]
    start = max(CASES, (len(order) - CASES) // 2)
    return [
        (title, ids[place], float(values[place]))
        for title, chosen in (("worst", order[:CASES]), ("median", order[start : start + CASES]))
        for place in chosen
    ]


def _crop(dataset: Dataset, pose_id: int) -> tuple[Any, tuple[slice, slice]]:
    """The mirror view of a pose, and rows and columns about its objects."""
    view = dataset.pair(pose_id).mirror
    assert view is not None
    rows, columns = np.nonzero(view.segment() >= REGION_FIRST_OBJECT)
    if not len(rows):
        return view, (slice(None), slice(None))
    pad = 4 + int(MARGIN * max(np.ptp(rows), np.ptp(columns)))
    row, column = (slice(max(int(at.min()) - pad, 0), int(at.max()) + pad) for at in (rows, columns))
    return view, (row, column)


Drawn = tuple[tuple[Picture, Picture, Picture], str]
"""Truth, prediction and difference, and the value of the last colour."""


def _depth_pictures(dataset: Dataset, pose_id: int, path: Path) -> Drawn:
    view, crop = _crop(dataset, pose_id)
    true = view.depth() / view.depth_units_per_m
    predicted = read_image(path, true.shape, view.depth_units_per_m)[crop]
    mask, true = view.segment()[crop] >= REGION_FIRST_OBJECT, true[crop]
    off, both = np.abs(predicted - true), (predicted > 0.0) & (true > 0.0)
    own = off[both & mask] if (both & mask).any() else np.zeros(1)
    scale = max(float(np.percentile(own, 95)), LEAST_SCALE_M)
    span = depth_span(np.where(mask, true, 0.0))
    truth, guess = (
        picture_of_depth(one, span, word, sharp=True) for one, word in ((true, "truth"), (predicted, "prediction"))
    )
    return (truth, guess, _difference(off / scale, both, true > 0.0)), amount(scale * 1e3, "mm; holes are grey")


def _rgb_pictures(dataset: Dataset, pose_id: int, path: Path) -> Drawn:
    view, crop = _crop(dataset, pose_id)
    true = view.rgb()
    predicted, true = read_image(path, true.shape)[crop], true[crop]
    off = np.abs(predicted.astype(np.float64) - true).mean(axis=2)
    everywhere = np.ones(off.shape, np.bool_)
    truth, guess = picture_of_colour(true, "truth"), picture_of_colour(predicted, "prediction")
    return (truth, guess, _difference(off / RGB_SCALE, everywhere, everywhere)), f"{RGB_SCALE} of 255"


def _difference(share: Array, both: NDArray[np.bool_], true: NDArray[np.bool_]) -> Picture:
    """Shares [H, W] of the scale in viridis, dark is 0; grey where the prediction has a hole, black where there is no truth."""
    colours = viridis()[(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)].astype(np.uint16)
    colours[~both] = GREY
    colours[~true] = 0
    return picture_of_codes(colours * np.uint16(256), "difference")
