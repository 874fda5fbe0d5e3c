"""The whole page: what it holds, that it is well formed, and in a real Chromium what a person sees, presses and turns."""

import io
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.dataset.layout import SUCCESS_FILE
from schemas.errors import MachineError, OutputError
from services.cli.main import main
from services.look.live import Follower
from services.look.report import (
    SCRIPTS,
    Page,
    Section,
    read_report,
    read_three,
    read_web,
    whole_page,
    write_report,
)
from services.look.server import Place, serving
from tests.browser import needs_chromium, open_tab
from tests.datasets import in_a_bucket, make_dataset
from tests.kit.html import Reader
from workers.store.local import LocalStore


@pytest.fixture(scope="module")
def page(shown, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("page") / "page.html"
    write_report(shown, 4, file)
    return file


def test_the_page_is_well_formed_names_its_job_and_holds_all_that_it_shows(page):
    text = page.read_text()
    reader = Reader(text)
    assert len(set(reader.ids)) == len(reader.ids) > 5
    inner = [one for one in reader.links if one.startswith("#")]
    assert {one[1:] for one in inner} <= set(reader.ids)
    assert all(one.startswith("data:image/") for one in reader.links if one not in inner)
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]
    assert "url(" not in style and "@import" not in style and "default-src 'none'" in text
    assert "<title>small</title>" in text and "4 scenes asked" in text


def test_the_page_has_the_sections_with_contents_and_its_scripts_with_their_licence():
    sections = [Section("one", "One", "<p>1</p>"), Section("two", "Two", "")]
    html = whole_page(Page("a <b>", "c & d", sections, "the end"))
    assert '<section id="one" aria-labelledby="one-heading"' in html and '<h2 id="one-heading">One</h2>' in html
    assert 'href="#one"' in html and 'id="two"' not in html and 'href="#two"' not in html
    assert "<title>a &lt;b&gt;</title>" in html and "c &amp; d" in html
    assert all(read_web(name) in html for name in (*SCRIPTS, "page.css"))
    assert not any("</script" in read_web(name).lower() for name in SCRIPTS)
    three = read_web("three.js")
    assert len(three) < 800_000 and three.startswith("/**\n * @license") and "MIT" in three[:200]
    html = whole_page(Page("a", "", [], ""))
    assert 'class="sub"' not in html and "<footer>" not in html


def test_what_is_wrong_is_told_with_its_remedy(shown, tmp_path, monkeypatch, capsys):
    with pytest.raises(OutputError, match=r"holds no job\.yaml"):
        write_report(LocalStore(tmp_path), 2, tmp_path / "page.html")
    (tmp_path / "file").touch()
    assert main(["report", str(shown.root), "--out", str(tmp_path / "file" / "page.html")]) == 2
    assert "choose another --out" in capsys.readouterr().err
    monkeypatch.setattr("services.look.report.trimesh.__file__", str(tmp_path / "__init__.py"))
    (tmp_path / "resources/templates").mkdir(parents=True)
    with zipfile.ZipFile(tmp_path / "resources/templates/viewer.zip", "w") as packed:
        packed.writestr("viewer.html.template", "<script>init();</script>")
    with pytest.raises(MachineError, match=r"requirements\.lock"):
        read_three.__wrapped__()


@pytest.mark.minute
def test_a_bucket_with_tars_gives_the_same_report(tmp_path):
    local, _ = make_dataset(tmp_path, name="other", scenes=2, categories=["can"], output={"layout": "tar"})

    def pictures_of(report):
        return [(one.scene_id, [picture.name for picture in one.pictures.values()]) for one in report.scenes]

    for remove in ((), (SUCCESS_FILE,)):
        for name in remove:
            local.remove(name)
        there, here = (read_report(store, 2) for store in (in_a_bucket(local.root), local))
        assert there.figures.files == here.figures.files > 0 and pictures_of(there) == pictures_of(here)


# ---------------------------------------------------------------------------------------------- in a browser

CONTROLS = "a[href], button:not([hidden]), input, select, summary, [tabindex='0']"
PICTURES = "[...document.querySelectorAll('.scene:not([hidden]) img, #wipe img')]"


