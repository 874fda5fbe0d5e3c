from services.look.report import Section, View, live_page

VIEW = View("small", "38% · small", "<p>now</p>", (Section("one", "One", "<p>1</p>"), Section("two", "Two", "")), 7)


def test_the_page_of_a_server_names_its_files_and_holds_none():
    html = live_page(VIEW)
    for name in ("/page.css", "/three.js", "/page.js", "/space.js", "/live.js", "/icon.svg"):
        assert f'"{name}"' in html
    assert "<style" not in html and " style=" not in html and "data:" not in html
    assert 'data-version="7" data-shape="one"' in html
    assert "<p>now</p>" in html and 'id="two"' not in html


def test_a_state_tells_a_page_whether_it_is_of_another_shape_or_version():
    state = VIEW.state()
    assert (state["version"], state["shape"], state["title"], state["live"]) == (7, "one", VIEW.title, VIEW.live)


def test_fragments_are_the_sections_that_have_contents():
    fragments = VIEW.fragments()
    assert list(fragments["sections"]) == ["one"] and fragments["sections"]["one"].startswith('<section id="one"')
