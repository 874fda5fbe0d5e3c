"""What a study writes: tables that are read back exactly, and a page that needs nothing beside it and escapes what is foreign."""

import base64
import dataclasses
import io
import json
import math
import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from PIL import Image

from services.study.model import Figure, Setting, Study
from services.study.page import draw_tradeoff, moving_rows, page_of, question_of, write_study
from tests.kit.html import Reader
from tests.services.study.made_up import read_study, row, stored, study


@pytest.mark.minute
def test_a_study_comes_back_exactly_and_nothing_else_is_left(tmp_path: Path):
    odd = row("a=1", 0.5, flip=0.1 + 0.2, depth_mm=1e-300)
    odd = dataclasses.replace(odd, errors={**odd.errors, "gap_mm": Figure(0.1, 0.1, 0.1, 0.1, math.inf, 1)})
    changed = dataclasses.replace(
        odd, setting=Setting((("ä\n", '"'),), {"a": [None, True, -(2**60), [0.5]]}), notes=("", "é")
    )
    for made in (stored(), study(row(), changed, notes=("<&>",))):
        for _ in range(2):
            write_study(made, tmp_path / "new")
        files = {path.name for path in (tmp_path / "new").iterdir()}
        assert read_study(tmp_path / "new") == made
        assert files == {"tradeoff.parquet", "study.json", "tradeoff.png", "index.html"}


def test_the_table_has_a_row_a_setting(tmp_path: Path):
    write_study(study(row(depth_mm=0.1), row("step=240, tier=flat", 0.5, failed=0.01, flip=0.2)), tmp_path)
    table = pq.read_table(tmp_path / "tradeoff.parquet")
    assert {"depth_mm", "flip", "flip_low", "flip_high"} <= set(table.column_names)
    own, pair = table.to_pylist()
    assert (own["setting"], own["knob"], own["value"], own["depth_mm"], own["flip"]) == ("the job", "", "", 0.1, None)
    assert own["depth_mm_low"] == pytest.approx(0.09) and own["depth_mm_high"] == pytest.approx(0.11)
    assert (pair["setting"], pair["knob"], pair["value"]) == ("step=240, tier=flat", "step, tier", "240, flat")
    assert json.loads(pair["changes"]) == {"made.step": "240", "made.tier": "flat"}
    assert (pair["ms"], pair["ratio"], pair["kilobytes"], pair["failed_share"]) == (59.0, 0.5, 235.0, 0.01)
    assert (pair["ratio_least"], pair["ratio_most"]) == pytest.approx((0.49, 0.51))


def test_the_page_answers_first_and_needs_no_network_no_script_and_no_file(tmp_path: Path):
    write_study(stored(), tmp_path / "new")
    page = (tmp_path / "new" / "index.html").read_text(encoding="utf-8")
    reader = Reader(page)
    assert reader.texts["p"][0] == stored().answer
    assert reader.texts["h1"] == ["What accuracy costs in time: tabletop"]
    (picture,) = reader.links
    data = base64.b64decode(picture.removeprefix("data:image/png;base64,"))
    assert data == (tmp_path / "new" / "tradeoff.png").read_bytes()
    assert "script" not in reader.texts and "link" not in reader.texts
    assert not re.search(r"https?:|url\(|@import", page)
    words = Reader(page_of(study(row()), b"")).texts["p"]
    assert words[:2] == ["Use step=60.", "Not decided: whether step=30 (4 scenes)."]


def test_what_comes_from_outside_is_escaped():
    evil = '<script>alert("x")</script>&'
    rows = [row(depth_mm=0.1), row(f"{evil}={evil}", 0.5, depth_mm=0.2), row(f"a=1, {evil}={evil}", 0.4, depth_mm=0.3)]
    noted = tuple(dataclasses.replace(one, notes=(evil,)) for one in rows)
    made = Study(evil, evil, {evil: {evil: [evil]}}, 1, noted, 64, (evil,), 1.0, 1.0, evil, "", (evil,), ())
    page = page_of(made, b"")
    assert "<script" not in page and evil in " ".join(Reader(page).texts["li"])


def test_every_setting_is_in_tables_of_even_rows():
    rows = Reader(page_of(stored(), b"")).rows
    first = {cells[0] for cells in rows if cells}
    assert {each.setting.name for each in stored().rows} <= first
    wide = 0
    for cells in rows:
        wide = len(cells) if cells[0] == "setting" else wide
        assert len(cells) == wide > 5


