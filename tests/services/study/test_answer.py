"""The one sentence, on studies whose answer is plain."""

import pytest

from schemas.errors import InputError
from services.study.choose import TargetError, answer, blind_knobs, next_better, parse_targets, recommend
from tests.made_up_studies import large_study, row, study

OWN = row(penetration_mm=0.01, gap_mm=0.0, mask_share=0.0002, depth_mm=0.1, flip=0.1)


def test_the_job_is_kept_where_nothing_is_cheaper_and_as_good():
    made = study(OWN, row("step=60", 0.5, penetration_mm=0.4), row("units=10000", 1.6, depth_mm=0.05))
    assert answer(made) == (
        "For at most 0.1 mm (penetration, gap, depth of objects) and 0.1 % (the object's mask pixels), use the job as it is, "
        "which costs 118 ms of processor a scene (64 scenes: 7.6 s, 15 MB); the next better, units=10000, costs 1.6 times as "
        "much."
    )


def test_another_setting_is_named_with_what_it_saves():
    made = study(OWN, row("step=240", 0.5, penetration_mm=0.05), job_scenes=1_000_000)
    assert answer(made) == (
        "For at most 0.1 mm (penetration, gap, depth of objects) and 0.1 % (the object's mask pixels) and nothing else worse "
        "than the job has it, use step=240, which costs 59 ms of processor a scene (1,000,000 scenes: 16 h, 235 GB), 0.5 times "
        "the job's time; the next better, the job, costs 2 times as much."
    )


def test_whoever_asks_for_nothing_keeps_the_images_that_they_have():
    made = study(OWN, row("tier=flat", 0.5, flip=0.3), row("size=small", 0.4, flip=0.11))
    assert (
        recommend(made).setting.name == "size=small"
    )  # as good as the scenes can tell: the job's interval ends at 0.11
    assert recommend(study(OWN, row("tier=flat", 0.5, flip=0.3))) is OWN


def test_a_knob_that_nothing_is_known_of_is_not_recommended_unasked():
    made = study(row(penetration_mm=0.01), row("tier=flat", 0.5), row("step=1, tier=flat", 0.4, penetration_mm=0.01))
    assert blind_knobs(made.rows) == {"tier"}
    assert recommend(made).setting.name == "the job"
    assert recommend(made, {"penetration_mm": 0.1}).setting.name == "step=1, tier=flat"


def test_what_a_target_leaves_out_and_is_given_up_is_told():
    made = study(OWN, row("tier=flat", 0.5, flip=0.3))
    told = answer(made, {"penetration_mm": 0.1})
    assert "use tier=flat" in told and "gives up colour, FLIP (0.3 instead of 0.1)" in told


def test_targets_that_nobody_meets_are_told_with_the_nearest():
    told = answer(study(OWN), {"depth_mm": 0.05})
    assert told.startswith("At most 0.05 mm (depth of objects) is met by nothing that was measured: no setting meets")
    assert told.endswith("Loosen to at least depth_mm=0.1.")
    with pytest.raises(TargetError):
        recommend(study(OWN), {"depth_mm": 0.05})


@pytest.mark.parametrize(
    ("own", "missed", "option"),
    [
        (
            {"camera_mm": 0.2, "view_depth_mm": 1.58},
            "view_depth_mm, 1.58 mm is 0.08 mm more than 1.5 mm",
            "camera_mm=0.5,",
        ),
        ({"depth_mm": 0.5, "mask_share": 0.0}, "depth_mm, 0.5 mm is 0.4 mm more than 0.1 mm", "depth_mm=0.5,"),
    ],
)
def test_default_targets_that_nobody_meets_are_told_in_a_line_with_the_option_that_sets_others(own, missed, option):
    made = study(row(**own))
    with pytest.raises(TargetError) as caught:
        recommend(made)
    told = str(caught.value)
    assert told.startswith("no setting meets the default targets. The nearest is the job,") and "\n" not in told
    assert f"it misses {missed}" in told and f"Set others with --target {option}" in told
    assert caught.value.exit_code == 1 and answer(made).endswith(f"is met by nothing that was measured: {told}.")
    assert recommend(made, parse_targets(told.rpartition("--target ")[2])) is made.rows[0]


def test_a_setting_that_meets_the_defaults_and_makes_something_else_worse_is_told():
    made = study(row(depth_mm=0.5, flip=0.1), row("tier=flat", 0.5, depth_mm=0.05, flip=0.9))
    with pytest.raises(
        TargetError, match=r"The nearest is tier=flat.* it misses none of them, and is worse than the job"
    ):
        recommend(made)


def test_an_unknown_target_is_no_sentence():
    with pytest.raises(InputError):
        answer(study(OWN), {"depht_mm": 0.05})


def test_where_nothing_is_better_it_says_so():
    told = answer(study(OWN, row("step=60", 0.99, penetration_mm=0.4)))
    assert told.endswith("; nothing that was measured is better.")


def test_without_the_number_of_scenes_the_whole_job_is_left_out():
    assert "118 ms of processor a scene; nothing" in answer(study(OWN, job_scenes=0))
    assert "(1 scene: 0.12 s, 235 kB)" in answer(study(OWN, job_scenes=1))


def test_the_default_targets_are_those_that_were_measured():
    told = answer(study(row(between_mm=0.1), job_scenes=0))
    assert told.startswith("For nothing worse than the job has it, use the job as it is")
    assert answer(study(row(between_mm=0.1)), {}).startswith("For any error at all, use the job as it is")


def test_better_is_better_by_more_than_both_intervals_and_worse_in_nothing():
    near, worse = row("a=1", 2.0, depth_mm=0.09), row("b=1", 2.0, depth_mm=0.01, flip=0.5)
    better, dearer = row("c=1", 3.0, depth_mm=0.07), row("d=1", 4.0, depth_mm=0.01)
    rows, targets = [OWN, near, worse, dearer, better], {"depth_mm": 1.0, "flip": 0.1}
    assert next_better(rows, OWN, targets) is better
    assert next_better(rows[:3], OWN, targets) is None


def test_what_is_better_at_the_same_cost_is_told():
    made = study(OWN, row("splat=3", 1.01, depth_mm=0.05), row("splat=5", 1.04, depth_mm=0.01))
    assert answer(made).endswith("; splat=5 is better and costs as much.")


def test_a_target_that_was_not_measured_is_told():
    told = answer(study(row(depth_mm=0.1)), {"penetration_mm": 0.1})
    assert told.endswith("--target penetration_mm: this study did not measure it. It measured depth_mm.")
    apart = study(row(mask_share=0.1), row("a=1", 0.5, depth_mm=0.1), row("b=1", 0.6, flip=0.1))
    told = answer(apart, {"depth_mm": 0.2, "flip": 0.2})
    assert "The nearest is a=1" in told and told.endswith("misses flip, which was not measured with it.")


def test_a_large_study_has_a_sentence():
    assert answer(large_study()).startswith("For at most 0.1 mm (penetration, gap, pose, depth of objects)")
