"""The sections of the page. Pure: figures and pictures to HTML."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from html import escape

from schemas.errors import describe_seconds, milliseconds, number, plural, size
from schemas.job.job import Job
from services.look.charts import Chart, Histogram, amount, chart_html, length_of_decade
from services.look.clouds import Space
from services.look.collect import Cost, Failure, Figures
from services.look.pictures import Sample, ShownScene
from services.look.sheets import Address, strip_html

Side = tuple[str, Figures, Sample]
"""Name, figures and shown scenes of one dataset."""


def beside_html(ours: Side, theirs: Side, address: Address) -> str:
    """A table of both datasets' figures, and a scene of each category that both have."""
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in ("", ours[0], theirs[0]))
    rows = "".join(
        f'<tr><th scope="row">{name}</th><td>{told(ours)}</td><td>{told(theirs)}</td></tr>'
        for name, told in _ROWS.items()
    )
    caption = "<caption>Medians, where nothing else is said</caption>"
    table = f"<table>{caption}<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>"
    first, second = ({scene.category for scene in side[2].scenes} for side in (ours, theirs))
    pairs = "".join(_pair(category, (ours, theirs), address) for category in sorted(first & second))
    only = "".join(
        f'<p class="note">Only in {escape(side[0])}: {escape(", ".join(sorted(own)))}.</p>'
        for side, own in ((ours, first - second), (theirs, second - first))
        if own
    )
    return f'{table}<div class="pairs">{pairs}</div>{only}'


def _pair(category: str, sides: Sequence[Side], address: Address) -> str:
    cells = [
        f'<div class="latest"><p class="note">{escape(name)}</p>{strip_html(_first(sample.scenes, category), address)}</div>'
        for name, _, sample in sides
    ]
    return f'<div class="pair">{"".join(cells)}</div>'


def _first(scenes: Sequence[ShownScene], category: str) -> ShownScene:
    return next(scene for scene in scenes if scene.category == category)


def _median(histograms: Mapping[str, Histogram], role: str, unit: str, times: float = 1.0) -> str:
    one = histograms.get(role)
    return amount(times * one.percentile(0.5), unit) if one is not None and one.count else "–"


_ROWS: dict[str, Callable[[Side], str]] = {
    "scenes": lambda side: f"{side[1].scenes:,}",
    "pairs of views": lambda side: f"{side[1].pairs:,}",
    "time of a scene, mean": lambda side: milliseconds(1e3 * side[1].seconds / max(side[1].scenes, 1)),
    "depth of the objects, input": lambda side: _median(side[2].depth, "input", "m"),
    "depth of the objects, mirror": lambda side: _median(side[2].depth, "mirror", "m"),
    "visibility, input": lambda side: _median(side[1].visibility, "input", "%", 100.0),
    "visibility, mirror": lambda side: _median(side[1].visibility, "mirror", "%", 100.0),
    "inclination, input": lambda side: _median(side[1].inclination, "input", "°"),
}


SAMPLES = {"surface": "surface samples", "inside": "volume inside", "outside": "volume outside"}
"""Clouds of the shapes' samples, by role."""


def space_html(spaces: Sequence[Space], data: str) -> str:
    """The 3-D view with its controls; `data` is what its script reads. Empty where there is nothing to show."""
    if not spaces:
        return ""
    clouds = {cloud.role: cloud for space in spaces for cloud in space.clouds}
    views = [role for role, cloud in clouds.items() if cloud.T_world_cam is not None]
    switches = [(f"{role} cloud", role, True) for role in views]
    switches += [("mesh", "mesh", True)] if any(space.bodies for space in spaces) else []
    switches += [("cameras", "cameras", True)]
    # They hide what the page shows first.
    switches += [(name, role, False) for role, name in SAMPLES.items() if role in clouds]
    boxes = "".join(
        f'<label><input type="checkbox" data-part="{part}"{" checked" if on else ""}> {escape(name)}</label>'
        for name, part, on in switches
    )
    boxes += '<label><input type="checkbox" data-part="tint"> colour by camera</label>'
    options = "".join(
        f'<option value="{at}" data-missing="{escape(one.missing)}">'
        f"{escape(one.category)}, scene {one.scene_id}</option>"
        for at, one in enumerate(spaces)
    )
    about = "The stored depth of both cameras as points, with the mesh as it was posed."
    if clouds.keys() & SAMPLES.keys():
        about += " Of an object, the input cloud is the partial cloud and surface samples are the complete one."
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


def overview_html(figures: Figures, job: Job, failed: int) -> str:
    """Totals, and the scenes of each category."""
    tiles = [
        ("scenes", f"{figures.scenes:,}", f"of {job.scenes:,} asked"),
        ("failed", f"{failed:,}", f"{number(round(100 * failed / max(failed + figures.scenes, 1), 2))} % of those tried"),
        ("pairs of views", f"{figures.pairs:,}", plural(figures.views, 'view')),
        ("objects", f"{figures.instances:,}", f"different ones in {plural(len(figures.by_category), 'category', 'categories')}"),
        ("images", f"{figures.files:,}", size(figures.bytes / 1e3)),
        ("time", describe_seconds(figures.seconds), f"{milliseconds(1e3 * figures.seconds / max(figures.scenes, 1))} a scene"),
    ]  # fmt: skip
    tiles_html = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}<small>{escape(more)}</small></dd></div>"
        for name, value, more in tiles
    )
    most = max(figures.by_category.values(), default=1)
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="wide">{_bar(count / most)}</td><td>{count:,}</td></tr>'
        for name, count in figures.by_category.items()
    )
    table = f'<table class="bars"><caption>Scenes by category</caption><tbody>{rows}</tbody></table>' if rows else ""
    return f'<dl class="tiles">{tiles_html}</dl>{table}{_sampled(figures)}'


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
            "d_z of each pair, which places the mirror camera.",
            metres,
        ),
        Chart(
            "Visibility",
            figures.visibility,
            "Share of the object's own pixels that the frame holds and nothing covers.",
            lambda share: amount(100.0 * share, "%"),
        ),
        Chart("Inclination", figures.inclination, "Angle of the optical axis below the horizontal.", degrees),
        Chart(
            "Resting gap",
            {"": figures.gap},
            "Largest height at which an object of the scene hovers; logarithmic.",
            length_of_decade,
            f"0 in {figures.no_gap:,} of {plural(figures.no_gap + figures.gap.count, 'scene')}"
            if figures.no_gap
            else "",
        ),
    )
    return f'<div class="charts">{"".join(map(chart_html, shown))}</div>'


