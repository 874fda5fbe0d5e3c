"""The sections of the page. Pure: figures and pictures to HTML."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from html import escape

from schemas.errors import command_line, describe_seconds, milliseconds, number, plural, size
from schemas.job.assets import SPLITS
from schemas.job.job import Job
from services.look.charts import Chart, Histogram, amount, chart_html
from services.look.clouds import Space
from services.look.collect import COLUMNS, Cost, Failure, Figures, SceneTable
from services.look.pictures import SHOWN_ROLES


def space_html(spaces: Sequence[Space], data: str) -> str:
    """The 3-D view with its controls; `data` is what its script reads. Empty where there is nothing to show."""
    if not spaces:
        return ""
    roles = {cloud.role for space in spaces for cloud in space.clouds}
    switches = [(f"{role} cloud", role) for role in SHOWN_ROLES if role in roles]
    switches += [("mesh", "mesh")] if any(space.bodies for space in spaces) else []
    switches += [("cameras", "cameras")]
    boxes = "".join(
        f'<label><input type="checkbox" data-part="{part}" checked> {name}</label>' for name, part in switches
    )
    boxes += '<label><input type="checkbox" data-part="tint"> colour by camera</label>'
    options = "".join(
        f'<option value="{at}" data-missing="{escape(space.missing)}">'
        f"{escape(space.category)}, scene {space.scene_id}</option>"
        for at, space in enumerate(spaces)
    )
    whose = "both cameras" if len(roles) > 1 else "the camera"
    about = f"The stored depth of {whose} as points, with the mesh as it was posed."
    keys = "Arrow keys turn, plus and minus zoom, 0 resets."
    return (
        f'<p class="sub">{about}<span id="space-missing">{escape(spaces[0].missing)}</span></p>'
        f'<div class="tools"><label>Scene <select id="space-scene">{options}</select></label>{boxes}'
        '<button type="button" class="quiet" id="space-reset">Reset</button></div>'
        '<div class="space"><canvas id="space-canvas" tabindex="0" role="img" '
        f'aria-label="3-D view of the point clouds and the mesh. {keys}"></canvas></div>'
        f'<p class="note" id="space-note">Drag to turn. {keys} Click it before you zoom with the wheel.</p>'
        f'<script type="application/json" id="space-data">{data}</script>'
    )


def overview_html(
    figures: Figures, job: Job, failed: int, splits: Mapping[str, Mapping[str, int]] | None = None
) -> str:
    """Totals, and the scenes of each category, and of its splits."""
    tiles = [
        ("scenes", f"{figures.scenes:,}", f"of {job.scenes:,} asked"),
        ("failed", f"{failed:,}", f"{number(round(100 * failed / max(failed + figures.scenes, 1), 2))} % of those tried"),
        ("pairs of views", f"{figures.pairs:,}", plural(figures.views, 'view'))
        if job.cameras.mirror.enabled
        else ("views", f"{figures.views:,}", f"of {plural(figures.scenes, 'scene')}"),
        ("objects", f"{figures.instances:,}", f"different ones in {plural(len(figures.by_category), 'category')}"),
        ("images", f"{figures.files:,}", size(figures.bytes / 1e3)),
        ("time", describe_seconds(figures.seconds), f"{milliseconds(1e3 * figures.seconds / max(figures.scenes, 1))} a scene"),
    ]  # fmt: skip
    tiles_html = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}<small>{escape(more)}</small></dd></div>"
        for name, value, more in tiles
    )
    shown = (
        [name for name in SPLITS if name != "unseen" or any(count[name] for count in splits.values())] if splits else []
    )
    by_split = ", and by their splits in exports" if shown else ""
    parts = {split: {name: count[split] for name, count in splits.items()} for split in shown} if splits else {}
    table = bars_html(f"Scenes by category{by_split}", figures.by_category, parts)
    sampled = "The dataset is not finished and large: the figures are of ranges chosen evenly from it."
    note = f'<p class="note">{sampled}</p>' if figures.sampled else ""
    return f'<dl class="tiles">{tiles_html}</dl>{table}{note}'


def bars_html(caption: str, counts: Mapping[str, int], parts: Mapping[str, Mapping[str, int]]) -> str:
    """A table of counts by name, with bars, and of parts of each count by heading. Empty without counts."""
    if not counts:
        return ""
    most = max(counts.values())
    frame = 'class="share" viewBox="0 0 100 8" preserveAspectRatio="none" aria-hidden="true"'
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="wide"><svg {frame}><rect class="bar" '
        f'width="{100 * count / most:.1f}" height="8"/></svg></td><td>{count:,}</td>'
        f"{''.join(f'<td>{part[name]:,}</td>' for part in parts.values())}</tr>"
        for name, count in counts.items()
    )
    heads = "".join(f'<th scope="col">{name}</th>' for name in ("", "", "all", *parts))
    head = f"<thead><tr>{heads}</tr></thead>" if parts else ""
    return f'<table class="bars"><caption>{escape(caption)}</caption>{head}<tbody>{rows}</tbody></table>'


MOST_NAMES = 12
"""Of a thing that is drawn, those drawn most often."""


def look_html(figures: Figures, strips: Sequence[str]) -> str:
    """What was drawn of `look`, with scenes to look at. Empty where no scene has any of it."""
    metres, degrees = partial(amount, unit="m"), partial(amount, unit="°")
    charts = (
        Chart("Room", figures.room, "Inside, of each scene that has one.", metres),
        Chart("Elevation of the light", {"": figures.elevation}, "Of the one that casts shadows.", degrees),
    )
    tables = "".join(
        bars_html(
            f"{name}{f', the {MOST_NAMES} most frequent of {len(counts):,}' if len(counts) > MOST_NAMES else ''}",
            counts if len(counts) <= MOST_NAMES else dict(counts.most_common(MOST_NAMES)),
            {},
        )
        for name, counts in figures.drawn.items()
    )
    shown = "".join(map(chart_html, charts))
    columns = "".join(f"<div{kind}>{part}</div>" for kind, part in (("", tables), (' class="charts"', shown)) if part)
    sheet = f'<div class="latest">{"".join(strips)}</div>' if strips else ""
    return f'<div class="charts">{columns}</div>{sheet}' if columns else ""


def charts_html(figures: Figures, depth: Mapping[str, Histogram]) -> str:
    """The histograms."""
    metres, degrees = partial(amount, unit="m"), partial(amount, unit="°")
    shown = (
        Chart(
            "Depth of the objects", depth, "Along the optical axis, of object pixels in the scenes shown above.", metres
        ),
        Chart(
            "Distance to the object",
            {"": figures.distance},
            "d_z of each input view.",
            metres,
        ),
        Chart(
            "Visibility",
            figures.visibility,
            "Share of the object's own pixels that the frame holds and nothing covers.",
            lambda share: amount(100.0 * share, "%"),
        ),
        Chart("Inclination", figures.inclination, "Angle of the optical axis below the horizontal.", degrees),
    )
    return f'<div class="charts">{"".join(map(chart_html, shown))}</div>'


def effects_html(figures: Figures) -> str:
    """What ran, how often and for how long; what was left out and why; the time of each stage."""
    never = {name: cost for name, cost in figures.effects.items() if not cost.runs}
    rows = [
        (
            f"<code>{escape(name)}</code>{_why(cost)}",
            f"{cost.runs:,}<small>{cost.runs / max(figures.scenes, 1):.0%}</small>",
            *_times(cost),
        )
        for name, cost in figures.effects.items()
        if cost.runs
    ]
    stages = [
        (f"<code>{escape(name)}</code>", f"{cost.seconds / max(figures.seconds, 1e-9):.1%}", *_times(cost))
        for name, cost in figures.stages.items()
    ]
    never_rows = "".join(
        f"<dt><code>{escape(name)}</code></dt><dd>{escape('; '.join(cost.skips) or 'not told')}</dd>"
        for name, cost in sorted(never.items())
    )
    left_out = (
        f'<details><summary>{plural(len(never), "effect")} that ran in no scene, and why</summary><dl class="why">{never_rows}'
        "</dl></details>"
    )
    ran = table_html(("effect", "scenes", "time", "each"), rows, "Effects that ran") if rows else ""
    note = '<p class="note">An effect without a time is counted with its stage.</p>'
    by_stage = table_html(("stage", "share", "time", "each"), stages, "Time by stage")
    return f"{ran}{note}{left_out if never else ''}{by_stage}"


def failures_html(failures: Iterable[Failure], scenes: int) -> str:
    """Each way of failing, with its reason in full and scenes to look at."""
    items = [
        f'<li><p><strong>{escape(one.reason.replace("_", " "))}</strong> <span class="count">{plural(one.scenes, "scene")}'
        f"</span></p><p>{escape(one.detail)}</p><p class=\"note\">Stage {escape(one.stage)}, {escape(one.kind)}; for example "
        f"scene {', '.join(map(str, one.examples))}.</p></li>"
        for one in failures
    ]  # fmt: skip
    if not items:
        return f'<p class="empty">No scene failed{f" of {scenes:,}" if scenes else ""}.</p>'
    return f'<ul class="failures">{"".join(items)}</ul>'


def table_html(head: Iterable[str], rows: Iterable[Iterable[str]], caption: str = "") -> str:
    """A table of HTML cells; the first is the row's name."""
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
        for first, *cells in rows
    )
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f"<table>{title}<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>"


def _why(cost: Cost) -> str:
    """The most frequent reason for leaving an effect out."""
    if not cost.skips:
        return ""
    (why, times), *others = cost.skips.most_common()
    more = f", {plural(len(others), 'more reason')}" if others else ""
    return f"<small>left out {times:,} ×: {escape(why)}{more}</small>"


def _times(cost: Cost) -> tuple[str, str]:
    """(in all, each run)."""
    if not cost.timed:
        return ("–", "–")
    return describe_seconds(cost.seconds), milliseconds(1e3 * cost.seconds / cost.timed)


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
