"""The pages in a real Chromium: what a person sees, presses and turns."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from services.look.live import Follower
from services.look.report import write_report
from services.look.server import Place, serving
from tests.browser import needs_chromium, open_tab
from tests.datasets import make_dataset

pytestmark = [pytest.mark.minute, pytest.mark.browser, needs_chromium]

CONTROLS = "a[href], button:not([hidden]), input, select, summary, [tabindex='0']"
PICTURES = "[...document.querySelectorAll('.scene:not([hidden]) img, #wipe img')]"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    changes = {"scenes": 4, "categories": ["box", "mug"]}
    return make_dataset(tmp_path_factory.mktemp("dataset"), **changes)[0]


@pytest.fixture(scope="module")
def page(dataset, tmp_path_factory) -> str:
    file = tmp_path_factory.mktemp("page") / "page.html"
    write_report(dataset, 4, file)
    return file.as_uri()


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with open_tab(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@pytest.fixture
def opened(tab, page):
    tab.said.clear()
    tab.requested.clear()
    tab.open(page)
    return tab


def picture(tab, where: str, folder: Path) -> np.ndarray:
    """[H, W, 3] what the window shows of an element."""
    tab.run(f"document.querySelector('{where}').scrollIntoView({{block: 'center', behavior: 'instant'}})")
    tab.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = tab.run(f"document.querySelector('{where}').getBoundingClientRect().toJSON()")
    place = {
        "x": box["x"],
        "y": box["y"] + tab.run("scrollY"),
        "width": box["width"],
        "height": box["height"],
        "scale": 1,
    }
    tab.screenshot(folder / "shot.png", whole=True, clip=place)
    return np.asarray(Image.open(io.BytesIO((folder / "shot.png").read_bytes())).convert("RGB")).astype(int)


def draw_space(tab) -> None:
    """Scrolls to the view in space until it is drawn; again and again, for the live page may load itself anew."""
    canvas = "document.getElementById('space-canvas')"
    scrolled = f"{canvas}?.scrollIntoView({{block: 'center', behavior: 'instant'}})"
    tab.until(f"({scrolled}, Number({canvas}?.dataset.drawn) > 0)")


def test_the_console_is_silent_and_nothing_is_fetched(opened):
    draw_space(opened)
    assert opened.said == []
    assert [one for one in opened.requested if not one.startswith(("data:", "file:"))] == []


def test_every_picture_is_shown(opened):
    opened.run("document.querySelector('[data-show=\"\"]').click()")
    opened.run(f"{PICTURES}.forEach((one) => {{ one.loading = 'eager'; }})")
    opened.until(f"{PICTURES}.every((one) => one.complete)")
    widths = opened.run(f"{PICTURES}.map((one) => one.naturalWidth)")
    assert len(widths) == 4 * 7 + 2 and min(widths) > 0


def test_a_category_shows_its_scenes_alone(opened):
    shown = "[...document.querySelectorAll('.scene:not([hidden])')].map((one) => one.dataset.category)"
    opened.run("document.querySelector('[data-show=\"mug\"]').click()")
    assert set(opened.run(shown)) == {"mug"}
    opened.run("document.querySelector('[data-show=\"\"]').click()")
    assert set(opened.run(shown)) == {"box", "mug"}


def test_the_slider_moves_with_keys_and_with_the_mouse_from_the_mirror_to_the_input_view(opened, tmp_path):
    opened.run("document.getElementById('wipe-range').focus()")
    opened.press("End", 35)
    only_input = picture(opened, "#wipe", tmp_path)
    opened.press("Home", 36)
    only_mirror = picture(opened, "#wipe", tmp_path)
    assert np.abs(only_input - only_mirror).mean() > 5
    box = opened.run("document.getElementById('wipe').getBoundingClientRect().toJSON()")
    y = box["y"] + box["height"] / 2
    opened.drag((box["x"] + 20, y), (box["x"] + box["width"] / 2, y))
    assert 40 < float(opened.run("document.getElementById('wipe-range').value")) < 60
    half = picture(opened, "#wipe", tmp_path)
    middle = half.shape[1] // 2
    for side, whole in ((slice(100, middle - 40), only_input), (slice(middle + 40, -100), only_mirror)):
        assert np.abs(half[60:, side] - whole[60:, side]).mean() < 1


def test_the_view_in_space_draws_turns_with_keys_and_hides_its_parts(opened, tmp_path):
    draw_space(opened)
    first = picture(opened, "#space-canvas", tmp_path)
    assert len(np.unique(first[4:-4, 4:-4].reshape(-1, 3), axis=0)) > 500
    opened.run("document.getElementById('space-canvas').focus()")
    for _ in range(4):
        opened.press("ArrowLeft", 37)
    turned = picture(opened, "#space-canvas", tmp_path)
    assert np.abs(turned - first).mean() > 2
    opened.press("0", 48)
    assert np.abs(picture(opened, "#space-canvas", tmp_path) - first).mean() < 0.5
    for part in ("input", "mirror", "mesh", "cameras"):
        before = picture(opened, "#space-canvas", tmp_path)
        opened.run(f"document.querySelector('[data-part=\"{part}\"]').click()")
        hidden = picture(opened, "#space-canvas", tmp_path)
        assert part == "cameras" or np.abs(hidden - before).mean() > 0.2
    assert len(np.unique(hidden[4:-4, 4:-4].reshape(-1, 3), axis=0)) == 1


@pytest.mark.parametrize(("dark", "chosen"), [(True, ""), (False, "dark"), (True, "light"), (False, "")])
def test_light_and_dark_follow_the_system_until_one_is_chosen(tab, page, dark, chosen):
    tab.open(page, dark=dark)
    tab.run(f"document.querySelector('[data-theme-to=\"{chosen}\"]').click()")
    paper = tab.run("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    ink = tab.run("getComputedStyle(document.body).color.match(/\\d+/g).map(Number)")
    is_dark = chosen == "dark" or (dark and not chosen)
    assert (sum(paper) < sum(ink)) == is_dark
    assert abs(sum(paper) - sum(ink)) > 450
    tab.run("document.querySelector('[data-theme-to=\"\"]').click()")


def test_a_phone_scrolls_downwards_only(tab, page):
    tab.open(page, 380, 800)
    tab.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    assert tab.run("document.documentElement.scrollWidth") == 380
    wide = "(one) => one.getBoundingClientRect().right > 381 && !one.closest('svg')"
    wide = f"[...document.querySelectorAll('main *')].filter({wide})"
    assert tab.run(f"{wide}.map((one) => one.outerHTML.slice(0, 80))") == []


def test_the_tab_key_reaches_every_control(opened):
    seen = "[...document.querySelectorAll(CONTROLS)].filter((one) => one.checkVisibility())".replace(
        "CONTROLS", f'"{CONTROLS}"'
    )
    opened.run(f"{seen}.forEach((one, i) => {{ one.dataset.stop = i; }})")
    count = opened.run(f"{seen}.length")
    assert count > 25
    reached = set()
    for _ in range(count + 2):
        opened.press("Tab", 9)
        reached.add(opened.run("document.activeElement.dataset.stop"))
    assert reached - {None} == {str(i) for i in range(count)}


def test_the_live_page_follows_a_folder_without_a_word_in_the_console(tab, dataset, tmp_path):
    (tmp_path / "out").symlink_to(tmp_path / "nowhere")
    store = type(dataset)(tmp_path / "out")
    follower = Follower(store, 2)
    tab.said.clear()
    with serving(follower, Place("127.0.0.1", 0, "a-token-of-some-length")) as place:
        follower.start()
        try:
            tab.open(place.address)
            assert "token" not in tab.run("location.href")
            tab.until("document.getElementById('live-now').innerText.includes('Waiting')")
            (tmp_path / "out").unlink()
            (tmp_path / "out").symlink_to(dataset.root)
            tab.until("document.getElementById('live-now').innerText.includes('Finished')")
            tab.until("document.querySelectorAll('.scene').length > 0", 40)
            tab.until("[...document.querySelectorAll('.latest img')].every((one) => one.naturalWidth > 0)")
            draw_space(tab)
        finally:
            follower.stop()
        assert tab.run("document.title") == "small"
        assert tab.said == []
    tab.until("!document.getElementById('live-gone').hidden")
