import csv
import math
import urllib.parse

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.tables import SCHEMAS
from services.merge.tables import escaped, object_lines, shortest
from tests.made_up_datasets import FIRST, STOP, plain_rows
from tests.made_up_scenes import fails, made_scene

ROLE_ORDER = ["input", "aligned", "mirror", "projected"]


def test_cam_poses_has_two_rows_a_pair_that_read_back_to_the_same_doubles(merged):
    store, _ = merged
    with open(store.root / "camPoses.csv", newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["id", "parent_id", *(f"T{i}{j}" for i in range(4) for j in range(4))]
    views = [row for row in plain_rows("views") if row["role"] in ("input", "mirror")]
    assert [[int(row[0]), int(row[1])] for row in rows] == [[view["pose_id"], view["parent_id"]] for view in views]
    assert [int(row[0]) for row in rows] == [i for s in range(FIRST, STOP) if not fails(s) for i in (2 * s, 2 * s + 1)]
    for row, view in zip(rows, views, strict=True):
        numbers = list(map(float, row[2:]))
        assert numbers == view["T_world_cam"]
        assert math.copysign(1, numbers[12]) == -1  # -0.0 is kept


def test_cameras_has_every_camera_in_order_with_both_conventions(merged):
    store, _ = merged
    with open(store.root / "cameras.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    views = sorted(plain_rows("views"), key=lambda view: (view["pose_id"], ROLE_ORDER.index(view["role"])))
    assert len(rows) == len(views)
    for row, view in zip(rows, views, strict=True):
        assert row["role"] == view["role"]
        for name in (
            "pose_id",
            "parent_id",
            "width",
            "height",
            "fx",
            "cx",
            "cy",
            "cx_opencv",
            "cy_opencv",
            "depth_units_per_m",
        ):
            assert float(row[name]) == view[name]
        assert [float(row[f"T{i}{j}"]) for i in range(4) for j in range(4)] == view["T_world_cam"]


def test_objects_has_a_line_for_everything_in_a_pose_table_included(merged):
    store, _ = merged
    lines = (store.root / "objects.dat").read_text().splitlines()
    objects = [row for row in plain_rows("objects") if row["role"] in ("input", "mirror")]
    assert len(lines) == len(objects)
    for line, row in zip(lines, objects, strict=True):
        pose, category, instance, region, u, v, *matrix = line.split(" ")
        assert (int(pose), category, instance, int(region)) == tuple(
            row[key] for key in ("pose_id", "category", "instance_id", "region_id")
        )
        assert (int(u), int(v)) == (row["u"], row["v"])
        assert list(map(float, matrix)) == row["T_cam_obj"]
    assert {line.split(" ")[1] for line in lines} >= {"table"}


@pytest.mark.parametrize("name", ["blue mug", "50%", "a\tb", "non\u00a0breaking", "line\nend", "plain-name_1.2"])
def test_a_name_with_spaces_is_one_word_and_can_be_had_back(name):
    row = {**made_scene(3).rows["objects"][0], "instance_id": name}
    (line,) = object_lines(pa.Table.from_pylist([row], schema=SCHEMAS["objects"])).decode().splitlines(keepends=True)
    words = line.removesuffix("\n").split()
    assert len(words) == 22
    assert urllib.parse.unquote(words[2]) == name
    assert (escaped(name) == name) == (name == "plain-name_1.2")


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False)))
def test_every_double_is_written_as_python_writes_it(numbers):
    edges = [0.0, -0.0, 1.0, 1e-4, 9.999e-5, 1e10, 9999999999.999998, 1e15, 1e16, 5e-324, 1.7976931348623157e308]
    for values in (numbers, numbers + edges):
        assert shortest(pa.array(values, pa.float64())).to_pylist() == list(map(repr, values))
