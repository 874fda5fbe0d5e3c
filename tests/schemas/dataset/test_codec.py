"""Rows from models and back: the codec's columns are the tables', and nothing is lost on the way."""

import dataclasses

import numpy as np
import pytest

from schemas.dataset.codec import (
    camera_columns,
    columns_of_bodies,
    contact_columns,
    label_columns,
    read_camera,
    read_label,
    read_world_poses,
)
from schemas.dataset.tables import SCHEMAS
from schemas.scene.scene import ContactForce
from schemas.scene.view import Camera, Intrinsics, ObjectLabel

T = np.arange(16.0).reshape(4, 4) / 7.0
BODY = {
    "region_id": 3,
    "category": "mug",
    "instance_id": "m1",
    "source": "procedural",
    "object_scale": 1.0,
    "T_world_obj": T.ravel().tolist(),
    "redraws": 2,
    "penetration_mm": 0.1,
    "hover_gap_mm": 0.2,
    "support_margin_mm": 9.0,
    "residual_speed_mm_s": 0.3,
    "recheck_move_mm": None,
    "recheck_turn_deg": None,
    "equilibrium_residual": 0.0,
    "mass_kg": 0.4,
    "com": [0.0, 0.1, 0.8],
    "contacts": [{"with_region": 2, "point": [0.0, 0.1, 0.7], "normal": [0.0, 0.0, 1.0], "force": [0.0, 0.0, 3.924]}],
}
OF_A_BODY = {"region_id", "mass_kg", "com", "contacts"}
"""What is said of bodies alone."""


def test_a_camera_comes_back_from_its_row():
    camera = Camera(Intrinsics(width=640, height=480, fx=525.0, fy=524.0, cx=320.0, cy=240.0), T)
    row = camera_columns(camera)
    assert row.keys() <= set(SCHEMAS["views"].names)
    assert (row["cx"] - row["cx_opencv"], row["cy"] - row["cy_opencv"]) == (0.5, 0.5)
    back = read_camera(row)
    assert back.intrinsics == camera.intrinsics and np.array_equal(back.T_world_cam, T)
    assert not back.T_world_cam.flags.writeable


def test_a_label_comes_back_from_its_row():
    label = ObjectLabel(3, "mug", "m1", T, 12, 34, (1, 2, 3, 4), 5, 0.25)
    row = label_columns(label)
    assert row.keys() <= set(SCHEMAS["objects"].names)
    back = read_label(row)
    for field in dataclasses.fields(ObjectLabel):
        assert np.array_equal(getattr(back, field.name), getattr(label, field.name))


def test_a_contact_comes_into_its_row():
    contact = ContactForce(2, np.array([0.0, 0.1, 0.7]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 3.924]))
    assert [contact_columns(contact)] == BODY["contacts"]


def test_a_bodys_columns_are_the_tables():
    names = {field.name for field in SCHEMAS["scenes"].field("bodies").type.value_type}
    assert set(BODY) == names
    assert columns_of_bodies([BODY]).keys() == names - OF_A_BODY
    assert columns_of_bodies([BODY]).keys() <= set(SCHEMAS["scenes"].names)


@pytest.mark.parametrize(
    ("name", "first", "second", "expected"),
    [
        ("penetration_mm", 0.1, 0.5, 0.5),
        ("support_margin_mm", 9.0, 4.0, 4.0),
        ("recheck_move_mm", None, 0.7, 0.7),
        ("recheck_turn_deg", None, None, None),
        ("redraws", 2, 5, 2),
        ("instance_id", "m1", "a0", "m1"),
    ],
)
def test_a_scene_has_its_first_bodys_names_and_its_worst_bodys_figures(name, first, second, expected):
    assert columns_of_bodies([{**BODY, name: first}, {**BODY, "region_id": 4, name: second}])[name] == expected


def test_poses_are_by_region_of_a_scene_and_of_a_capture_which_has_no_bodies():
    table = np.eye(4)
    capture = {"T_world_table": table.ravel().tolist(), "T_world_obj": BODY["T_world_obj"], "bodies": None}
    for row in (capture, {**capture, "bodies": [BODY]}):
        poses = read_world_poses(row)
        assert list(poses) == [2, 3]
        assert np.array_equal(poses[2], table) and np.array_equal(poses[3], T)
