"""The pictures: they open, nothing lies outside them or over one another, and they say what the rows say."""

import dataclasses
import functools
import itertools
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.figure import Figure as Picture
from matplotlib.text import Annotation, Text
from PIL import Image
from services.study.axes import marker_boxes, plain_style, renderer_of

from services.study.model import Row, Study
from services.study.plots import (
    draw_knob,
    draw_tradeoff,
    headline,
    knob_rows,
    moved_errors,
    panels_of,
    single_knobs,
    write_plots,
)
from tests.made_up_studies import figure, large_study, row, study

OWN = row(moved_mm=0.1, depth_mm=0.1, mirror_mm=1.0)


def crowded() -> Study:
    """Long names, many knobs, and points that lie on one another."""
    names = [f"a long name of knob {n}=a long value of it {k}" for n in range(9) for k in range(4)]
    rows = [row(name, 0.9 + 0.005 * n, moved_mm=0.1 * (1 + n % 7), flip=0.1) for n, name in enumerate(names)]
    return study(dataclasses.replace(OWN, errors={**OWN.errors, "flip": figure(0.1)}), *rows)


STUDIES = {
    "large": large_study(),
    "crowded": crowded(),
    "the job alone": study(OWN),
    "one panel": study(row(flip=0.1), row("tier=flat", 0.5, flip=0.2)),
    "three panels": study(OWN, row("step=1", 3.0, moved_mm=0.0, mirror_mm=0.1), row("units=1", 0.9, depth_mm=0.5)),
    "all 0": study(row(moved_mm=0.0), row("step=1", 1.0, moved_mm=0.0)),
    "many words": dataclasses.replace(study(OWN), job="a long name" * 20, machine={"cpu": "A processor " * 20}),
}


@functools.cache
def drawn_once(name: str) -> list[Picture]:
    return drawn(STUDIES[name])


def drawn(made: Study) -> list[Picture]:
    with plain_style():
        knobs = [draw_knob(made, knob) for knob in single_knobs(made.rows)]
        pictures = [draw_tradeoff(made), *(picture for picture in knobs if picture is not None)]
        for picture in pictures:
            renderer_of(picture)
            picture.canvas.draw()
    return pictures


@pytest.fixture(params=STUDIES, scope="module")
def pictures(request: pytest.FixtureRequest) -> list[Picture]:
    return drawn_once(request.param)


def texts(picture: Picture) -> list[Text]:
    return [text for text in picture.findobj(Text) if isinstance(text, Text) and text.get_visible() and text.get_text()]


def test_no_text_lies_outside_the_picture(pictures: list[Picture]):
    for picture in pictures:
        assert len(texts(picture)) > 5
        for text in texts(picture):
            box = text.get_window_extent(renderer_of(picture))
            if box.width == 0:
                continue  # a tick outside of its axis is not drawn
            assert picture.bbox.x0 <= box.x0 and box.x1 <= picture.bbox.x1, text
            assert picture.bbox.y0 <= box.y0 and box.y1 <= picture.bbox.y1, text


def test_no_label_covers_another_or_leaves_its_axes(pictures: list[Picture]):
    for picture in pictures:
        renderer = renderer_of(picture)
        for axes in picture.axes:
            notes = [
                one for one in axes.texts if isinstance(one, Annotation) and one.get_text() and one.xycoords == "data"
            ]
            boxes = {note.get_text(): Text.get_window_extent(note, renderer) for note in notes}
            assert "the job" in boxes
            for one, other in itertools.combinations(boxes, 2):
                assert not boxes[one].overlaps(boxes[other]), (one, other)
            frame = axes.get_window_extent(renderer)
            assert all(
                frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1
                for box in boxes.values()
            )


def test_headings_of_neighbours_do_not_meet(pictures: list[Picture]):
    for picture in pictures:
        renderer = renderer_of(picture)
        for axes in picture.axes:
            heads = [text for text in [*axes.texts, axes.title, *texts_of_legend(axes)] if text.get_text()]
            right = max((text.get_window_extent(renderer).x1 for text in heads), default=0.0)
            others = [other.bbox.x0 for other in picture.axes if other.bbox.x0 > axes.bbox.x1]
            assert right <= min(others, default=picture.bbox.x1)


def texts_of_legend(axes) -> list[Text]:
    legend = axes.get_legend()
    return list(legend.get_texts()) if legend else []


def test_no_label_covers_a_point():
    for picture in drawn_once("large"):
        for axes in picture.axes:
            marks = [box for line in axes.get_lines() for box in marker_boxes(line)]
            notes = [
                one for one in axes.texts if isinstance(one, Annotation) and one.get_text() and one.xycoords == "data"
            ]
            assert len(marks) >= 2
            for note in notes:
                box = Text.get_window_extent(note, renderer_of(picture))
                assert not any(box.overlaps(mark) for mark in marks), note


