"""Which settings are worth their time, and the sentence that says so, on rows whose answer is known."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import InputError, milliseconds, number, size
from services.study.choose import (
    WORTH,
    TargetError,
    choose,
    describe_answer,
    error_of,
    front,
    recommend,
)
from services.study.command import parse_targets
from services.study.model import Row, Study, Targets, amount, times
from tests.services.study.made_up import row, study

OWN = row(depth_mm=0.1, penetration_mm=0.01, mirror_mm=1.0)
COLOURED = row(penetration_mm=0.01, gap_mm=0.0, mask_share=0.0002, depth_mm=0.1, flip=0.1)


def answer(made: Study, targets: Targets | None = None) -> str:
    return describe_answer(made.rows, targets, made.proofs, made.job_scenes)[0]


def names(rows: list[Row]) -> list[str]:
    return [each.setting.name for each in rows]


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 12)), max_size=30))
def test_the_front_is_what_comparing_all_with_all_leaves(places: list[tuple[int, int]]):
    best = front([row(f"step={n:02}", ratio, depth_mm=error) for n, (ratio, error) in enumerate(places)], "depth_mm")
    undominated = {
        place
        for place in places
        if not any(other != place and other[0] <= place[0] and other[1] <= place[1] for other in places)
    }
    assert {(one.ratio, one.errors["depth_mm"].value) for one in best} == undominated
    assert len(best) == len(undominated)
    alike = [row(f"step={name}", 1.0, depth_mm=0.1) for name in "cab"]
    assert names(front([*alike, row("step=d", 0.1, flip=0.3)], "depth_mm")) == ["step=a"]


def test_the_cheapest_that_meets_all_targets_is_chosen():
    rows = [OWN, row("step=60", 0.4, penetration_mm=0.2), row("step=120", 0.7, penetration_mm=0.05)]
    rows.append(row("size=small", 0.5, depth_mm=0.3))
    assert choose(rows, {"penetration_mm": 0.05}).setting.name == "size=small"  # its penetration is the job's own
    assert choose(rows, {"penetration_mm": 0.05, "depth_mm": 0.1}).setting.name == "step=120"
    assert choose(rows, {"penetration_mm": 0.04, "depth_mm": 0.1}).setting.name == "the job"
    flat = row("tier=flat", 0.6, flip=0.3)
    assert error_of(flat, "depth_mm", [OWN, flat]) == OWN.errors["depth_mm"]
    assert error_of(OWN, "flip", [OWN, flat]) is None


def test_of_settings_about_as_cheap_facts_without_noise_decide():
    """The job stays unless 5 % is surely saved; then the fewest changes, the least errors relative to the job's, the name."""
    just, well = (row("step=1", 1 - WORTH + off, noise=0.0, depth_mm=0.01) for off in (1e-6, -1e-6))
    unsure = dataclasses.replace(well, ratio=0.9, ratio_most=1.01)  # its interval holds the job's own time
    close = row("a=1, b=1, c=1", 0.985, noise=0.005, depth_mm=0.05)  # about as cheap as what saves 6 %, and more exact
    saving = row("step=1", 0.94, noise=0.03, depth_mm=0.1)
    assert recommend([OWN, close], None) is OWN and recommend([OWN, close, saving], None) is saving
    many = row("step=1, tier=flat", 0.91, noise=0.03, depth_mm=0.05)
    assert choose([OWN, many, saving], {"depth_mm": 1.0}) is saving  # as cheap, with fewer changes
    assert choose([row(depth_mm=2.0), close], {"depth_mm": 1.0}) is close  # the job itself misses what was asked
    assert choose([OWN, unsure], {"depth_mm": 1.0}) is OWN
    assert choose([OWN, just], {"depth_mm": 1.0}) is OWN and choose([OWN, well], {"depth_mm": 1.0}) is well
    a = row("step=a", 0.50, depth_mm=0.09, penetration_mm=0.03)  # 0.9 + 3 + 1 times the job's
    b = row("step=b", 0.52, depth_mm=0.3)  # 3 + 1 + 1
    assert choose([OWN, b, a], {"mirror_mm": 1.0}) is a
    swapped = [OWN, dataclasses.replace(a, ratio=0.52), dataclasses.replace(b, ratio=0.50)]
    assert choose(swapped, {"mirror_mm": 1.0}).setting == a.setting
    rows = [OWN, row("step=1, tier=flat", 0.5), row("tier=flat", 0.5), row("step=1", 0.5)]
    assert choose(rows, {"depth_mm": 1.0}).setting.name == "step=1"


def test_being_cheap_by_failing_is_not_chosen_unless_asked_about():
    own = row(depth_mm=0.1, failed_share=0.0)
    rows = [own, row("step=60", 0.3, failed=0.2, failed_share=0.2), row("step=120", 0.6, failed=0.005)]
    assert choose(rows, {"depth_mm": 0.1}).setting.name == "step=120"
    assert choose(rows, {"depth_mm": 0.1, "failed_share": 0.3}).setting.name == "step=60"
    assert choose(rows, {"failed_share": 0.0}) is own


