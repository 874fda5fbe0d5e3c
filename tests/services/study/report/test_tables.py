"""What is written is read back, by us exactly and by others as Parquet."""

import json
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.study.model import ERRORS, Figure, Row, Setting, Study
from services.study.page import wide_schema, write_tables
from tests.made_up_studies import large_study, row, study
from tests.stored_studies import read_study

TEXT, NUMBER = st.text(max_size=8), st.floats(allow_nan=False)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | NUMBER | TEXT, lambda inner: st.lists(inner, max_size=2)
)
FIGURES = st.builds(Figure, NUMBER, NUMBER, NUMBER, NUMBER, st.integers(0, 10**6))
SETTINGS = st.builds(
    Setting, st.lists(st.tuples(TEXT, TEXT), max_size=2).map(tuple), st.dictionaries(TEXT, JSON, max_size=2)
)
NOTES = st.lists(TEXT, max_size=2).map(tuple)
ROWS = st.builds(
    Row,
    SETTINGS,
    *(NUMBER for _ in range(5)),
    st.dictionaries(st.sampled_from(sorted(ERRORS)), FIGURES, max_size=4),
    NUMBER,
    NOTES,
)
STUDIES = st.builds(
    Study,
    TEXT,
    TEXT,
    st.dictionaries(TEXT, JSON, max_size=3),
    st.integers(0, 100),
    st.integers(0, 1000),
    st.lists(ROWS, max_size=3).map(tuple),
    st.dictionaries(TEXT, NUMBER, max_size=2),
    TEXT,
    st.integers(0, 10**9),
    NOTES,
)


@given(STUDIES)
def test_a_study_comes_back_exactly(made: Study):
    with TemporaryDirectory() as folder:
        write_tables(made, Path(folder))
        assert read_study(Path(folder)) == made


def test_a_large_study_comes_back_exactly(tmp_path: Path):
    made = large_study()
    write_tables(made, tmp_path / "new" / "folder")
    assert read_study(tmp_path / "new" / "folder") == made


def test_numbers_of_numpy_and_other_mappings_come_back_as_plain_ones(tmp_path: Path):
    made = study(row(depth_mm=np.float64(0.1)))
    odd = Study(
        made.job,
        made.command,
        MappingProxyType({"cores": np.int64(2), "of": MappingProxyType({"a": 1})}),
        1,
        2,
        made.rows,
    )
    write_tables(odd, tmp_path)
    read = read_study(tmp_path)
    assert read.machine == {"cores": 2, "of": {"a": 1}} and read.rows == made.rows


def test_the_wide_table_has_a_row_a_setting_and_null_where_nothing_was_measured(tmp_path: Path):
    write_tables(study(row(depth_mm=0.1), row("step=240, tier=flat", 0.5, failed=0.01, flip=0.2)), tmp_path)
    table = pq.read_table(tmp_path / "tradeoff.parquet")
    assert table.schema.equals(wide_schema())
    own, pair = table.to_pylist()
    assert (own["setting"], own["knob"], own["value"], own["depth_mm"], own["flip"]) == ("the job", "", "", 0.1, None)
    assert own["depth_mm_low"] == pytest.approx(0.09) and own["depth_mm_high"] == pytest.approx(0.11)
    assert (pair["setting"], pair["knob"], pair["value"]) == ("step=240, tier=flat", "step, tier", "240, flat")
    assert json.loads(pair["changes"]) == {"made.step": "240", "made.tier": "flat"}
    assert (pair["ms"], pair["ratio"], pair["kilobytes"], pair["failed_share"]) == (59.0, 0.5, 235.0, 0.01)
    assert (pair["ratio_least"], pair["ratio_most"]) == pytest.approx((0.49, 0.51))
    assert set(ERRORS) <= set(table.column_names)


def test_the_long_table_has_a_row_an_error(tmp_path: Path):
    write_tables(study(row(depth_mm=0.1, mask_share=0.5), row("step=240", 0.5, moved_mm=0.3)), tmp_path)
    rows = pq.read_table(tmp_path / "errors.parquet").to_pylist()
    assert [(one["setting"], one["error"], one["amount"]) for one in rows] == [
        ("the job", "depth_mm", 0.1),
        ("the job", "mask_share", 0.5),
        ("step=240", "moved_mm", 0.3),
    ]
    last = rows[-1]
    assert (last["value"], last["unit"], last["group"], last["ms"], last["scenes"]) == (
        "240",
        "mm",
        "physics",
        59.0,
        48,
    )


def test_what_is_not_a_number_is_kept(tmp_path: Path):
    write_tables(study(row(depth_mm=math.nan, flip=math.inf)), tmp_path)
    errors = read_study(tmp_path).rows[0].errors
    assert math.isnan(errors["depth_mm"].value) and errors["flip"].value == math.inf


def test_nothing_but_the_three_files_is_left(tmp_path: Path):
    for _ in range(2):
        written = write_tables(study(row(depth_mm=0.1)), tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(written)
