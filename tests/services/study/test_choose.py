"""Which settings are worth their time, on rows whose answer is known because they were made up."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import InputError
from services.study.choose import (
    AS_CHEAP,
    TargetError,
    as_cheap,
    choose,
    close_calls,
    error_of,
    front,
    own_row,
    parse_targets,
)
from services.study.knobs import job_tree_with
from services.study.model import ERRORS, Row
from tests.made_up_studies import large_study, row

OWN = row(depth_mm=0.1, penetration_mm=0.01, mirror_mm=1.0)


def names(rows: list[Row]) -> list[str]:
    return [one.setting.name for one in rows]


# ---------------------------------------------------------------------------------------------- the front


def test_the_front_goes_from_the_cheapest_to_the_best():
    beaten = row("step=120", 1.2, depth_mm=0.1)
    cheap, good = row("step=60", 0.5, depth_mm=0.4), row("step=960", 3.0, depth_mm=0.0)
    unmeasured = row("tier=flat", 0.1, flip=0.3)
    assert names(front([good, beaten, unmeasured, cheap, OWN], "depth_mm")) == ["step=60", "the job", "step=960"]


def test_of_settings_alike_the_first_by_name_stands_on_the_front():
    rows = [row(f"step={name}", 1.0, depth_mm=0.1) for name in "cab"]
    assert names(front(rows, "depth_mm")) == ["step=a"]
    assert names(front(rows[::-1], "depth_mm")) == ["step=a"]


def test_what_is_as_cheap_but_worse_or_as_good_but_dearer_is_off_the_front():
    rows = [row("step=1", 1.0, depth_mm=0.2), row("step=2", 1.0, depth_mm=0.1), row("step=3", 1.5, depth_mm=0.1)]
    assert names(front(rows, "depth_mm")) == ["step=2"]


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 12)), max_size=30))
def test_the_front_is_what_comparing_all_with_all_leaves(places: list[tuple[int, int]]):
    rows = [row(f"step={n:02}", ratio, depth_mm=error) for n, (ratio, error) in enumerate(places)]
    undominated = {
        place
        for place in places
        if not any(other != place and other[0] <= place[0] and other[1] <= place[1] for other in places)
    }
    found = front(rows, "depth_mm")
    assert {(one.ratio, one.errors["depth_mm"].value) for one in found} == undominated
    assert len(found) == len(undominated)


def test_times_that_overlap_are_as_cheap():
    assert as_cheap(row("step=1", 1.0, noise=0.03), row("step=2", 1.05, noise=0.03))
    assert not as_cheap(row("step=1", 1.0, noise=0.02), row("step=2", 1.05, noise=0.02))
    assert not as_cheap(row("step=2", 1.05, noise=0.02), row("step=1", 1.0, noise=0.02))


# ---------------------------------------------------------------------------------------------- the choice


def test_the_cheapest_that_meets_all_targets_is_chosen():
    rows = [
        OWN,
        row("step=60", 0.4, penetration_mm=0.2),
        row("step=120", 0.7, penetration_mm=0.05),
        row("size=small", 0.5, depth_mm=0.3),
    ]
    assert choose(rows, {"penetration_mm": 0.05}).setting.name == "size=small"  # its penetration is the job's own
    assert choose(rows, {"penetration_mm": 0.05, "depth_mm": 0.1}).setting.name == "step=120"
    assert choose(rows, {"penetration_mm": 0.04, "depth_mm": 0.1}).setting.name == "the job"


def test_an_error_that_a_setting_did_not_measure_is_the_jobs_own():
    flat = row("tier=flat", 0.6, flip=0.3)
    assert error_of(flat, "depth_mm", [OWN, flat]) == OWN.errors["depth_mm"]
    assert error_of(flat, "flip", [OWN, flat]) == flat.errors["flip"]
    assert error_of(OWN, "flip", [OWN, flat]) is None


def test_what_is_within_noise_of_the_job_does_not_replace_it():
    just, well = (row("step=1", 1 / AS_CHEAP + off, depth_mm=0.01) for off in (1e-6, -1e-6))
    assert choose([OWN, just], {"depth_mm": 1.0}) is OWN
    assert choose([OWN, well], {"depth_mm": 1.0}) is well


def test_of_equally_cheap_settings_the_one_with_the_least_errors_is_chosen():
    a = row("step=a", 0.50, depth_mm=0.09, penetration_mm=0.03)  # 0.9 + 3 + 1 times the job's
    b = row("step=b", 0.52, depth_mm=0.3)  # 3 + 1 + 1
    assert choose([OWN, b, a], {"mirror_mm": 1.0}) is a
    swapped = [OWN, dataclasses.replace(a, ratio=0.52), dataclasses.replace(b, ratio=0.50)]
    assert choose(swapped, {"mirror_mm": 1.0}).setting == a.setting


def test_of_settings_alike_in_all_the_fewest_changes_and_then_the_name_decide():
    rows = [OWN, row("step=1, tier=flat", 0.5), row("tier=flat", 0.5), row("step=1", 0.5)]
    assert choose(rows, {"depth_mm": 1.0}).setting.name == "step=1"


def test_being_cheap_by_failing_is_not_chosen_unless_asked_about():
    rows = [OWN, row("step=60", 0.3, failed=0.2), row("step=120", 0.6, failed=0.005)]
    assert choose(rows, {"depth_mm": 0.1}).setting.name == "step=120"
    assert choose(rows, {"depth_mm": 0.1, "failed_share": 0.3}).setting.name == "step=60"
    assert choose(rows, {"failed_share": 0.0}) is OWN


def test_a_target_may_be_met_exactly():
    assert choose([OWN], {"depth_mm": 0.1}) is OWN


def test_the_choice_stays_when_times_come_back_a_little_off():
    targets = {"depth_mm": 0.06, "mirror_mm": 1.0}
    chosen = {choose(large_study(seed, noise=0.01).rows, targets).setting.name for seed in range(20)}
    assert chosen == {"size=1280 x 960, depth units=10000 /m"}


def test_a_study_without_the_job_itself_is_a_bug():
    with pytest.raises(ValueError, match="the job as it is"):
        own_row([row("step=1", depth_mm=0.1)])


def test_settings_whose_time_decides_are_told():
    near = [OWN, row("step=1", 0.5, depth_mm=0.3), row("step=2", 0.53, depth_mm=0.05)]
    far = [OWN, row("step=1", 0.5, depth_mm=0.3), row("step=2", 0.6, depth_mm=0.05)]
    assert names(close_calls(near, {"mirror_mm": 1.0})) == ["step=1", "step=2"]
    assert close_calls(far, {"mirror_mm": 1.0}) == []
    assert names(close_calls(far, {"mirror_mm": 1.0}, noise=0.2)) == ["step=1", "step=2"]


# ---------------------------------------------------------------------------------------------- nobody meets them


def test_the_nearest_setting_is_named_with_its_miss_and_what_to_loosen():
    rows = [OWN, row("depth=fine", 1.3, depth_mm=0.0253), row("step=960", 2.0, penetration_mm=0.001)]
    with pytest.raises(TargetError) as caught:
        choose(rows, {"depth_mm": 0.02, "penetration_mm": 0.01})
    told = str(caught.value)
    assert "no setting meets depth_mm=0.02, penetration_mm=0.01" in told
    assert "The nearest is depth=fine, at 1.3 times the job's time" in told
    assert "depth_mm, 0.0253 mm is 0.0053 mm more than 0.02 mm (1.3 times)" in told
    assert told.endswith("Loosen to at least depth_mm=0.026")
    assert caught.value.exit_code == 1


@given(st.lists(st.tuples(st.floats(0.3, 5), st.floats(1e-7, 10), st.floats(1e-7, 10)), min_size=1, max_size=12))
def test_the_loosened_targets_are_met_by_the_nearest(made: list[tuple[float, float, float]]):
    rows = [row(depth_mm=20.0, mirror_mm=20.0)]
    rows += [row(f"step={n:02}", ratio, depth_mm=a, mirror_mm=b) for n, (ratio, a, b) in enumerate(made)]
    targets = {"depth_mm": 1e-8, "mirror_mm": 1e-8}
    with pytest.raises(TargetError) as caught:
        choose(rows, targets)
    loosened = parse_targets(str(caught.value).rpartition("Loosen to at least ")[2])
    chosen = choose(rows, loosened)
    assert all(chosen.errors[name].value <= most <= 1.1 * most for name, most in loosened.items())
    assert f"nearest is {chosen.setting.name}," in str(caught.value) or len(made) > 1


@pytest.mark.parametrize(
    ("value", "most"), [(0.1, 0.1), (0.1 + 1e-14, 0.11), (0.0253, 0.026), (7.0, 7.0), (123.4, 130.0)]
)
def test_what_to_loosen_to_is_short_and_not_too_little(value: float, most: float):
    with pytest.raises(TargetError) as caught:
        choose([row(depth_mm=value)], {"depth_mm": 1e-3})
    loosened = parse_targets(str(caught.value).rpartition("Loosen to at least ")[2])
    assert value <= loosened["depth_mm"] <= most


def test_a_target_of_zero_can_be_missed_and_met():
    with pytest.raises(TargetError, match=r"misses depth_mm, 0\.1 mm is 0\.1 mm more than 0 mm\. Loosen"):
        choose([OWN], {"depth_mm": 0.0})
    exact = row("step=1", 9.0, depth_mm=0.0)
    assert choose([OWN, exact], {"depth_mm": 0.0}) is exact


def test_an_error_that_nothing_measured_is_told_with_why():
    own = dataclasses.replace(OWN, notes=("flip: Mitsuba is not installed: ./verso extra pathtraced",))
    with pytest.raises(TargetError, match=r"did not measure it: flip: Mitsuba is not installed.*It measured depth_mm"):
        choose([own], {"flip": 0.1})


def test_an_unknown_error_in_targets_is_told_with_the_nearest_name():
    with pytest.raises(InputError, match="did you mean 'penetration_mm'"):
        choose([OWN], {"penetraton_mm": 0.1})


# ---------------------------------------------------------------------------------------------- what a user types


def test_targets_are_read():
    assert parse_targets("penetration_mm=0.1,depth_mm=0.5") == {"penetration_mm": 0.1, "depth_mm": 0.5}
    assert parse_targets(" mask_share = 1e-3 , flip=0 ") == {"mask_share": 0.001, "flip": 0.0}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("penetration_mm", "write it as penetration_mm=0.1"),
        ("", "write it as"),
        ("depth_mm=0.1,", "write it as"),
        ("=0.1", "write it as"),
        ("depth_mm=", "must be a number from 0 up"),
        ("depth_mm=a bit", "depth_mm=a bit: must be a number"),
        ("depth_mm=0.1mm", "must be a number"),
        ("depth_mm=-0.1", "must be a number from 0 up"),
        ("depth_mm=nan", "must be a number"),
        ("depth_mm=inf", "must be a number"),
        ("mask_share=0.1%", "such as 0.001 for 0.1 %"),
        ("depth_mm=0.1,depth_mm=0.2", "is given twice, as 0.1 and as 0.2"),
        ("dept_mm=0.1", "did you mean 'depth_mm'"),
        ("speed=1", "Known: penetration_mm, "),
    ],
)
def test_bad_targets_are_told_with_the_remedy(text: str, told: str):
    with pytest.raises(InputError) as caught:
        parse_targets(text)
    assert told in str(caught.value) and caught.value.exit_code == 2


@given(st.dictionaries(st.sampled_from(sorted(ERRORS)), st.floats(0, 1e9), min_size=1))
def test_targets_come_back_as_they_were_written(targets: dict[str, float]):
    read = parse_targets(",".join(f"{name}={value!r}" for name, value in targets.items()))
    assert read == targets and not any(math.isnan(value) for value in read.values())


# ---------------------------------------------------------------------------------------------- a job file


def test_changes_are_nested_into_what_is_there():
    tree = {"physics": {"max_step_travel_mm": 1.0, "step_hz": 120}, "name": "tabletop"}
    made = job_tree_with({"physics.step_hz": 240, "render.raster.samples": (1, 2)}, tree)
    assert made == {
        "physics": {"max_step_travel_mm": 1.0, "step_hz": 240},
        "name": "tabletop",
        "render": {"raster": {"samples": [1, 2]}},
    }
    assert tree["physics"] == {"max_step_travel_mm": 1.0, "step_hz": 120}
    assert job_tree_with({}) == {}


def test_a_change_through_what_has_no_keys_is_refused():
    with pytest.raises(ValueError, match="'physics' is 3 and has no keys"):
        job_tree_with({"physics.step_hz": 240}, {"physics": 3})
