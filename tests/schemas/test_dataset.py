"""What is stored: the table of columns and the codec of rows, fingerprints, events of the queue, and words of messages."""

import dataclasses
import re

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.dataset.codec import (
    camera_columns,
    columns_of_bodies,
    contact_columns,
    label_columns,
    read_camera,
    read_label,
    read_world_poses,
)
from schemas.dataset.shard import Fingerprint
from schemas.dataset.tables import COLUMNS, FRAMES, SCHEMAS, SORT_KEYS, TABLES
from schemas.errors import describe_seconds, plain_line
from schemas.queue import ID_PATTERN, JobEvent, submission_id
from schemas.scene.scene import ContactForce
from schemas.scene.view import Camera, Intrinsics, ObjectLabel
from services.cli.arguments import JOB_ID

# ------------------------------------------------------------------------------------------------ columns

UNITS = {"id", "count", "1", "m", "mm", "m3", "mm/s", "px", "rad", "deg", "s", "kg", "N", "byte", "1/m", "K"}
SUFFIXES = {"_mm_s": "mm/s", "_units_per_m": "1/m", "_mm": "mm", "_m3": "m3", "_m": "m", "_rad": "rad"}
SUFFIXES |= {"_deg": "deg", "_s": "s", "_kg": "kg", "_px": "px", "_id": "id"}


def leaves(field: pa.Field, path: str):
    """(path, type, nullable) of a field and of every field inside, by the Arrow schema alone."""
    yield path, field.type, field.nullable
    kind, inside = field.type, f"{path}."
    if pa.types.is_list(kind):
        kind, inside = kind.value_type, f"{path}[]."
    if pa.types.is_struct(kind):
        for one in kind:
            yield from leaves(one, inside + one.name)


@pytest.mark.parametrize("table", TABLES)
def test_the_schema_has_every_column_in_order_and_every_quantity_a_unit(table):
    columns = [leaf for field in SCHEMAS[table] for leaf in leaves(field, field.name)]
    assert [path for path, _, _ in columns] == [column.path for column in COLUMNS[table]]
    assert set(SORT_KEYS[table]) <= set(SCHEMAS[table].names)
    for column, (_, kind, nullable) in zip(COLUMNS[table], columns, strict=True):
        assert nullable == column.nullable, column
        assert column.meaning.endswith(".") and len(column.meaning) > 4 and "|" not in column.meaning, column
        item = kind.value_type if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) else kind
        is_number = pa.types.is_integer(item) or pa.types.is_floating(item)
        assert column.unit in UNITS if is_number else not column.unit, column
        name = column.path.rpartition(".")[2]
        suffix = next((unit for end, unit in SUFFIXES.items() if name.endswith(end)), None)
        assert not (is_number and suffix) or column.unit == suffix, column
        frames = column.frame.split(", ") if column.frame else []
        assert all(frame in FRAMES for frame in frames), column
        assert len(frames) == 2 if name.startswith("T_") else frames or not pa.types.is_fixed_size_list(kind), column


# ------------------------------------------------------------------------------------------------ rows

T = np.arange(16.0).reshape(4, 4) / 7.0
CONTACT = {"with_region": 2, "point": [0.0, 0.1, 0.7], "normal": [0.0, 0.0, 1.0], "force": [0.0, 0.0, 3.924]}
FIGURES = {"penetration_mm": 0.1, "hover_gap_mm": 0.2, "support_margin_mm": 9.0, "residual_speed_mm_s": 0.3}
REST = {"recheck_move_mm": None, "recheck_turn_deg": None, "equilibrium_residual": 0.0, "redraws": 2, **FIGURES}
NAMES = {"region_id": 3, "category": "mug", "instance_id": "m1", "source": "procedural", "object_scale": 1.0}
MASS = {"mass_kg": 0.4, "friction": None, "com": [0.0, 0.1, 0.8], "contacts": [CONTACT]}
BODY = {"T_world_obj": T.ravel().tolist(), **NAMES, **REST, **MASS}


def test_a_camera_a_label_and_a_contact_come_back_from_their_rows():
    camera = Camera(Intrinsics(width=640, height=480, fx=525.0, fy=524.0, cx=320.0, cy=240.0), T)
    row = camera_columns(camera)
    assert row.keys() <= set(SCHEMAS["views"].names)
    assert (row["cx"] - row["cx_opencv"], row["cy"] - row["cy_opencv"]) == (0.5, 0.5)
    seen = read_camera(row)
    assert seen.intrinsics == camera.intrinsics and np.array_equal(seen.T_world_cam, T)
    assert not seen.T_world_cam.flags.writeable
    label = ObjectLabel(3, "mug", "m1", T, 12, 34, (1, 2, 3, 4), 5, 0.25)
    assert label_columns(label).keys() <= set(SCHEMAS["objects"].names)
    read = read_label(label_columns(label))
    for field in dataclasses.fields(ObjectLabel):
        assert np.array_equal(getattr(read, field.name), getattr(label, field.name))
    contact = ContactForce(2, *(np.array(CONTACT[name]) for name in ("point", "normal", "force")))
    assert contact_columns(contact) == CONTACT


