import zipfile

import pytest

from schemas.errors import MachineError
from services.look.report import SCRIPTS, Page, Section, read_three, read_web, section_html, whole_page

PAGE = Page("a <b>", "c & d", [Section("one", "One", "<p>1</p>"), Section("two", "Two", "")], "the end")


def test_the_page_has_its_sections_that_have_contents_and_links_to_them():
    html = whole_page(PAGE)
    assert '<section id="one"' in html and 'href="#one"' in html
    assert 'id="two"' not in html and 'href="#two"' not in html
    assert "<title>a &lt;b&gt;</title>" in html and "c &amp; d" in html


def test_style_and_scripts_are_in_the_page():
    html = whole_page(PAGE)
    assert all(read_web(name) in html for name in (*SCRIPTS, "page.css"))
    assert not any("</script" in read_web(name).lower() for name in SCRIPTS)


def test_a_section_is_named_by_its_heading():
    html = section_html(PAGE.sections[0])
    assert 'aria-labelledby="one-heading"' in html and '<h2 id="one-heading">One</h2>' in html


def test_the_library_stands_with_its_licence_and_is_not_large():
    script = read_web("three.js")
    assert len(script) < 800_000
    assert script.startswith("/**\n * @license") and "MIT" in script[:200]


def test_a_viewer_that_begins_otherwise_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr("services.look.report.trimesh.__file__", str(tmp_path / "__init__.py"))
    (tmp_path / "resources/templates").mkdir(parents=True)
    with zipfile.ZipFile(tmp_path / "resources/templates/viewer.zip", "w") as packed:
        packed.writestr("viewer.html.template", "<script>init();</script>")
    with pytest.raises(MachineError, match=r"requirements\.lock"):
        read_three.__wrapped__()


def test_a_page_without_subtitle_and_footer_has_no_empty_ones():
    html = whole_page(Page("a", "", [], ""))
    assert 'class="sub"' not in html and "<footer>" not in html