def test_a_row_says_what_the_job_costs_and_what_differs_by_more_than_colour():
    rows = [row(name, ratio, depth_mm=d) for name, ratio, d in (("", 1, 0.1), ("a=1", 0.5, 0.2), ("a=2", 2, 0.05))]
    made = study(*rows, row("a=3", 3.0, depth_mm=0.1), job_scenes=100_000)
    cells = {cells[0]: cells for cells in Reader(page_of(made, b"")).rows if len(cells) == 6}
    marks = {"a=1": "▲ 0.2", "a=2": "▼ 0.05", "a=3": "0.1"}
    assert all(cells[name][-1].startswith(mark) for name, mark in marks.items())
    assert cells["a=2"][1:5] == ["2 times1.96 – 2.04", "236 ms", "6.6 h", "24 GB"]


def test_neither_a_panel_nor_a_cell_claims_what_intervals_do_not_tell():
    own, unsure, better = row(depth_mm=0.1), row("a=1", 0.5, depth_mm=0.085), row("a=2", 0.7, depth_mm=0.05)
    few = row("a=3", 0.4, scenes=3, depth_mm=0.001)
    asked = "depth of objects: what does less cost?"
    assert (
        question_of([own, unsure, few], "depth_mm")
        == f"{asked}\nNothing that was measured is surely better than the job."
    )
    assert question_of([own, unsure, better, few], "depth_mm").endswith(
        "a=2: 50% less, 0.7 times the time (0.686 to 0.714)"
    )
    assert question_of([row(scenes=3, depth_mm=0.1), better], "depth_mm") == asked
    for tiny, said in ((1e-15, "2e-5 mm"), (0.01, "0.01 mm")):  # what is as good as none is not compared
        answer = question_of([row(depth_mm=tiny), row("a=1", 0.5, depth_mm=tiny / 3)], "depth_mm")
        assert answer == f"{asked}\nNothing to gain: the job's is at most {said}, as good as none."
    once = dataclasses.replace(few, ratio=1.09, ratio_least=-math.inf, ratio_most=math.inf)
    cells = {cells[0]: cells for cells in Reader(page_of(study(own, once), b"")).rows if len(cells) == 6}
    assert cells["a=3"][1] == "≈ 1.09 timesof one scene" and cells["a=3"][-1] == "0.001of 3 scenes"


def test_the_machine_the_command_and_what_was_left_out_are_named():
    noted = [dataclasses.replace(row(name, depth_mm=0.1), notes=("31 scenes differ",)) for name in ("", "a=1")]
    reader = Reader(page_of(study(*noted, notes=("sensor: not of this job",)), b""))
    lines = reader.texts["li"]
    assert lines[1:4] == ["sensor: not of this job", "the job: 31 scenes differ", "a=1: 31 scenes differ"]
    assert lines[0].startswith(
        "depth_mm (mm), depth of objects: stored depth of objects off, 99 % of pixels, against a ray"
    )
    assert {
        "command: verso tradeoff deploy/jobs/tabletop.yaml --out data/tradeoff",
        "cpu: A made-up processor",
        'versions: {"numpy": "2.4.6"}',
        "the job's 64 scenes: 0.0021 core-hours, 15 MB",
    } <= set(lines)


@pytest.mark.minute
def test_every_study_has_a_picture_and_the_same_study_the_same_bytes():
    """Of long names, many knobs, points that lie on one another, errors of 0, and a job alone."""
    names = [f"a long name of knob {n}=a long value of it {k}" for n in range(9) for k in range(4)]
    crowd = [row(name, 0.9 + 0.005 * n, gap_mm=0.1 * (1 + n % 7), flip=0.1) for n, name in enumerate(names)]
    own = row(gap_mm=0.1, depth_mm=0.1, mirror_mm=1.0)
    zeros = [row("step=1", 3.0, gap_mm=0.0, mirror_mm=0.1), row("units=1", 0.9, depth_mm=0.5)]
    for made in (stored(), study(own, *crowd), study(own, *zeros), study(row(gap_mm=0.0)), study(row())):
        data = draw_tradeoff(made)
        with Image.open(io.BytesIO(data)) as image:
            width, height = image.size
        assert width == 780 and height >= 700  # letters of 9.5 points are 20 of these, and 10 of the 390 of a phone
        assert data == draw_tradeoff(made)


def test_a_panel_has_the_knobs_that_move_its_error_and_their_combinations():
    rows = [row(gap_mm=0.5), row("a=1", gap_mm=0.51), row("b=1", gap_mm=0.9), row("a=1, b=1", gap_mm=0.9)]
    rows += [row("preset=fast", gap_mm=0.5), row("c=1", flip=0.1)]
    assert [each.setting.name for each in moving_rows(rows, "gap_mm")] == ["the job", "b=1", "a=1, b=1", "preset=fast"]
    assert len(moving_rows([row(gap_mm=1e-9), row("a=1", gap_mm=1e-3)], "gap_mm")) == 1  # negligible