def in_browser(test):
    """Marks a test that needs Chromium."""
    return pytest.mark.minute(pytest.mark.browser(needs_chromium(test)))


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with open_tab(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@pytest.fixture
def opened(tab, page):
    tab.said.clear()
    tab.requested.clear()
    tab.open(page.as_uri())
    return tab


def picture(tab, where: str, folder: Path) -> np.ndarray:
    """[H, W, 3] what the window shows of an element."""
    tab.run(f"document.querySelector('{where}').scrollIntoView({{block: 'center', behavior: 'instant'}})")
    tab.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = tab.run(f"document.querySelector('{where}').getBoundingClientRect().toJSON()")
    clip = {**{key: box[key] for key in ("x", "width", "height")}, "y": box["y"] + tab.run("scrollY"), "scale": 1}
    tab.screenshot(folder / "shot.png", whole=True, clip=clip)
    return np.asarray(Image.open(io.BytesIO((folder / "shot.png").read_bytes())).convert("RGB")).astype(int)


def draw_space(tab) -> None:
    """Scrolls to the view in space until it is drawn; again and again, for the live page may load itself anew."""
    canvas = "document.getElementById('space-canvas')"
    scrolled = f"{canvas}?.scrollIntoView({{block: 'center', behavior: 'instant'}})"
    tab.until(f"({scrolled}, Number({canvas}?.dataset.drawn) > 0)")


@in_browser
def test_every_picture_is_shown_a_category_alone_where_asked_and_nothing_is_fetched_or_said(opened):
    draw_space(opened)
    opened.run("document.querySelector('[data-show=\"\"]').click()")
    opened.run(f"{PICTURES}.forEach((one) => {{ one.loading = 'eager'; }})")
    opened.until(f"{PICTURES}.every((one) => one.complete)")
    widths = opened.run(f"{PICTURES}.map((one) => one.naturalWidth)")
    scenes = opened.run("document.querySelectorAll('.scene').length")
    assert scenes > 1 and len(widths) == scenes * 9 + 2 and min(widths) > 0
    shown = "[...document.querySelectorAll('.scene:not([hidden])')].map((one) => one.dataset.category)"
    for name, kept in (("can", {"can"}), ("", {"box", "can"})):
        opened.run(f"document.querySelector('[data-show=\"{name}\"]').click()")
        assert set(opened.run(shown)) == kept
    assert opened.said == []
    assert [one for one in opened.requested if not one.startswith(("data:", "file:"))] == []


@in_browser
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


@in_browser
def test_the_view_in_space_draws_turns_with_keys_and_hides_its_parts(opened, tmp_path):
    draw_space(opened)
    first = picture(opened, "#space-canvas", tmp_path)
    assert len(np.unique(first[4:-4, 4:-4].reshape(-1, 3), axis=0)) > 500
    opened.run("document.getElementById('space-canvas').focus()")
    for _ in range(4):
        opened.press("ArrowLeft", 37)
    assert np.abs(picture(opened, "#space-canvas", tmp_path) - first).mean() > 2
    opened.press("0", 48)
    assert np.abs(picture(opened, "#space-canvas", tmp_path) - first).mean() < 0.5
    chosen = "document.getElementById('space-scene')"
    opened.run(f"{chosen}.value = {chosen}.options.length - 1; {chosen}.dispatchEvent(new Event('change'))")
    assert np.abs(picture(opened, "#space-canvas", tmp_path) - first).mean() > 0.5
    for part in ("input", "mirror", "mesh", "cameras"):
        before = picture(opened, "#space-canvas", tmp_path)
        opened.run(f"document.querySelector('[data-part=\"{part}\"]').click()")
        hidden = picture(opened, "#space-canvas", tmp_path)
        assert part == "cameras" or np.abs(hidden - before).mean() > 0.2
    assert len(np.unique(hidden[4:-4, 4:-4].reshape(-1, 3), axis=0)) == 1


@in_browser
def test_layers_are_slid_through_close_to_the_object(tab, targets, tmp_path):
    write_report(targets, 1, tmp_path / "page.html")
    tab.said.clear()
    tab.open((tmp_path / "page.html").as_uri())
    tab.run("document.querySelector('[data-kind^=\"layer1 \"]').click(); document.getElementById('wipe-close').click()")
    tab.run("document.getElementById('wipe-member').focus()")
    told, shown = [], []
    for _ in range(4):
        told.append(tab.run("document.getElementById('wipe-told').textContent").partition(",")[0])
        shown.append(tab.run("document.getElementById('wipe-input').src"))
        tab.press("ArrowRight", 39)
    assert told == ["layer 1", "layer 2", "back", "back"] and len(set(shown)) == 3
    tab.until("document.getElementById('wipe-mirror').naturalWidth === 32")
    tab.run("document.querySelector('[data-kind=\"normals\"]').click()")
    assert not tab.run("document.getElementById('wipe-member').checkVisibility()")
    assert tab.said == []


@in_browser
def test_the_table_of_scenes_sorts_by_a_heading_and_keeps_what_has_all_words(opened):
    rows = "[...document.querySelectorAll('#scenes-table tbody tr')].filter((one) => !one.hidden)"
    cells = f"{rows}.map((one) => Number(one.cells[{{0}}].textContent))"
    head = "document.querySelectorAll('#scenes-table thead th')[{}].click()"
    for column in (0, 7):
        opened.run(head.format(column))
        falling = opened.run(cells.format(column))
        opened.run(head.format(column))
        assert falling == sorted(falling, reverse=True) and opened.run(cells.format(column)) == falling[::-1]
    words = opened.run(f"{rows}.map((one) => one.cells[1].textContent + one.cells[2].textContent)")
    asked = "(one) => {{ one.value = '{}'; one.dispatchEvent(new Event('input')); }}"
    opened.run(f"({asked.format('box TRAIN')})(document.getElementById('scenes-filter'))")
    assert opened.run(f"{rows}.length") == words.count("boxtrain") < len(words)


@in_browser
def test_light_and_dark_follow_the_system_until_one_is_chosen_and_a_phone_scrolls_downwards_only(tab, page):
    for dark, chosen in ((True, ""), (False, "dark"), (True, "light"), (False, "")):
        tab.open(page.as_uri(), dark=dark)
        tab.run(f"document.querySelector('[data-theme-to=\"{chosen}\"]').click()")
        style = "getComputedStyle(document.body).{}.match(/\\d+/g).map(Number)"
        paper, ink = (sum(tab.run(style.format(name))) for name in ("backgroundColor", "color"))
        assert (paper < ink) == (chosen == "dark" or (dark and not chosen)) and abs(paper - ink) > 450
        tab.run("document.querySelector('[data-theme-to=\"\"]').click()")
    tab.open(page.as_uri(), 380, 800)
    tab.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    assert tab.run("document.documentElement.scrollWidth") == 380
    wide = "(one) => one.getBoundingClientRect().right > 381 && !one.closest('svg, #scenes-table')"
    wide = f"[...document.querySelectorAll('main *')].filter({wide})"
    assert tab.run(f"{wide}.map((one) => one.outerHTML.slice(0, 80))") == []


@in_browser
def test_the_tab_key_reaches_every_control(opened):
    seen = f'[...document.querySelectorAll("{CONTROLS}")].filter((one) => one.checkVisibility())'
    opened.run(f"{seen}.forEach((one, i) => {{ one.dataset.stop = i; }})")
    count = opened.run(f"{seen}.length")
    assert count > 25
    reached = set()
    for _ in range(count + 2):
        opened.press("Tab", 9)
        reached.add(opened.run("document.activeElement.dataset.stop"))
    assert reached - {None} == {str(i) for i in range(count)}


@in_browser
def test_the_live_page_follows_a_folder_without_a_word_in_the_console(tab, shown, tmp_path):
    out = tmp_path / "out"
    out.symlink_to(tmp_path / "nowhere")
    follower = Follower(LocalStore(out), 2)
    tab.said.clear()
    with serving(follower, Place("127.0.0.1", 0, "a-token-of-some-length")) as place:
        follower.start()
        try:
            tab.open(place.address)
            assert "token" not in tab.run("location.href")
            tab.until("document.getElementById('live-now').innerText.includes('Waiting')")
            out.unlink()
            out.symlink_to(shown.root)
            tab.until("document.getElementById('live-now')?.innerText.includes('Finished')")
            tab.until("document.querySelectorAll('.scene').length > 0", 40)
            tab.until("[...document.querySelectorAll('.latest img')].every((one) => one.naturalWidth > 0)")
            draw_space(tab)
        finally:
            follower.stop()
        assert tab.run("document.title") == "small" and tab.said == []
    tab.until("!document.getElementById('live-gone')?.hidden")