def effects_html(figures: Figures) -> str:
    """What ran, how often and for how long; what was left out and why; the time of each stage."""
    ran = {name: cost for name, cost in figures.effects.items() if cost.runs}
    plain = [name for name, cost in ran.items() if not cost.timed and not cost.skips]
    never = {name: cost for name, cost in figures.effects.items() if not cost.runs}
    head = ("effect", "scenes", "time", "each")
    rows = [
        (f"<code>{escape(name)}</code>{_why(cost)}", _share(cost.runs, figures.scenes), *_times(cost))
        for name, cost in ran.items()
        if name not in plain
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
    return (
        f"{_table(head, rows, 'Effects that ran') if rows else ''}{_plain(plain)}"
        f"{left_out if never else ''}{_table(('stage', 'share', 'time', 'each'), stages, 'Time by stage')}"
    )


def failures_html(failures: Iterable[Failure], scenes: int) -> str:
    """Each way of failing, with its reason in full and scenes to look at."""
    items = [
        f'<li><p><strong>{escape(one.reason.replace("_", " "))}</strong> <span class="count">{plural(one.scenes, "scene")}'
        f"</span></p><p>{escape(one.detail)}</p><p class=\"note\">Stage {escape(one.stage)}, {escape(one.kind)}; for example "
        f"{escape(_listed(one.examples))}.</p></li>"
        for one in failures
    ]  # fmt: skip
    if not items:
        return f'<p class="empty">No scene failed{f" of {scenes:,}" if scenes else ""}.</p>'
    return f'<ul class="failures">{"".join(items)}</ul>'


def captures_html(figures: Figures) -> str:
    """The quality of each capture; empty where the dataset is of scenes."""
    if not figures.captures:
        return ""
    head = ("capture", "views", "corner error", "pose", "cloud", "complete", "measured")
    rows = [
        (
            f"{escape(one.name)}<small>{escape(one.category)}, scene {one.scene_id}, {escape(one.estimate)}</small>",
            f"{one.views}{f'<small>{one.left_out} left out</small>' if one.left_out else ''}",
            _figure(one.reprojection_px, "px"),
            _figure(one.pose_mm, "mm"),
            _figure(one.cloud_median_mm, "mm"),
            _figure(one.completeness, "%", 100.0),
            _figure(one.measured_share, "%", 100.0),
        )
        for one in figures.captures
    ]
    note = (
        "Corner error: median over the views after estimation. Pose, cloud (median) and completeness are held against the"
        " truth, which photographs do not have. Measured: share of the mirror views that is measured and not filled."
    )
    return f'{_table(head, rows, "Quality")}<p class="note">{note}</p>'


def _table(head: Iterable[str], rows: Iterable[Iterable[str]], caption: str) -> str:
    """A table of HTML cells; the first is the row's name."""
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
        for first, *cells in rows
    )
    return f"<table><caption>{escape(caption)}</caption><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>"


def _bar(share: float) -> str:
    return (
        '<svg class="share" viewBox="0 0 100 8" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="bar" width="{100 * share:.1f}" height="8"/></svg>'
    )


def _why(cost: Cost) -> str:
    """The most frequent reason for leaving an effect out."""
    if not cost.skips:
        return ""
    (why, times), *others = cost.skips.most_common()
    more = f", {len(others)} more {'reason' if len(others) == 1 else 'reasons'}" if others else ""
    return f"<small>left out {times:,} ×: {escape(why)}{more}</small>"


def _times(cost: Cost) -> tuple[str, str]:
    """(in all, each run)."""
    if not cost.timed:
        return ("–", "–")
    return describe_seconds(cost.seconds), milliseconds(1e3 * cost.seconds / cost.timed)


def _plain(names: Iterable[str]) -> str:
    """Effects of which there is no more to tell than that they ran."""
    listed = ", ".join(f"<code>{escape(name)}</code>" for name in names)
    every = f" Ran in every scene, and counted with its stage: {listed}." if listed else ""
    return f'<p class="note">An effect without a time is counted with its stage.{every}</p>'


def _share(part: int, whole: int) -> str:
    return f"{part:,}<small>{part / max(whole, 1):.0%}</small>"


def _figure(value: float | None, unit: str, times: float = 1.0) -> str:
    return "–" if value is None else f"{number(value * times)} {unit}"


def _listed(scenes: Iterable[int]) -> str:
    numbers = [str(scene) for scene in scenes]
    return f"scene{'s' if len(numbers) > 1 else ''} {', '.join(numbers)}"


def _sampled(figures: Figures) -> str:
    if not figures.sampled:
        return ""
    return '<p class="note">The dataset is not finished and large: the figures are of ranges chosen evenly from it.</p>'
