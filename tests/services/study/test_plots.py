"""The pictures: nothing lies outside them, no label covers another, and they say what the rows say."""

import dataclasses
import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from matplotlib.text import Annotation, Text
from PIL import Image

from services.study.model import Study
from services.study.plots import (
    draw_knob,
    draw_tradeoff,
    headline,
    moved_errors,
    moving_rows,
    panels_of,
    round_ticks,
    single_knobs,
    write_plots,
)
from tests.services.study.made_up import row, stored, study

OWN = row(moved_mm=0.1, depth_mm=0.1, mirror_mm=1.0)


def crowded() -> Study:
    """Long names, many knobs, and points that lie on one another."""
    names = [f"a long name of knob {n}=a long value of it {k}" for n in range(9) for k in range(4)]
    rows = [row(name, 0.9 + 0.005 * n, moved_mm=0.1 * (1 + n % 7), flip=0.1) for n, name in enumerate(names)]
    made = study(row(moved_mm=0.1, depth_mm=0.1, mirror_mm=1.0, flip=0.1), *rows)
    return dataclasses.replace(made, job="a long name" * 20, machine={"cpu": "A processor " * 20})


STUDIES = (
    stored(),
    crowded(),
    study(OWN),
    study(OWN, row("step=1", 3.0, moved_mm=0.0, mirror_mm=0.1), row("units=1", 0.9, depth_mm=0.5)),
    study(row(moved_mm=0.0), row("step=1", 1.0, moved_mm=0.0)),
)


def drawn(made: Study) -> list[Picture]:
    """The picture of all settings, and that of the first knob which moves an error."""
    knobs = [knob for knob in single_knobs(made.rows) if moved_errors(made.rows, knob)]
    return [draw_tradeoff(made), *(draw_knob(made, knob) for knob in knobs[:1])]


def labels(axes: Axes) -> list[Annotation]:
    return [text for text in axes.texts if isinstance(text, Annotation)]


@pytest.mark.minute
def test_no_text_lies_outside_the_picture_and_no_label_covers_another():
    for picture in itertools.chain.from_iterable(map(drawn, STUDIES)):
        picture.draw_without_rendering()
        for text in picture.findobj(Text):
            box = text.get_window_extent()
            if text.get_visible() and text.get_text() and box.width:  # a tick outside of its axis is not drawn
                inside = picture.bbox.x0 <= box.x0 and box.x1 <= picture.bbox.x1
                assert inside and picture.bbox.y0 <= box.y0 and box.y1 <= picture.bbox.y1, text
        for axes in picture.axes:
            boxes = {note.get_text(): note.get_window_extent() for note in labels(axes)}
            assert "the job" in boxes
            assert not any(boxes[one].overlaps(boxes[other]) for one, other in itertools.combinations(boxes, 2))
            heads = [axes.title.get_window_extent().x1 for axes in picture.axes]
            assert all(end <= picture.bbox.x1 for end in heads)


def test_what_matters_most_is_labelled_and_each_knob_has_one_look_of_its_own():
    picture = draw_tradeoff(stored())
    looks: dict[str, set] = {}
    for axes in picture.axes:
        assert {"the job", "fast", "exact"} <= {note.get_text() for note in labels(axes)}
        for line in axes.get_lines():
            looks.setdefault(str(line.get_label()), set()).add((line.get_color(), line.get_marker()))
    assert {"step", "size", "colour", "the job as it is", "preset"} < looks.keys()
    assert all(len(found) == 1 for found in looks.values())
    assert len({look for found in looks.values() for look in found}) == len(looks)
    legend = {text.get_text() for text in picture.legends[0].get_texts()}
    assert legend == looks.keys() | {"95 % interval over scenes"}


def test_the_pictures_open_and_the_same_study_gives_the_same_bytes(tmp_path: Path):
    made = study(OWN, row("step=1", 3.0, moved_mm=0.0), row("depth units=1", 0.9, depth_mm=0.5), row("tier=flat", 0.5))
    written = write_plots(made, tmp_path / "a")
    assert [file.name for file in written] == ["tradeoff.png", "knob_step.png", "knob_depth_units.png"]
    assert sorted((tmp_path / "a").iterdir()) == sorted(written)
    assert [file.read_bytes() for file in written] == [file.read_bytes() for file in write_plots(made, tmp_path / "b")]
    with Image.open(written[0]) as image:
        assert image.width == 1800 and image.convert("L").getextrema() == (0, 255)


def test_points_and_front_stand_where_the_rows_say():
    rows = (row("step=1", 2.0, moved_mm=0.02), row("step=2", 0.5, moved_mm=0.0), row("step=3", 3.0, moved_mm=0.05))
    axes = draw_tradeoff(study(OWN, *rows)).axes[0]
    lines = {line.get_label(): list(zip(*line.get_data(), strict=True)) for line in axes.get_lines()}
    assert lines["step"] == [(236.0, 0.02), (59.0, 0.0), (354.0, 0.05)]
    assert lines["the job as it is"] == [(118.0, 0.1)]
    assert axes.get_ylim()[0] < 0.0 and axes.get_yticks()[0] == 0.0
    front = draw_tradeoff(study(OWN, rows[0], rows[2])).axes[0].get_lines()[0]
    assert list(zip(*front.get_data(), strict=True)) == [(118.0, 0.1), (236.0, 0.1), (236.0, 0.02)]


