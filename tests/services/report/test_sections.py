from collections import Counter
from dataclasses import replace

import pytest

from schemas.job.job import Job
from services.look.charts import Histogram
from services.look.collect import CaptureQuality, Cost, Failure, collect
from services.look.sections import captures_html, charts_html, effects_html, failures_html, overview_html
from tests.services.report.test_collect import FAILURES, SCENES, TIMINGS, VIEWS, Handmade

HOSTILE = '<script>alert("&")</script>'


@pytest.fixture(scope="module")
def figures():
    return collect(Handmade(scenes=SCENES, views=VIEWS, timings=TIMINGS, failures=FAILURES))


def test_the_overview_says_what_was_asked_made_and_failed(figures):
    html = overview_html(figures, Job(name="small", seed=1, scenes=1200), 3)
    assert "<dd>3<small>of 1,200 asked</small>" in html
    assert "<dd>3<small>50 % of those tried</small>" in html
    assert "different ones in 2 categories" in html
    assert "chosen evenly" not in html
    assert "chosen evenly" in overview_html(replace(figures, sampled=True), Job(name="small", seed=1, scenes=3), 0)


def test_effects_that_ran_have_their_share_and_time_and_others_their_reason(figures):
    html = effects_html(figures)
    assert "<code>drop</code></th><td>3<small>100%</small></td><td>1.3 s</td><td>625 ms</td>" in html.replace(
        "1.2 s", "1.3 s"
    )
    assert "1 effect that ran in no scene" in html
    assert "<dd>no glass; not asked</dd>" in html
    assert "left out 1 ×: off" in html


def test_effects_that_ran_everywhere_without_a_time_are_only_named(figures):
    html = effects_html(replace(figures, effects={"floor": Cost(3), "tip": Cost(2, 1.0, 2)}))
    assert "counted with its stage: <code>floor</code>." in html and html.count("<code>floor") == 1


def test_the_most_frequent_reason_stands_before_how_many_others_there_are(figures):
    skips = Counter({"it stands": 5, "it is flat": 2, "off": 1})
    html = effects_html(replace(figures, effects={"tip": Cost(2, 0.0, 0, skips)}))
    assert "left out 5 ×: it stands, 2 more reasons" in html


def test_failures_have_reason_detail_and_examples(figures):
    html = failures_html(figures.failures, 9)
    assert "left table" in html and "at 0.7 m" in html and "scenes 2, 4" in html
    assert failures_html((), 9) == '<p class="empty">No scene failed of 9.</p>'


def test_what_comes_from_the_dataset_is_text_and_never_markup(figures):
    failure = Failure(HOSTILE, "intrinsic", HOSTILE, 1, (1,), HOSTILE)
    capture = CaptureQuality(0, HOSTILE, HOSTILE, 3, 1, HOSTILE, 0.2, None, None, None, None)
    hostile = replace(
        figures,
        by_category={HOSTILE: 1},
        effects={
            HOSTILE: Cost(1, 0.0, 0, Counter({HOSTILE: 1})),
            f"{HOSTILE}2": Cost(0, 0.0, 0, Counter({HOSTILE: 1})),
        },
        stages={HOSTILE: Cost(1, 1.0, 1)},
        captures=(capture,),
    )
    job = Job(name="small", seed=1, scenes=3)
    parts = (overview_html(hostile, job, 0), effects_html(hostile), failures_html([failure], 1), captures_html(hostile))
    assert all("<script" not in part and "&lt;script&gt;" in part for part in parts)


def test_the_histograms_are_those_with_values(figures):
    html = charts_html(figures, {"input": Histogram(0.0, 9.6)})
    assert "Depth of the objects" not in html
    for title in ("Distance to the object", "Visibility", "Inclination", "Resting gap"):
        assert f"<h3>{title}</h3>" in html


def test_captures_have_a_table_only_where_there_are_any(figures):
    assert captures_html(figures) == ""
    capture = CaptureQuality(0, "shots/mug", "mug", 22, 2, "joint", 0.213, 0.91, 0.4, None, 0.98)
    html = captures_html(replace(figures, captures=(capture,)))
    assert "0.213 px" in html and "0.4 mm" in html and "98 %" in html and "2 left out" in html and "<td>–</td>" in html
