"""Labels beside points: each where it hides nothing, or left out."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

PAD_ACROSS, PAD_UP = 5.0, 1.0
"""Pixels kept free around a label: more beside it, so that two do not read as one."""

_WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Right of the point first, then left, above, below and the corners."""

_DISTANCES = (6.5, 9.0, 16.0, 26.0, 38.0)
"""Points from the middle of the marker to the label; from the third on a line leads to it."""

_LED = 16.0

ON_LINE = 12.0
"""A label would rather stand this many points farther away than on a line."""


@dataclass(frozen=True)
class Label:
    """A text beside a point of an axes, in data coordinates; the most important are placed first.

    `must`: may stand as far away as there is room, with a line that leads to it.
    """

    text: str
    x: float
    y: float
    color: str
    rank: float
    must: bool = False
    size: float = 9.0


def place_labels(
    axes: Axes, renderer: RendererAgg, labels: Sequence[Label], marks: Sequence[Bbox], lines: Sequence[Bbox] = ()
) -> list[Annotation]:
    """Draw the labels that have room within the axes, over no mark and no other label; as little as can be over `lines`.

    `marks` and `lines` are boxes in pixels. A label that has no room is left out.
    """
    frame, taken, drawn = axes.get_window_extent(renderer), list(marks), []
    for label in sorted(labels, key=lambda label: (label.rank, label.text)):
        note = axes.annotate(
            label.text,
            (label.x, label.y),
            (0.0, 0.0),
            textcoords="offset points",
            color=label.color,
            fontsize=label.size,
            fontweight="bold" if label.must else "normal",
            ha="left",
            va="bottom",
            zorder=6,
        )
        found = _best_place(axes, note, label, renderer, frame, taken, lines)
        if found is None:
            note.remove()
            continue
        note.set_position(found[0])
        taken.append(found[1])
        drawn.append(note)
        if found[2] >= _LED:
            drawn.append(_lead(axes, label, found[1]))
    return drawn


def _best_place(
    axes: Axes,
    note: Annotation,
    label: Label,
    renderer: RendererAgg,
    frame: Bbox,
    taken: Sequence[Bbox],
    lines: Sequence[Bbox],
) -> tuple[tuple[float, float], Bbox, float] | None:
    """Offset in points, box in pixels and distance of the place that costs least."""
    dots = renderer.points_to_pixels(1.0)
    extent = note.get_window_extent(renderer)
    width, height = extent.width, extent.height
    x, y = axes.transData.transform((label.x, label.y))
    best: tuple[float, tuple[float, float], Bbox, float] | None = None
    for distance in _DISTANCES if label.must else _DISTANCES[:3]:
        for turn, (right, up) in enumerate(_WAYS):
            gap = distance * dots * (0.75 if right and up else 1.0)
            left = x + right * gap - (width if right < 0 else 0.0 if right > 0 else width / 2)
            bottom = y + up * gap - (height if up < 0 else 0.0 if up > 0 else height / 2)
            box = Bbox.from_bounds(left, bottom, width, height)
            if not _inside(box, frame) or any(_overlap(box, other) for other in taken):
                continue
            cost = distance + 0.3 * turn + ON_LINE * sum(_overlap(box, line) for line in lines)
            if best is None or cost < best[0]:
                best = (cost, ((left - x) / dots, (bottom - y) / dots), box, distance)
    return None if best is None else best[1:]


def _inside(box: Bbox, frame: Bbox) -> bool:
    return bool(box.x0 >= frame.x0 + 2 and box.x1 <= frame.x1 and box.y0 >= frame.y0 + 2 and box.y1 <= frame.y1)


def _overlap(box: Bbox, other: Bbox) -> bool:
    across = box.x0 - PAD_ACROSS < other.x1 and other.x0 < box.x1 + PAD_ACROSS
    return bool(across and box.y0 - PAD_UP < other.y1 and other.y0 < box.y1 + PAD_UP)


def _lead(axes: Axes, label: Label, box: Bbox) -> Annotation:
    """A thin line from the point to the nearest place of the label's box."""
    x, y = axes.transData.transform((label.x, label.y))
    end = (min(max(x, box.x0), box.x1), min(max(y, box.y0), box.y1))
    at = axes.transData.inverted().transform(end)
    return axes.annotate(
        "", (label.x, label.y), tuple(at), arrowprops={"arrowstyle": "-", "color": label.color, "lw": 0.6}, zorder=4
    )
