"""The page: it parses, needs nothing beside it, and escapes what comes from outside."""

import base64
import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from services.study.choose import answer
from services.study.model import Study
from services.study.page import page_of, write_page
from tests.made_up_studies import large_study, row, study

VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Holds that every element that is opened is closed, and collects text and attributes by element."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.texts: dict[str, list[str]] = {}
        self.links: list[str] = []
        self.seen: set[str] = set()
        self.rows: list[list[str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.add(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.setdefault(self.open[-1] if self.open else "", []).append(data)
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return reader


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    file = tmp_path / "tradeoff.png"
    file.write_bytes(b"\x89PNG made up")
    return file


def test_the_page_parses_and_its_sentence_comes_first(picture: Path, tmp_path: Path):
    made = large_study()
    write_page(made, [picture, picture], tmp_path / "new" / "index.html")
    reader = read((tmp_path / "new" / "index.html").read_text(encoding="utf-8"))
    assert reader.texts["p"][0] == answer(made)
    assert reader.texts["h1"] == ["What accuracy costs in time: tabletop"]


def test_the_page_needs_no_network_no_script_and_no_file(picture: Path):
    page = page_of(large_study(), [picture])
    reader = read(page)
    assert "script" not in reader.seen and "link" not in reader.seen
    assert reader.links and all(link.startswith("data:image/png;base64,") for link in reader.links)
    assert base64.b64decode(reader.links[0].partition(",")[2]) == picture.read_bytes()
    assert not re.search(r"https?:|url\(|@import", page)


def test_what_comes_from_outside_is_escaped():
    evil = '<script>alert("x")</script>&'
    made = study(
        row(depth_mm=0.1),
        row(f"{evil}={evil}", 0.5, depth_mm=0.2),
        row(f"step=1, {evil}={evil}", 0.4, depth_mm=0.3),
        notes=(evil,),
    )
    rows = tuple(dataclasses.replace(one, notes=(evil,)) for one in made.rows)
    made = Study(evil, evil, {evil: {evil: [evil]}}, 1, 2, rows, {evil: 1.0}, evil, 64, (evil,))
    page = page_of(made, [])
    reader = read(page)
    assert "script" not in reader.seen and "<script" not in page
    assert evil in " ".join(reader.texts["li"])


def test_every_setting_and_error_is_in_the_tables():
    made = large_study()
    reader = read(page_of(made, []))
    cells = [cells[0] for cells in reader.rows if cells]
    for one in made.rows:
        assert (one.setting.name if len(one.setting.parts) != 1 else one.setting.parts[0][1]) in cells
    assert "physics" not in cells and {"the job", "penetration_mm", "flip", "command"} <= set(cells)


def test_every_row_of_a_table_has_as_many_cells_as_its_head():
    reader = read(page_of(large_study(), []))
    wide = 0
    for cells in reader.rows:
        if cells and cells[0] == "setting":
            wide = len(cells)
        elif cells and cells[0] == "target":
            break
        else:
            assert len(cells) in (1, wide)
    assert wide


def test_better_and_worse_than_the_job_are_marked_by_more_than_colour():
    made = study(
        row(depth_mm=0.1), row("a=1", 0.5, depth_mm=0.2), row("a=2", 2.0, depth_mm=0.05), row("a=3", 3.0, depth_mm=0.1)
    )
    rows = {cells[0]: cells for cells in read(page_of(made, [])).rows if len(cells) == 6}
    assert rows["1"][-1].startswith("▲ 0.2") and rows["2"][-1].startswith("▼ 0.05") and rows["3"][-1].startswith("0.1")


def test_a_row_says_what_the_whole_job_costs():
    rows = read(page_of(study(row(depth_mm=0.1), row("a=1", 2.0, depth_mm=0.1), job_scenes=100_000), [])).rows
    doubled = next(cells for cells in rows if cells and cells[0] == "1")
    assert doubled[1:5] == ["2 times1.96 – 2.04", "236 ms", "6.6 h6.56 core-hours", "24 GB"]


def test_what_was_not_measured_is_told_with_whom_it_is_about():
    made = large_study()
    notes = read(page_of(made, [])).texts["li"]
    assert notes[: len(made.notes)] == list(made.notes)
    assert sum(note.startswith("finer steps do not agree in 31 scenes (the job, ") for note in notes) == 1
    assert read(page_of(study(row(depth_mm=0.1)), [])).texts["li"] == ["Nothing was left out."]


def test_the_machine_and_the_command_are_told():
    rows = {cells[0]: cells[-1] for cells in read(page_of(large_study(), [])).rows if len(cells) == 2}
    assert rows["command"] == "verso tradeoff deploy/jobs/tabletop.yaml --out data/tradeoff"
    assert rows["cpu"] == "A made-up processor" and rows["versions"] == "numpy 2.4.6"
    assert rows["the job's 64 scenes"] == "7.6 s on one core (0.0021 core-hours), 15 MB"
    assert rows["step"] == "1.02"


def test_the_page_answers_the_targets_that_were_asked():
    made = large_study()
    assert read(page_of(made, [], {"depth_mm": 0.06})).texts["p"][0] == answer(made, {"depth_mm": 0.06})