def test_what_matters_most_is_always_labelled():
    picture = drawn_once("large")[0]
    for axes in picture.axes:
        labels = {text.get_text() for text in axes.texts}
        assert {"the job", "fast", "exact"} <= labels


def test_what_turns_several_knobs_is_named_on_the_front_alone():
    on, off = row("a=1, b=1", 2.0, flip=0.01), row("a=2, b=2", 3.0, flip=0.2)
    made = study(row(flip=0.1), row("a=3", 1.5, flip=0.09), on, off)
    labels = {text.get_text() for text in drawn(made)[0].axes[0].texts}
    assert "a=1, b=1" in labels and "a=2, b=2" not in labels


def test_the_pictures_open_and_one_is_of_each_knob(tmp_path: Path):
    written = write_plots(large_study(), tmp_path / "plots")
    assert written[0].name == "tradeoff.png" and sorted((tmp_path / "plots").iterdir()) == sorted(written)
    assert {"knob_step.png", "knob_depth_units.png", "knob_sensor.png"} <= {file.name for file in written}
    for file in written:
        with Image.open(file) as image:
            image.load()
            assert image.format == "PNG" and (image.width == 1800 or file != written[0])
            assert image.convert("L").getextrema() == (0, 255) or file != written[0]


def test_the_same_study_gives_the_same_bytes(tmp_path: Path):
    first = [file.read_bytes() for file in write_plots(STUDIES["three panels"], tmp_path / "a")]
    second = [file.read_bytes() for file in write_plots(STUDIES["three panels"], tmp_path / "b")]
    assert first == second


def test_drawing_needs_no_window_and_no_state_of_pyplot():
    code = "import sys, services.study.plots; sys.exit('matplotlib.pyplot' in sys.modules)"
    root = Path(__file__).resolve().parents[4]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, timeout=60, check=False).returncode == 0


def test_points_stand_where_the_rows_say():
    made = study(OWN, row("step=1", 2.0, moved_mm=0.02), row("step=2", 0.5, moved_mm=0.0))
    axes = drawn(made)[0].axes[0]
    points = {(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.get_lines() if line.get_marker() == "o"}
    bottom = [y for x, y in points if x == 59.0]
    assert (236.0, 0.02) in points and len(points) == 2
    assert axes.get_ylim()[0] < bottom[0] < 0.02
    tick = list(axes.get_yticks()).index(bottom[0])
    assert axes.get_yticklabels()[tick].get_text() == "0"


def test_the_front_is_a_staircase():
    made = study(OWN, row("step=1", 2.0, moved_mm=0.02), row("step=2", 3.0, moved_mm=0.05))
    front = drawn(made)[0].axes[0].get_lines()[0]
    assert list(zip(front.get_xdata(), front.get_ydata(), strict=True)) == [(118.0, 0.1), (236.0, 0.1), (236.0, 0.02)]


def test_the_headline_says_what_half_the_error_takes():
    made = study(
        OWN, row("step=1", 1.6, moved_mm=0.05), row("step=2", 1.2, moved_mm=0.06), row("dz=a", 0.98, mirror_mm=0.1)
    )
    told = headline(made, panels_of(made.rows))
    assert told == "A scene takes 118 ms; half the error takes 1.6 × the time at rest, no more time in the mirror"
    alone = study(OWN)
    assert (
        headline(alone, panels_of(alone.rows)) == "A scene takes 118 ms; no setting that was measured halves an error"
    )


def test_a_panel_says_what_less_error_takes():
    def told(*rows: Row) -> set[str]:
        return {text.get_text() for text in drawn(study(row(flip=0.1), *rows))[0].axes[0].texts}

    assert "half the error takes 2 × the time" in told(row("a=1", 2.0, flip=0.05), row("a=2", 3.0, flip=0.01))
    assert "40 % less error takes 1.5 × the time" in told(row("a=1", 1.5, flip=0.06))
    assert "nothing better was measured" in told(row("a=1", 0.5, flip=0.2))


def test_a_knobs_picture_shows_the_errors_that_it_moves_farthest_first():
    rows: list[Row] = [row(moved_mm=0.1, outcome_mm=0.1, depth_mm=0.1)]
    rows += [row(f"step={n}", 1.0 + n, moved_mm=0.1 / n, outcome_mm=0.1 / n**2, depth_mm=0.1) for n in (1, 2, 3)]
    assert moved_errors(rows, "step") == ["outcome_mm", "moved_mm"]
    assert [one.setting.name for one in knob_rows(rows, "step")] == ["step=1", "step=2", "step=3"]
    rows += [row("tier=flat", 0.5), row("preset=fast", 0.5, moved_mm=1.0), row("step=1, tier=flat", 0.4, moved_mm=1.0)]
    assert single_knobs(rows) == ["step", "tier"]
    assert draw_knob(study(*rows), "tier") is None
