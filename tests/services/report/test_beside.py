import re

import pytest

from services.look.charts import Histogram
from services.look.collect import collect
from services.look.pictures import Sample
from services.look.report import page_of, read_report
from services.look.sections import beside_html
from tests.datasets import make_dataset
from tests.services.report.test_collect import SCENES, TIMINGS, VIEWS, Handmade
from tests.services.report.test_gallery import address, scene


@pytest.fixture(scope="module")
def sides():
    depth = {"input": Histogram(0.0, 9.6).add([2.4]), "mirror": Histogram(0.0, 9.6)}
    ours = ("scenes", collect(Handmade(scenes=SCENES, views=VIEWS, timings=TIMINGS)), Sample((scene(3, "box"),), depth))
    theirs = ("<i>captures", collect(Handmade()), Sample((scene(4, "box"), scene(5, "mug")), {}))
    return ours, theirs


def test_both_datasets_have_their_figures_in_one_table(sides):
    html = beside_html(*sides, address)
    assert re.search(r"scenes</th><td>3</td><td>0</td>", html)
    assert re.search(r"depth of the objects, input</th><td>2.4 m</td><td>–</td>", html)
    assert re.search(r"time of a scene, mean</th><td>2,330 ms</td>", html)
    assert "&lt;i&gt;captures" in html and "<i>" not in html


def test_a_category_of_both_has_a_scene_of_each_and_others_are_named(sides):
    html = beside_html(*sides, address)
    assert html.count('class="pair"') == 1
    assert re.findall(r"scene (\d+)</span>", html) == ["3", "4"]
    assert "Only in &lt;i&gt;captures: mug." in html and html.count("Only in") == 1


def test_a_page_has_the_other_dataset_only_where_one_is_given(shown, tmp_path):
    other = make_dataset(tmp_path / "other", name="other", scenes=1, categories=["can"])[0]
    alone, both = (page_of(read_report(shown, 2), address, one) for one in (None, read_report(other, 1)))
    assert [section.html for section in alone.sections if section.id == "beside"] == [""]
    (section,) = [section for section in both.sections if section.id == "beside"]
    assert "other" in section.html and "<td>4</td><td>1</td>" in section.html
