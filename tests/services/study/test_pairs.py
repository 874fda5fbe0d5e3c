"""What is measured together: what saves and keeps, what is more exact, and what meets the targets."""

from services.study.model import Figure, Row, Setting
from services.study.study import promising


def figure(value: float) -> Figure:
    return Figure(value, value, value, value, 10)


def row(name: str, ratio: float, depth: float, mask: float = 0.01) -> Row:
    parts = tuple((part.split("=")[0], part.split("=")[1]) for part in name.split(", ")) if name else ()
    setting = Setting(parts, dict(parts))
    errors = {"depth_mm": figure(depth), "mask_share": figure(mask)}
    return Row(setting, 100 * ratio, ratio, ratio, ratio, 1.0, errors, 0.0)


OWN = row("", 1.0, 0.1)


def names(*rows: Row, targets=None) -> set[str]:
    return {setting.name for setting in promising([OWN, *rows], targets or {"depth_mm": 0.0})}


def test_values_that_save_time_and_keep_every_error_are_joined():
    assert names(row("a=1", 0.8, 0.1), row("b=1", 0.9, 0.12)) == {"a=1, b=1"}


def test_what_makes_an_error_grow_is_not_joined():
    assert names(row("a=1", 0.8, 0.1), row("b=1", 0.5, 0.2)) == set()
    assert names(row("a=1", 0.8, 0.1), row("b=1", 0.5, 0.1, mask=0.1)) == set()


def test_an_error_that_stays_negligible_may_grow_by_any_factor():
    found = promising([row("", 1.0, 1e-6), row("a=1", 0.8, 1e-3), row("b=1", 0.9, 1e-4)], {"depth_mm": 0.0})
    assert [setting.name for setting in found] == ["a=1, b=1"]


def test_of_a_knob_only_the_cheapest_value_that_keeps_is_joined():
    assert names(row("a=1", 0.8, 0.1), row("a=2", 0.7, 0.1), row("b=1", 0.9, 0.1)) == {"a=2, b=1"}


def test_more_exact_values_are_joined_too():
    assert names(row("a=1", 1.5, 0.02), row("b=1", 1.1, 0.1, mask=0.002)) == {"a=1, b=1"}


def test_what_takes_many_times_as_long_is_not_measured_with_others():
    assert names(row("a=1", 9.0, 0.001), row("b=1", 1.1, 0.1, mask=0.002)) == set()


def test_three_knobs_make_three_pairs_and_all_at_once():
    three = [row("a=1", 0.8, 0.1), row("b=1", 0.9, 0.1), row("c=1", 0.7, 0.1)]
    assert names(*three) == {"a=1, b=1", "a=1, c=1", "b=1, c=1", "a=1, b=1, c=1"}


def test_names_follow_the_table_and_not_what_noise_makes_of_ranks():
    first, second = row("a=1", 0.8, 0.1), row("b=1", 0.8001, 0.1)
    assert names(first, second) == names(row("a=1", 0.8001, 0.1), row("b=1", 0.8, 0.1)) == {"a=1, b=1"}


def test_the_cheapest_values_that_meet_the_targets_are_tried_at_once():
    rows = (row("a=1", 0.5, 0.5), row("b=1", 0.6, 0.4), row("a=2", 0.4, 0.9))
    assert names(*rows, targets={"depth_mm": 0.5}) == {"a=1, b=1"}
