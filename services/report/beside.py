"""Two datasets side by side, captures beside scenes above all: their figures, and a scene of each category. Pure."""

from collections.abc import Callable, Mapping, Sequence
from html import escape

from services.report.charts import amount
from services.report.collect import Figures
from services.report.gallery import Address, strip_html
from services.report.histogram import Histogram
from services.report.sample import Sample, ShownScene
from services.study.words import milliseconds

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
