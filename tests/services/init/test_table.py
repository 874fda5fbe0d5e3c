"""The table on the terminal."""

import pytest

from services.init.collection import LeftOut
from services.init.shown import (
    MOST_ROWS,
    describe_size,
    describe_up,
    draw_left_out,
    draw_table,
    missing_pictures,
    shorten,
)

ROW = (
    "a_folder/of_a_long_name/and_a_mesh.obj",
    "category",
    "12.3 x 4.5 x 67.8",
    "20000",
    "yes",
    "1",
    "y sure",
    "note " * 30,
)


@pytest.mark.parametrize("width", [60, 80, 100, 140, 400])
def test_it_fits_the_terminal_and_what_is_cut_shows_it(width):
    lines = draw_table([ROW, ROW], width)
    assert len(lines) == 3 and all(len(line) <= width for line in lines)
    assert ("…" in lines[1]) == (width < 400)
    assert lines[0].split()[0] == "file"


def test_what_is_not_shown_is_counted():
    assert draw_table([ROW] * (MOST_ROWS + 5), 100)[-1] == "and 5 more: --json lists all"
    left = [LeftOut(f"{k}.obj", "format", "why") for k in range(MOST_ROWS + 3)]
    lines = draw_left_out([*left, LeftOut("p.obj", "part", "is a part of x.urdf")], 100)
    assert lines[0] == f"left out: {MOST_ROWS + 3} files" and lines[1] == "  0.obj (format): why"
    assert lines[-2:] == ["  and 3 more: --json lists all", "1 mesh not offered by themselves: parts of the URDFs"]
    assert draw_left_out([], 100) == []


def test_words_of_cells():
    assert describe_size((0.105, 0.0796, 1.23456)) == "10.5 x 7.96 x 123"
    assert [describe_up("y", *says) for says in ((None, None), ("y", "sure"), ("z", "likely"))] == [
        "y?",
        "y sure",
        "y (or z)",
    ]
    assert missing_pictures(("a.png is missing: plain base colour used", "6 doubled or empty faces dropped")) == 1
    assert [shorten("abcdefgh", most) for most in (8, 5, 2)] == ["abcdefgh", "ab…gh", "a…"]
