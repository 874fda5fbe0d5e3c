"""What a study writes: tables that are read back exactly, and a page that needs nothing beside it and escapes what is foreign."""

import base64
import dataclasses
import json
import math
import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from services.study.model import ERRORS, Setting, Study
from services.study.page import page_of, wide_schema, write_page, write_tables
from tests.kit.html import Reader
from tests.services.study.made_up import read_study, row, stored, study

# ---------------------------------------------------------------------------------------------- tables


def test_a_study_comes_back_exactly_and_nothing_else_is_left(tmp_path: Path):
    odd = row("a=1", 1e-300, flip=0.1 + 0.2, depth_mm=math.inf)
    changed = dataclasses.replace(
        odd, setting=Setting((("ä\n", '"'),), {"a": [None, True, -(2**60), [0.5]]}), notes=("", "é")
    )
    for made in (stored(), study(row(), changed, notes=("<&>",))):
        for _ in range(2):
            written = write_tables(made, tmp_path / "new")
        assert read_study(tmp_path / "new") == made and sorted((tmp_path / "new").iterdir()) == sorted(written)


def test_the_wide_table_has_a_row_a_setting_and_the_long_one_a_row_an_error(tmp_path: Path):
    write_tables(study(row(depth_mm=0.1), row("step=240, tier=flat", 0.5, failed=0.01, flip=0.2)), tmp_path)
    table = pq.read_table(tmp_path / "tradeoff.parquet")
    assert table.schema.equals(wide_schema()) and set(ERRORS) <= set(table.column_names)
    own, pair = table.to_pylist()
    assert (own["setting"], own["knob"], own["value"], own["depth_mm"], own["flip"]) == ("the job", "", "", 0.1, None)
    assert own["depth_mm_low"] == pytest.approx(0.09) and own["depth_mm_high"] == pytest.approx(0.11)
    assert (pair["setting"], pair["knob"], pair["value"]) == ("step=240, tier=flat", "step, tier", "240, flat")
    assert json.loads(pair["changes"]) == {"made.step": "240", "made.tier": "flat"}
    assert (pair["ms"], pair["ratio"], pair["kilobytes"], pair["failed_share"]) == (59.0, 0.5, 235.0, 0.01)
    assert (pair["ratio_least"], pair["ratio_most"]) == pytest.approx((0.49, 0.51))
    first, last = pq.read_table(tmp_path / "errors.parquet").to_pylist()
    assert (first["setting"], first["error"], first["amount"]) == ("the job", "depth_mm", 0.1)
    expected = {"setting": "step=240, tier=flat", "value": "240, flat", "error": "flip", "unit": "", "group": "colour"}
    assert last.items() >= {**expected, "ms": 59.0, "amount": 0.2, "scenes": 48}.items()


# ---------------------------------------------------------------------------------------------- the page


def test_the_page_answers_first_and_needs_no_network_no_script_and_no_file(tmp_path: Path):
    picture = tmp_path / "tradeoff.png"
    picture.write_bytes(b"\x89PNG made up")
    write_page(stored(), [picture, picture], tmp_path / "new" / "index.html")
    page = (tmp_path / "new" / "index.html").read_text(encoding="utf-8")
    reader = Reader(page)
    assert reader.texts["p"][0] == stored().answer
    assert reader.texts["h1"] == ["What accuracy costs in time: tabletop"]
    assert len(reader.links) == 2 and all(link.startswith("data:image/png;base64,") for link in reader.links)
    assert "script" not in reader.texts and "link" not in reader.texts
    assert base64.b64decode(reader.links[0].partition(",")[2]) == picture.read_bytes()
    assert not re.search(r"https?:|url\(|@import", page)
    assert Reader(page_of(study(row()), [])).texts["p"][:2] == [
        "Use step=60.",
        "Not decided: whether step=30 (4 scenes).",
    ]


def test_what_comes_from_outside_is_escaped():
    evil = '<script>alert("x")</script>&'
    rows = [row(depth_mm=0.1), row(f"{evil}={evil}", 0.5, depth_mm=0.2), row(f"a=1, {evil}={evil}", 0.4, depth_mm=0.3)]
    noted = tuple(dataclasses.replace(one, notes=(evil,)) for one in rows)
    made = Study(evil, evil, {evil: {evil: [evil]}}, 1, noted, evil, 64, (evil,), answer=evil, doubts=(evil,))
    page = page_of(made, [])
    assert "<script" not in page and evil in " ".join(Reader(page).texts["li"])


def test_every_setting_and_error_is_in_tables_of_even_rows():
    rows = Reader(page_of(stored(), [])).rows
    first = {cells[0] for cells in rows if cells}
    for one in stored().rows:
        assert (one.setting.name if len(one.setting.parts) != 1 else one.setting.parts[0][1]) in first
    assert set(ERRORS) | {"the job", "command"} <= first
    wide = 0
    for cells in rows[: next(place for place, cells in enumerate(rows) if cells and cells[0] == "target")]:
        wide = len(cells) if cells[0] == "setting" else wide
        assert len(cells) in (1, wide)
    assert wide


def test_a_row_says_what_the_job_costs_and_what_differs_by_more_than_colour():
    rows = [
        row(depth_mm=0.1),
        row("a=1", 0.5, depth_mm=0.2),
        row("a=2", 2.0, depth_mm=0.05),
        row("a=3", 3.0, depth_mm=0.1),
    ]
    cells = {cells[0]: cells for cells in Reader(page_of(study(*rows, job_scenes=100_000), [])).rows if len(cells) == 6}
    assert (
        cells["1"][-1].startswith("▲ 0.2") and cells["2"][-1].startswith("▼ 0.05") and cells["3"][-1].startswith("0.1")
    )
    assert cells["2"][1:5] == ["2 times1.96 – 2.04", "236 ms", "6.6 h6.56 core-hours", "24 GB"]


def test_the_machine_the_command_and_what_was_left_out_are_told():
    noted = [dataclasses.replace(row(name, depth_mm=0.1), notes=("31 scenes differ",)) for name in ("", "a=1")]
    reader = Reader(page_of(study(*noted, notes=("sensor: not of this job",)), []))
    assert reader.texts["li"] == ["sensor: not of this job", "31 scenes differ (the job, a=1)"]
    assert Reader(page_of(study(row(depth_mm=0.1)), [])).texts["li"] == ["Nothing was left out."]
    rows = {cells[0]: cells[-1] for cells in reader.rows if len(cells) == 2}
    assert rows["command"] == "verso tradeoff deploy/jobs/tabletop.yaml --out data/tradeoff"
    assert rows["cpu"] == "A made-up processor" and rows["versions"] == "numpy 2.4.6"
    assert rows["the job's 64 scenes"] == "7.6 s on one core (0.0021 core-hours), 15 MB"