def test_a_scene_has_its_first_bodys_names_and_its_worst_bodys_figures():
    names = {field.name for field in SCHEMAS["scenes"].field("bodies").type.value_type}
    assert set(BODY) == names
    assert columns_of_bodies([BODY]).keys() == names - {"region_id", "mass_kg", "friction", "com", "contacts"}
    for name, first, second, expected in (
        ("penetration_mm", 0.1, 0.5, 0.5),
        ("support_margin_mm", 9.0, 4.0, 4.0),
        ("recheck_move_mm", None, 0.7, 0.7),
        ("recheck_turn_deg", None, None, None),
        ("redraws", 2, 5, 2),
        ("instance_id", "m1", "a0", "m1"),
    ):
        bodies = [{**BODY, name: first}, {**BODY, "region_id": 4, name: second}]
        assert columns_of_bodies(bodies)[name] == expected
    capture = {"T_world_table": np.eye(4).ravel().tolist(), "T_world_obj": BODY["T_world_obj"], "bodies": None}
    for row in (capture, {**capture, "bodies": [BODY]}):
        poses = read_world_poses(row)
        assert list(poses) == [2, 3]
        assert np.array_equal(poses[2], np.eye(4)) and np.array_equal(poses[3], T)


# ------------------------------------------------------------------------------------------------ messages


def test_each_difference_of_two_stacks_has_its_remedy_and_what_can_be_installed_is_told_first():
    libraries, renderer = {"numpy": "2.4.6"}, "llvmpipe, 256 bits"
    mine = Fingerprint(canary="c", code="d", libraries=libraries, simd="X86_V2 X86_V3", renderer=renderer)
    for change, difference, remedy in (
        ({"code": "e"}, "code: d, e", "install the same wheel"),
        ({"libraries": {"numpy": "2.4.5"}}, "numpy: 2.4.6, 2.4.5", "requirements.lock"),
        ({"renderer": "llvmpipe, 512 bits"}, f"renderer: {renderer}, llvmpipe, 512 bits", "libgl1-mesa-dri"),
        ({"simd": "X86_V2"}, "simd: X86_V2 X86_V3, X86_V2", "NPY_DISABLE_CPU_FEATURES"),
        ({"maths": "m"}, "maths: , m", "GLIBC_TUNABLES"),
        ({"python": "CPython 3.12.1"}, "python: , CPython 3.12.1", "the same Python"),
        ({"binaries": "b"}, "binaries: , b", "--only-binary"),
        ({"canary": "x"}, "canary: c, x", "machines of one kind"),
    ):
        other = mine.model_copy(update=change)
        assert mine.differences(other) == [difference] and mine.digest != other.digest
        assert remedy in mine.remedies(other)
    worse = mine.model_copy(update={"canary": "x", "code": "e", "simd": "none"})
    assert "install the same wheel" in mine.remedies(worse)


def test_ids_of_the_queue_hold_nothing_that_a_shell_reads_and_an_event_that_means_nothing_is_refused():
    assert f"^{JOB_ID}$" == ID_PATTERN
    assert re.fullmatch("[a-z0-9-]+", submission_id("j0a1b2c3d", 12))
    for wrong in (
        {"kind": "ended", "attempt": 1},
        {"kind": "died", "attempt": 1, "code": 1},
        {"kind": "cancel", "attempt": 1},
        {"kind": "started"},
        {"kind": "flew", "attempt": 1},
        {"kind": "died", "attempt": 1, "note": "two\nlines"},
    ):
        with pytest.raises(ValidationError):
            JobEvent(at=0.0, nonce="0" * 32, **wrong)


def test_a_duration_is_told_in_one_unit_with_two_digits():
    short = {0.0: "0 s", 0.1178: "0.12 s", 7.552: "7.6 s", 59.0: "59 s", 90.0: "1.5 min", 300.0: "5 min"}
    long = {5399.0: "90 min", 7200.0: "2 h", 9000.0: "2.5 h", 31 * 3600.0: "31 h", 9 * 86400.0: "9 d"}
    words = {**short, **long, 4321 * 86400.0: "4321 d"}
    assert {seconds: describe_seconds(seconds) for seconds in words} == words


@given(st.text(alphabet=st.characters(), max_size=200), st.integers(4, 100))
def test_any_text_becomes_a_line_that_can_be_printed_and_encoded(text, most):
    line = plain_line(text, most)
    line.encode()
    assert line.isprintable() and len(line) <= 10 * most
    assert plain_line("mug, größe 3") == "mug, größe 3"
    assert plain_line("\x1b[31mred\n\x9b\udcff") == "\\x1b[31mred\\n\\x9b\\udcff"
    assert (plain_line("a" * 81), plain_line("a" * 80)) == ("a" * 77 + "...", "a" * 80)
