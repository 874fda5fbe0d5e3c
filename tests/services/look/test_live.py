from dataclasses import replace

from services.look.live import Progress, live_html, title_of
from tests.services.report.test_gallery import address, scene

MAKING = Progress("making", "small", 1000, 380, {"intrinsic: left_table": 2}, 3.14159, 197.0, (41, 57))


def test_a_job_at_work_tells_done_rate_time_left_failures_and_scenes():
    html = live_html(MAKING, (), address)
    assert "382 of 1,000 scenes · 3.1 a second · 3.3 min left · 2 failed · now at 41, 57" in html
    assert '<progress max="1000" value="382"' in html
    assert "<li>2 failed, intrinsic: left table</li>" in html
    assert title_of(MAKING) == "38% · small"


def test_an_empty_folder_says_that_it_waits():
    assert "There is no job yet." in live_html(Progress("empty"), (), address)
    assert "The job small asks for 12 scenes." in live_html(Progress("empty", "small", 12), (), address)
    assert title_of(Progress("empty")) == "Verso"


def test_a_folder_that_cannot_be_read_says_why_and_shows_no_pictures():
    html = live_html(Progress("unreadable", told=("job.yaml is <broken>",)), [scene(3, "box")], address)
    assert "<li>job.yaml is &lt;broken&gt;</li>" in html and "<img" not in html


def test_the_latest_scenes_have_their_pictures_and_no_markup_of_theirs():
    html = live_html(MAKING, [scene(3, "<i>box"), scene(4, "mug")], address)
    assert html.count("<img") == 4 and "<i>" not in html


def test_many_scenes_at_once_are_cut_with_a_word():
    assert "now at 1, 2, 3, 4 and more" in live_html(replace(MAKING, running=(1, 2, 3, 4, 5)), (), address)
