"""Somebody's text in a message: short, on one line, and nothing that a terminal obeys."""

from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import plain_line


def test_what_can_be_printed_stays_as_it_is():
    assert plain_line("mug, größe 3") == "mug, größe 3"


def test_what_a_terminal_obeys_is_shown_as_an_escape():
    assert plain_line("\x1b[31mred\n\x9b\udcff") == "\\x1b[31mred\\n\\x9b\\udcff"


def test_long_text_is_cut():
    assert plain_line("a" * 81) == "a" * 77 + "..."
    assert plain_line("a" * 80) == "a" * 80


@given(st.text(alphabet=st.characters(), max_size=200), st.integers(4, 100))
def test_any_text_becomes_a_line_that_can_be_printed_and_encoded(text, most):
    line = plain_line(text, most)
    assert line.isprintable()
    assert len(line) <= 10 * most
    line.encode()
