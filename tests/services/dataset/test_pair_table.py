"""Pairs as one table: every column of the scene, and of each view."""

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from schemas.dataset.tables import SCHEMAS
from schemas.errors import InputError
from services.dataset.dataset import PAIR_TABLES, choose_pairs, pair_table
from tests.made_up_scenes import made_scene
from workers.store.manifest import table_of_rows


@pytest.fixture(scope="module")
def rows() -> dict[str, pa.Table]:
    outputs = [made_scene(scene_id) for scene_id in (7, 3, 5)]
    return {name: table_of_rows(name, [row for one in outputs for row in one.rows[name]]) for name in PAIR_TABLES}


def test_a_pair_has_its_scene_and_its_views(rows):
    pairs = pair_table(rows).to_pylist()
    assert [pair["parent_id"] for pair in pairs] == sorted({row["parent_id"] for row in rows["views"].to_pylist()})
    for pair in pairs:
        (scene,) = [row for row in rows["scenes"].to_pylist() if row["scene_id"] == pair["scene_id"]]
        assert {name: pair[name] for name in SCHEMAS["scenes"].names} == scene
        views = {row["role"]: row for row in rows["views"].to_pylist() if row["parent_id"] == pair["parent_id"]}
        assert {role: pair[role] for role in views} == views
        assert pair["asset"] is None or pair["asset"]["instance_id"] == scene["instance_id"]


def test_a_view_that_is_not_there_is_null(rows):
    fewer = {**rows, "views": rows["views"].filter(pc.field("role") != "aligned")}
    assert all(pair["aligned"] is None and pair["mirror"] for pair in pair_table(fewer).to_pylist())


def test_a_choice_among_no_pairs_is_none():
    empty = pair_table({name: SCHEMAS[name].empty_table() for name in PAIR_TABLES})
    assert choose_pairs(empty, pc.field("input", "visible_fraction") > 0.5).num_rows == 0


@pytest.mark.parametrize("where", [pc.field("nothing") == 1, pc.field("category") == 1, pc.field("input", "no") == 1])
def test_a_choice_that_cannot_be_is_told_with_the_columns(rows, where):
    with pytest.raises(InputError, match="Columns of a pair: scene_id, category"):
        choose_pairs(pair_table(rows), where)