def test_bounds_for_other_scenes_decide_and_where_none_meets_the_targets_the_nearest():
    near, sure = row("step=60", 0.4, depth_mm=0.098), row("step=120", 0.7, depth_mm=0.05)  # to 0.1078 and to 0.055
    assert choose([OWN, near, sure], {"depth_mm": 0.1}) is sure
    assert choose([OWN, near], {"depth_mm": 0.1}) is near  # nothing is surely below
    few = dataclasses.replace(near, errors={"depth_mm": dataclasses.replace(near.errors["depth_mm"], most=0.5)})
    assert choose([OWN, few, sure], {"depth_mm": 0.1}) is sure
    assert choose([OWN, few], {"depth_mm": 0.1}) is OWN  # to 0.11: few scenes may be far off
    assert choose([OWN, few], {"depth_mm": 0.1}, bounds={}) is few  # targets that nobody asked for are met by values
    doubt = "It is not sure to 95 %: scenes that were not measured may have depth of objects up to 0.11 mm (from 48)."
    assert answer(study(OWN, few), {"depth_mm": 0.1}).endswith(doubt)
    assert "is not" not in answer(study(OWN, few, sure), {"depth_mm": 0.1})
    unproved = dataclasses.replace(study(OWN, sure), proofs=())
    assert answer(unproved, {"depth_mm": 0.1}).endswith("It is not proved: the budget left no time for fresh scenes.")


def test_without_a_wish_the_job_stays_where_it_misses_a_default_target_within_its_interval_alone():
    off, noisy, other = row(depth_mm=0.107), row(depth_mm=0.107), row("step=240", 0.99, depth_mm=0.02)
    wide = dataclasses.replace(noisy.errors["depth_mm"], low=0.0004, most=0.18, scenes=11)
    noisy = dataclasses.replace(noisy, errors={"depth_mm": wide})
    off = dataclasses.replace(off, errors={"depth_mm": dataclasses.replace(wide, low=0.101)})
    assert recommend([noisy, other], None) is noisy and recommend([off, other], None) is other
    assert recommend([noisy, dataclasses.replace(other, ratio=0.9, ratio_most=0.93)], None).setting.name == "step=240"
    assert recommend([noisy, other], {"depth_mm": 0.1}) is other  # who asks for it gets what meets it
    large = dataclasses.replace(row("png_level=0", 0.8, depth_mm=0.02), kilobytes=5.0 * noisy.kilobytes)
    assert recommend([noisy, large], None) is noisy  # time is not saved at the price of five times the disk
    doubt = "scenes that were not measured may have depth of objects up to 0.18 mm (from 11)."
    assert "use the job as it is" in answer(study(noisy, other)) and doubt in answer(study(noisy, other))


def test_a_setting_that_few_scenes_measured_is_not_recommended():
    for scenes, chosen in ((3, "the job"), (4, "step=60")):
        few = row("step=60", 0.5, scenes=scenes, depth_mm=0.01)
        assert choose([OWN, few], {"depth_mm": 0.2}).setting.name == chosen
        assert recommend([OWN, few], None).setting.name == chosen
        assert names(front([OWN, few], "depth_mm")) == ([chosen] if scenes == 4 else ["the job"])
    unknown = row(scenes=3, depth_mm=0.1)
    with pytest.raises(TargetError, match=r"depth of objects fewer than 4 scenes of the job .*--budget"):
        choose([unknown], {"depth_mm": 0.2})
    assert recommend([unknown], None) is unknown  # who asks for nothing keeps the job
    four, three = row(scenes=4, depth_mm=0.1), row("step=60", 0.5, scenes=3, depth_mm=0.01)
    for rows in ([unknown], [four], [unknown, row("step=60", 0.5, depth_mm=0.01)], [four, three]):
        words, chosen = describe_answer(rows, None, (), 64)
        assert chosen == "" and words.startswith("No verdict: fewer than 4 scenes") and "--budget" in words
    words, chosen = describe_answer([four, three, row("size=small", 0.5, scenes=4, depth_mm=0.1)], None, (), 64)
    assert chosen == "size=small" and "Of 1 setting fewer than 4 scenes were measured: nothing is said" in words


UNMET = (
    (
        [OWN, row("depth=fine", 1.3, depth_mm=0.0253), row("step=960", 2.0, penetration_mm=0.001)],
        {"depth_mm": 0.02, "penetration_mm": 0.01},
        "no setting meets depth_mm=0.02,penetration_mm=0.01. The nearest is depth=fine, at 1.3 times the job's time: it "
        "misses depth_mm, which is 0.0253 mm instead of 0.02 mm. Set others with --target",
    ),
    ([OWN], {"flip": 0.1}, "this study did not measure it. It measured depth_mm, mirror_mm, penetration_mm"),
    (
        [row(mask_share=0.1), row("a=1", 0.5, depth_mm=0.1), row("b=1", 0.6, flip=0.1)],
        {"depth_mm": 0.2, "flip": 0.2},
        "The nearest is a=1, at 0.5 times the job's time: it misses flip, which is unknown instead of 0.2",
    ),
    (
        [row(camera_mm=0.2, view_depth_mm=1.7)],
        None,
        "misses view_depth_mm, which is 1.7 mm instead of 1.5 mm. Set others",
    ),
    (
        [row(depth_mm=0.5, flip=0.1), row("tier=flat", 0.5, depth_mm=0.05, flip=0.9)],
        None,
        "it misses none of them, and is worse than the job in another error",
    ),
)


