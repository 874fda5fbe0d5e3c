"""Labels beside the images: what they hold is what the tables say, to the last bit of every double."""

import json

import pytest

from tests.made_up_scenes import made_scene
from workers.store.manifest import decode_table, encode_table, sorted_rows, table_of_rows
from workers.store.tars import LABEL_TABLES, decode_label, encode_label, label_differences, pose_labels


def tables_of(scene_id):
    return {table: table_of_rows(table, made_scene(scene_id).rows[table]) for table in LABEL_TABLES}


def as_rows(tables):
    return {table: rows.to_pylist() for table, rows in tables.items()}


def test_there_is_a_label_for_each_pose_with_the_views_that_share_its_number():
    labels = pose_labels(as_rows(tables_of(7)))
    category = made_scene(7).rows["scenes"][0]["category"]
    assert {key: sorted(label["views"]) for key, label in labels.items()} == {
        (category, 14): ["aligned", "input", "projected"],
        (category, 15): ["mirror"],
    }


def test_a_label_repeats_the_rows_of_its_views_and_objects():
    rows = as_rows(tables_of(7))
    for label in pose_labels(rows).values():
        for role, view in label["views"].items():
            (row,) = (row for row in rows["views"] if row["role"] == role)
            own = [one for one in rows["objects"] if one["role"] == role]
            assert row.keys() - view.keys() == {"files", "scene_id", "category"}
            assert all(row[name] == value for name, value in view.items() if name != "objects")
            assert [one["region_id"] for one in view["objects"]] == sorted(one["region_id"] for one in own)
            assert view["objects"][0].items() <= own[0].items()
        assert label["scene"].items() >= {"T_world_obj": rows["scenes"][0]["T_world_obj"]}.items()
        assert label["assets"].keys() == {row["instance_id"] for row in rows["assets"]}


def test_a_label_made_from_the_stored_tables_has_the_same_bytes():
    tables = tables_of(7)
    read = {
        table: decode_table(table, encode_table(sorted_rows(table, rows)), "here").to_pylist()
        for table, rows in tables.items()
    }
    first = {key: encode_label(label) for key, label in pose_labels(as_rows(tables)).items()}
    assert {key: encode_label(label) for key, label in pose_labels(read).items()} == first


def test_a_whole_double_is_written_as_a_double_whatever_the_scene_gave():
    output = made_scene(7)
    for view in output.rows["views"]:
        view["fx"] = 525
    rows = {table: table_of_rows(table, output.rows[table]).to_pylist() for table in LABEL_TABLES}
    label = next(iter(pose_labels(rows).values()))
    assert b'"fx":525.0,' in encode_label(label)


def test_a_label_reads_back_as_it_was_and_a_torn_one_is_told():
    label = next(iter(pose_labels(as_rows(tables_of(7))).values()))
    data = encode_label(label)
    assert decode_label(data) == json.loads(json.dumps(label)) == label
    assert list(label_differences(decode_label(data), label)) == []
    for torn in (data[:-5], b"3", b"[" * 100_000, b"\xff"):
        with pytest.raises(ValueError, match=r"Expecting|keys|nested|decode|Unterminated"):
            decode_label(torn)


def test_differences_are_told_by_their_path_and_an_absent_value_is_no_difference():
    stored = {"a": 1, "b": {"c": [1.0, 2.0], "d": None}, "f": -0.0}
    assert list(label_differences(stored, {**stored, "new": None})) == []
    assert list(label_differences(stored, {**stored, "new": 3})) == ["new"]
    assert list(label_differences({**stored, "a": True}, stored)) == ["a"]
    assert list(label_differences({**stored, "f": 0.0}, stored)) == ["f"]
    assert list(label_differences({**stored, "b": {"c": [1.0], "d": None}}, stored)) == ["b.c"]
    assert list(label_differences({**stored, "b": {"c": [1.0, 3.0], "e": 1}}, stored)) == ["b.c.1", "b.e"]


def test_a_view_without_its_scene_has_no_label():
    assert pose_labels(as_rows(tables_of(7)) | {"scenes": []}) == {}
