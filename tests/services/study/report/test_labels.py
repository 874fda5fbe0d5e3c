"""Labels: beside their points, over no marker and no other label, and left out where there is no room."""

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.text import Annotation, Text
from services.study.axes import Label, marker_boxes, new_picture, place_labels, renderer_of


@pytest.fixture
def axes() -> Axes:
    axes = new_picture(4.0, 3.0, 0.0).add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.figure.canvas.draw()
    return axes


def placed(axes: Axes) -> dict[str, Annotation]:
    return {one.get_text(): one for one in axes.texts if isinstance(one, Annotation)}


def test_a_label_with_room_stands_on_the_right_of_its_point(axes: Axes):
    place_labels(axes, [Label("here", (0.5, 0.5), "black", 0.0)])
    note = placed(axes)["here"]
    box = Text.get_window_extent(note, renderer_of(axes.figure))
    x, y = axes.transData.transform((0.5, 0.5))
    assert x < box.x0 < x + 30 and box.y0 < y < box.y1
    assert note.arrow_patch is not None and not note.arrow_patch.get_visible()


def test_a_label_at_the_right_edge_stands_on_the_left(axes: Axes):
    place_labels(axes, [Label("here", (0.99, 0.5), "black", 0.0)])
    box = Text.get_window_extent(placed(axes)["here"], renderer_of(axes.figure))
    assert box.x1 < axes.transData.transform((0.99, 0.5))[0]


def test_a_label_keeps_off_a_line_where_it_can(axes: Axes):
    line = axes.plot([0.5, 1.0], [0.5, 0.5])[0]
    place_labels(axes, [Label("here", (0.5, 0.5), "black", 0.0)])
    box = Text.get_window_extent(placed(axes)["here"], renderer_of(axes.figure))
    assert not line.get_path().transformed(line.get_transform()).intersects_bbox(box, filled=False)


def test_where_markers_leave_no_room_the_label_is_left_out(axes: Axes):
    across, up = (place.ravel() for place in np.meshgrid(*[np.linspace(0, 1, 30)] * 2))
    line = axes.plot(across, up, ls="", marker="o", ms=4)[0]
    assert len(marker_boxes(line)) == 900
    place_labels(axes, [Label("here", (0.5, 0.5), "black", 0.0, must=True)])
    assert placed(axes) == {}


def test_the_lowest_rank_is_placed_first(axes: Axes):
    labels = [Label(f"label {n}", (0.5, 0.5), "black", float(9 - n)) for n in range(9)]
    place_labels(axes, labels)
    found = placed(axes)
    line = found["label 8"].arrow_patch
    assert line is not None and not line.get_visible()
    boxes = [Text.get_window_extent(note, renderer_of(axes.figure)) for note in found.values()]
    assert not any(one.overlaps(other) for n, one in enumerate(boxes) for other in boxes[:n])
