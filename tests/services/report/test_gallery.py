import re

import numpy as np
import pytest

from services.look.clouds import Body, Cloud, Space
from services.look.pictures import ShownScene, picture_of_colour
from services.look.sections import compare_html, sheets_html, space_html

HOSTILE = '"><script>x</script>'


def scene(scene_id: int, category: str, names=("input rgb", "mirror rgb", "over")) -> ShownScene:
    picture = picture_of_colour(np.zeros((12, 16, 3), np.uint8), "input view, colour")
    visible = {"input": 0.98, "mirror": None}
    return ShownScene(scene_id, category, ("a", "b"), 2 * scene_id, dict.fromkeys(names, picture), visible, 2.345678)


def address(picture) -> str:
    return f"/picture/{picture.name}"


def test_each_category_has_a_button_and_each_scene_its_pictures():
    html = sheets_html([scene(3, "box"), scene(7, "mug")], address)
    assert re.findall(r'data-show="([^"]*)"', html) == ["", "box", "mug"]
    assert re.findall(r'data-name="([^"]*)"', html) == ["input rgb", "mirror rgb", "over"] * 2
    assert html.count('src="/picture/') == 6
    assert "98% visible in the input view, d_z 2.346 m" in html
    assert "2 objects" in html


def test_one_category_needs_no_buttons_and_no_scenes_are_told():
    assert "data-show" not in sheets_html([scene(3, "box")], address)
    assert "no scenes to show" in sheets_html([], address)


def test_the_slider_has_the_scenes_with_both_views():
    html = compare_html([scene(3, "box"), scene(7, "mug", ("input rgb",))])
    assert re.findall(r'<option value="(\d+)"', html) == ["3"]
    assert 'type="range"' in html
    assert compare_html([scene(7, "mug", ("input rgb",))]) == ""


@pytest.mark.parametrize("bodies", [(), (Body("object", np.zeros((3, 3)), np.array([[0, 1, 2]])),)])
def test_the_view_in_space_has_a_switch_for_each_part_that_is_there(bodies):
    cloud = Cloud("input", np.zeros((1, 3)), np.zeros((1, 3), np.uint8), 0.01, np.eye(4))
    missing = "" if bodies else "the files are <gone>"
    html = space_html(Space(3, "box", np.zeros(3), (cloud,), bodies, missing), "{}")
    parts = re.findall(r'data-part="(\w+)"', html)
    assert parts == ["input", *(["mesh"] if bodies else []), "cameras", "tint"]
    assert ("There is no mesh: the files are &lt;gone&gt;." in html) == (not bodies)
    assert space_html(None, "") == ""


def test_a_category_is_text_and_never_markup():
    shown = [scene(3, HOSTILE), scene(4, "mug")]
    assert "<script" not in sheets_html(shown, address) + compare_html(shown)