def test_what_no_setting_meets_is_named_with_the_nearest_setting():
    for rows, targets, message in UNMET:
        with pytest.raises(TargetError) as caught:
            recommend(rows, targets)
        assert message in str(caught.value) and caught.value.exit_code == 1 and "\n" not in str(caught.value)
        assert f"is met by nothing that was measured: {caught.value}." in answer(study(*rows), targets)


def test_bad_targets_are_told_with_the_remedy():
    assert parse_targets("depth_mm=0.5, pose_mm=1e-3") == {"depth_mm": 0.5, "pose_mm": 0.001}
    for text, message in {
        "": "write it as penetration_mm=0.1,depth_mm=0.5",
        "depth_mm": "write it as penetration_mm=0.1,depth_mm=0.5",
        "depth_mm=0.1,": "write it as",
        "depth_mm=a bit": "depth_mm=a bit: must be a number",
        "depth_mm=-0.1": "must be a number from 0 up",
        "depth_mm=nan": "must be a number",
        "depth_mm=0.1,depth_mm=0.2": "is given twice, as 0.1 and as 0.2",
        "dept_mm=0.1": "did you mean 'depth_mm'",
    }.items():
        with pytest.raises(InputError) as caught:
            parse_targets(text)
        assert message in str(caught.value) and caught.value.exit_code == 2


SENTENCES = (
    (
        study(COLOURED, row("step=60", 0.5, penetration_mm=0.4), row("units=10000", 1.6, depth_mm=0.05)),
        "For at most 0.1 mm of penetration, 0.1 mm of gap, 0.1 mm of depth of objects and 0.1 % of the object's mask pixels, and "
        "nothing else worse than the job has it, use the job as it is, which costs 118 ms of processor a scene "
        "(64 scenes: 7.6 s, 15 MB).",
    ),
    (
        study(COLOURED, row("step=240", 0.5, penetration_mm=0.05), job_scenes=1_000_000),
        "use step=240, which costs 59 ms of processor a scene (1,000,000 scenes: 16 h, 235 GB), 0.5 times the job's time, and "
        "gives up penetration (0.05 mm instead of 0.01 mm).",
    ),
    (study(COLOURED, job_scenes=1), "(1 scene: 0.12 s, 235 kB)"),
)


def test_the_sentence_names_the_setting_its_cost_and_what_it_gives_up():
    for made, words in SENTENCES:
        assert words in answer(made), words
    assert answer(study(row(between_mm=0.1)), {}).startswith("For any error at all, use the job as it is")
    words = answer(study(COLOURED, row("tier=flat", 0.5, flip=0.3)), {"penetration_mm": 0.1})
    assert "use tier=flat" in words and "gives up colour, FLIP (0.3 instead of 0.1)" in words


def test_whoever_asks_for_nothing_keeps_the_images_that_they_have():
    flat, small = row("tier=flat", 0.5, flip=0.3), row("size=small", 0.4, flip=0.11)  # the job's interval ends at 0.11
    assert recommend([COLOURED, flat, small], None) is small
    assert recommend([COLOURED, flat], None) is COLOURED
    blind = study(row(penetration_mm=0.01), row("tier=flat", 0.5), row("step=1, tier=flat", 0.4, penetration_mm=0.01))
    assert recommend(blind.rows, None).setting.name == "the job"  # nothing is known of what a tier costs
    assert recommend(blind.rows, {"penetration_mm": 0.1}).setting.name == "step=1, tier=flat"


def test_amounts_are_written_as_a_person_reads_them():
    written = {
        number: {0.0: "0", 0.1: "0.1", 0.00012345: "0.000123", 99999: "100,000", 13.44: "13.4", 1250.0: "1,250"}
        | {9.75e-6: "9.75e-6", 2.5e7: "2.5e7", -0.02: "-0.02", math.nan: "nan"},
        times: {0.5: "0.5 times", 0.96: "0.96 times", 1.068: "1.07 times", 1.58: "1.6 times", 1419.0: "1,400 times"},
        size: {235: "235 kB", 15040: "15 MB", 2.35e8: "235 GB", 3e12: "3,000 TB"},
        milliseconds: {117.6: "118 ms", 5600: "5,600 ms", 11200: "11.2 s"},
    }
    for write, cases in written.items():
        assert {value: write(value) for value in cases} == cases
    assert amount("penetration_mm", 0.1) == "0.1 mm" and amount("mask_share", 0.001) == "0.1 %"
    assert amount("flip", 0.12) == "0.12" and amount("outcome_deg", 0.01) == "0.01 deg"
