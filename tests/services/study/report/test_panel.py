"""Panels: which error and which settings each shows, and how knobs look."""

from services.study.axes import COLORS

from services.study.plots import half_row, looks_of, moving_rows, panels_of
from tests.made_up_studies import large_study, row

OWN = row(moved_mm=0.1, depth_mm=0.1, mirror_mm=1.0)


def test_the_half_is_the_cheapest_with_at_most_half():
    rows = [OWN, row("a=1", 3.0, moved_mm=0.01), row("a=2", 2.0, moved_mm=0.05), row("a=3", 1.5, moved_mm=0.051)]
    half = half_row(rows, "moved_mm")
    assert half is not None and half.setting.name == "a=2"
    assert half_row([row(moved_mm=0.0)], "moved_mm") is None


def test_a_panel_shows_the_first_error_that_settings_move():
    rows = [row(moved_mm=0.0, outcome_mm=0.1, depth_mm=0.1), row("step=1", 1.5, moved_mm=0.0, outcome_mm=0.05)]
    rows += [row("units=1", 0.9, depth_mm=0.2)]
    assert [panel.error for panel in panels_of(rows)] == ["outcome_mm", "depth_mm"]


def test_a_part_of_which_the_job_alone_is_known_has_a_panel_only_where_there_is_no_other():
    rows = [row(moved_mm=0.1, depth_mm=0.1), row("step=1", 1.5, moved_mm=0.2)]
    assert [panel.error for panel in panels_of(rows)] == ["moved_mm"]
    assert [panel.error for panel in panels_of(rows[:1])] == ["moved_mm", "depth_mm"]


def test_a_knob_that_does_not_move_an_error_is_not_in_its_panel():
    rows = [row(moved_mm=0.1), row("step=1", 1.5, moved_mm=0.2), row("step=2", 2.0, moved_mm=0.1)]
    others = [row("way=1", 1.1, moved_mm=0.104), row("way=1, rest=1", 1.1, moved_mm=0.2)]
    kept = [row("preset=fast", 0.5, moved_mm=0.1), row("step=1, way=1", 1.6, moved_mm=0.2)]
    assert moving_rows([*rows, *others, *kept], "moved_mm") == [*rows, *kept]


def test_a_knob_looks_the_same_in_every_panel_and_as_no_other_in_it():
    rows = list(large_study().rows)
    looks = looks_of(rows, panels_of(rows))
    assert len({one["size"] for one in looks.values() if "size" in one}) == 1
    assert all(len(set(one.values())) == len(one) <= len(COLORS) for one in looks.values())
