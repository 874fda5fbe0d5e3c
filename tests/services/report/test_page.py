from services.look.report import SCRIPTS, WEB, Page, Section, read_web, section_html, whole_page

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


def test_the_library_stands_with_its_version_and_licence_and_is_not_large():
    script = WEB / "three.js"
    assert script.stat().st_size < 800_000
    assert script.read_text().startswith("/*! three.js 0.187.0")
    assert "MIT" in (WEB / "three.LICENSE").read_text()


def test_a_page_without_subtitle_and_footer_has_no_empty_ones():
    html = whole_page(Page("a", "", [], ""))
    assert 'class="sub"' not in html and "<footer>" not in html
