"""Labels beside the points of a plot, placed where they hide nothing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

from services.study.report.axes import DOTS, renderer_of

SPACE_X, SPACE_Y = 5.0, 1.0
"""Pixels kept free around a label: more at its sides, so that two do not read as one."""

_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Right of the point first, then left, above, below and the corners."""

_DISTANCES = (6.5, 9.0, 16.0, 26.0, 38.0)
"""Points from the middle of the marker to the label."""

_LED = 16.0
"""From this distance on a line leads to the label."""

ON_LINE = 12.0
"""Points of distance that a label accepts to avoid one line."""


@dataclass(frozen=True)
class Label:
    """A text beside a point of an axes, in data coordinates; the lowest rank is placed first.

    `must`: bold, and may stand at any of the distances.
    """

    text: str
    at: tuple[float, float]
    color: str
    rank: float
    must: bool = False


def place_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Draw the labels within the axes, over no marker and no other label, and over as few lines as can be.

    A label without room is left out. The axes must have its final place and content.
    """
    taken = [box for line in axes.get_lines() for box in marker_boxes(line)]
    paths = [
        line.get_path().transformed(line.get_transform()) for line in axes.get_lines() if line.get_linestyle() != "None"
    ]
    for label in sorted(labels, key=lambda label: (label.rank, label.text)):
        note = axes.annotate(
            label.text,
            label.at,
            (0.0, 0.0),
            textcoords="offset points",
            color=label.color,
            fontsize=9.0,
            fontweight="bold" if label.must else "normal",
            zorder=6,
            arrowprops={"arrowstyle": "-", "color": label.color, "lw": 0.6, "shrinkA": 0, "shrinkB": 6},
        )
        spots = [(cost, spot, led, _put(axes, note, spot)) for cost, spot, led in _spots(label)]
        free = [
            (cost + ON_LINE * sum(path.intersects_bbox(box, filled=False) for path in paths), spot, led, box)
            for cost, spot, led, box in spots
            if box is not None and not any(box.padded(SPACE_X, SPACE_Y).overlaps(other) for other in taken)
        ]
        if not free:
            note.remove()
            continue
        _, spot, led, box = min(free, key=lambda one: one[0])
        _put(axes, note, spot)
        taken.append(box)
        assert note.arrow_patch is not None
        note.arrow_patch.set_visible(led)


def _spots(label: Label) -> Iterator[tuple[float, dict[str, Any], bool]]:
    """Cost, properties of the text and whether a line leads there, of every place that a label may have."""
    for distance in _DISTANCES if label.must else _DISTANCES[:3]:
        for turn, (x, y) in enumerate(_DIRECTIONS):
            reach = distance * (0.75 if x and y else 1.0)
            side = {"ha": ("center", "left", "right")[x], "va": ("center", "bottom", "top")[y]}
            yield distance + 0.3 * turn, {"position": (x * reach, y * reach), **side}, distance >= _LED


def _put(axes: Axes, note: Annotation, spot: dict[str, Any]) -> Bbox | None:
    """Move the text there; its box in pixels, None where it leaves the axes."""
    renderer = renderer_of(axes.figure)
    note.set(**spot)
    note.update_positions(renderer)
    box, frame = Text.get_window_extent(note, renderer), axes.get_window_extent(renderer)
    inside = box.x0 >= frame.x0 + 2 and box.x1 <= frame.x1 and box.y0 >= frame.y0 + 2 and box.y1 <= frame.y1
    return box if inside else None


def marker_boxes(line: Line2D) -> list[Bbox]:
    """The boxes in pixels of a line's markers."""
    if line.get_marker() in ("None", "", None):
        return []
    half = line.get_markersize() / 2 * DOTS / 72
    return [Bbox([at - half, at + half]) for at in line.get_transform().transform(line.get_xydata())]