@given(st.floats(1e-9, 1e9), st.floats(1.2, 1e12))
def test_ticks_are_few_and_within_the_axis(low: float, times: float):
    ticks = round_ticks(low, low * times)
    assert 2 <= len(ticks) <= 7 and sorted(set(ticks)) == ticks
    assert all(low * (1 - 1e-9) <= tick <= low * times * (1 + 1e-9) for tick in ticks)


def test_titles_say_what_less_error_takes():
    rows = (row("step=1", 1.6, moved_mm=0.05), row("step=2", 1.2, moved_mm=0.06), row("dz=a", 0.98, mirror_mm=0.1))
    for made, told in (
        (study(OWN, *rows), "half the error takes 1.6 × the time at rest, no more time in the mirror"),
        (study(OWN), "no setting that was measured halves an error"),
    ):
        assert headline(made, panels_of(made.rows)) == f"A scene takes 118 ms; {told}"
    half = row("a=1", 1.5, flip=0.05)
    unsure = {"flip": dataclasses.replace(half.errors["flip"], high=0.2)}  # it may as well be larger than the job's
    for turned, told in (
        ((dataclasses.replace(half, errors=unsure), row("b=1", 2.0, flip=0.04)), "half the error takes 2 × the time"),
        ((row("a=1", 2.0, flip=0.05), row("a=2", 3.0, flip=0.01)), "half the error takes 2 × the time"),
        ((row("a=1", 1.5, flip=0.06),), "40 % less error takes 1.5 × the time"),
        ((row("a=1", 0.5, flip=0.2),), "nothing is surely better"),
        ((row("a=1", 0.5, flip=0.093),), "nothing is surely better"),  # to 0.102
        (
            (dataclasses.replace(half, errors={"flip": dataclasses.replace(half.errors["flip"], less=False)}),),
            "nothing is surely better",
        ),
        ((row("a=1", 0.5, flip=0.01, scenes=3), row("a=2", 0.4, flip=0.2)), "nothing is surely better"),
    ):
        assert draw_tradeoff(study(row(flip=0.1), *turned)).axes[0].get_title("left") == f"Colour: {told}"
    few = draw_tradeoff(study(row(flip=0.1, scenes=2), row("a=1", 0.5, flip=0.01)))
    assert few.axes[0].get_title("left") == "Colour: too few scenes to tell"
    rings = [line for line in few.axes[0].get_lines() if line.get_label() == "fewer than 4 scenes"]
    assert [tuple(map(tuple, line.get_xydata())) for line in rings] == [((118.0, 0.1),)]


def test_a_panel_shows_the_first_error_of_a_part_that_settings_move_and_the_knobs_that_move_it():
    rows = [row(pose_mm=0.0, outcome_mm=0.1, depth_mm=0.1), row("step=1", 1.5, pose_mm=0.0, outcome_mm=0.05)]
    assert [panel.error for panel in panels_of([*rows, row("units=1", 0.9, depth_mm=0.2)])] == [
        "outcome_mm",
        "depth_mm",
    ]
    assert [panel.error for panel in panels_of(rows)] == ["outcome_mm"]
    assert [panel.error for panel in panels_of(rows[:1])] == ["pose_mm", "depth_mm"]
    rows = [row(moved_mm=0.1), row("step=1", 1.5, moved_mm=0.2), row("step=2", 2.0, moved_mm=0.1)]
    others = [row("way=1", 1.1, moved_mm=0.104), row("way=1, rest=1", 1.1, moved_mm=0.2)]
    kept = [row("preset=fast", 0.5, moved_mm=0.1), row("step=1, way=1", 1.6, moved_mm=0.2)]
    assert moving_rows([*rows, *others, *kept], "moved_mm") == [*rows, *kept]


def test_a_knobs_picture_shows_the_errors_that_it_moves_farthest_first():
    rows = [row(f"step={n}", 1.0 + n, moved_mm=0.1 / n, outcome_mm=0.1 / n**2, depth_mm=0.1) for n in (1, 2, 3)]
    made = study(row(moved_mm=0.1, outcome_mm=0.1, depth_mm=0.1), *rows, row("preset=fast", 0.5, moved_mm=1.0))
    assert moved_errors(made.rows, "step") == ["outcome_mm", "moved_mm"] and single_knobs(made.rows) == ["step"]
    picture = draw_knob(made, "step")
    assert [axes.get_ylabel() for axes in picture.axes] == [
        "where things end, on the whole, mm",
        "motion when let go again, mm",
    ]
    assert [note.get_text() for note in labels(picture.axes[1])] == ["the job", "1", "2", "3"]
