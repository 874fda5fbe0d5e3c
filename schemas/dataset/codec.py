"""Columns of the manifest tables from the models of a scene, and the models back from a row."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.scene.scene import ContactForce, ObjectStart, Settled
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_TABLE
from schemas.scene.view import Camera, Intrinsics, ObjectLabel

Row = dict[str, Any]

LARGEST = (
    *("penetration_mm", "hover_gap_mm", "residual_speed_mm_s", "equilibrium_residual"),
    *("recheck_move_mm", "recheck_turn_deg"),
)
"""Columns of `scenes` that are the largest of its bodies'; a body that was not released again has no recheck."""
SMALLEST = ("support_margin_mm",)
FIRST = ("category", "instance_id", "source", "object_scale", "T_world_obj", "redraws")
"""Columns of `scenes` that are those of its first body."""

_LABEL = ("region_id", "category", "instance_id", "u", "v", "pixels", "visible_fraction")


def matrix_column(T: Pose) -> list[float]:
    """16 doubles, row-major."""
    values: list[float] = T.ravel().tolist()
    return values


def read_matrix(values: Sequence[float]) -> Pose:
    """[4, 4] float64, read-only."""
    return frozen_array(np.reshape(values, (4, 4)))


def camera_columns(camera: Camera) -> Row:
    """The pose and the intrinsics of a camera, the principal point in both pixel conventions."""
    k = camera.intrinsics
    both = {**dict(k), "cx_opencv": k.cx_opencv, "cy_opencv": k.cy_opencv}
    return {"T_world_cam": matrix_column(camera.T_world_cam), **both}


def read_camera(row: Mapping[str, Any]) -> Camera:
    """The camera of a row of `views`."""
    return Camera(Intrinsics(**{name: row[name] for name in Intrinsics.model_fields}), read_matrix(row["T_world_cam"]))


def label_columns(label: ObjectLabel) -> Row:
    """The columns of `objects` that a label holds."""
    plain = {name: getattr(label, name) for name in _LABEL}
    return {**plain, "T_cam_obj": matrix_column(label.T_cam_obj), "bbox_xywh": list(label.bbox_xywh)}


def read_label(row: Mapping[str, Any]) -> ObjectLabel:
    """The label of a row of `objects`."""
    plain = {name: row[name] for name in _LABEL}
    return ObjectLabel(**plain, T_cam_obj=read_matrix(row["T_cam_obj"]), bbox_xywh=tuple(row["bbox_xywh"]))


def body_columns(start: ObjectStart, rest: Settled, friction: float | None) -> Row:
    """One object of a scene: an item of `scenes.bodies`. friction: its coefficient, None where all have the same."""
    return {
        "region_id": start.region_id,
        "category": start.asset.category,
        "instance_id": start.asset.instance_id,
        "source": start.asset.source,
        "object_scale": start.asset.scale,
        "T_world_obj": matrix_column(rest.T_world_obj),
        "redraws": start.redraws,
        **{name: _known(getattr(rest, name)) for name in (*LARGEST, *SMALLEST)},
        "mass_kg": start.asset.mass.mass_kg,
        "friction": friction,
        "com": (rest.T_world_obj[:3, :3] @ start.asset.mass.com + rest.T_world_obj[:3, 3]).tolist(),
        "contacts": [contact_columns(contact) for contact in rest.contacts],
    }


def _known(figure: float | None) -> float | None:
    """None for nan: a figure of rest that an object does not have which nothing carries."""
    return None if figure is None or math.isnan(figure) else figure


def contact_columns(contact: ContactForce) -> Row:
    """One contact of an object: an item of `scenes.bodies.contacts`."""
    vectors = {"point": contact.point, "normal": contact.normal, "force": contact.force}
    return {"with_region": contact.with_region, **{name: vector.tolist() for name, vector in vectors.items()}}


def columns_of_bodies(bodies: Sequence[Mapping[str, Any]]) -> Row:
    """The columns of `scenes` that follow from its bodies: those of the first, and of the figures the worst of all."""
    known = {name: [body[name] for body in bodies if body[name] is not None] for name in (*LARGEST, *SMALLEST)}
    return {
        **{name: bodies[0][name] for name in FIRST},
        **{name: max(known[name], default=None) for name in LARGEST},
        **{name: min(known[name], default=None) for name in SMALLEST},
    }


def read_world_poses(scene: Mapping[str, Any]) -> dict[int, Pose]:
    """[4, 4] pose of the table and of every object in the world, by region id in order; a capture has one object.

    There is no table in a studio scene.
    """
    bodies = scene["bodies"] or [{"region_id": REGION_FIRST_OBJECT, "T_world_obj": scene["T_world_obj"]}]
    objects = {body["region_id"]: read_matrix(body["T_world_obj"]) for body in bodies}
    table = {} if scene["T_world_table"] is None else {REGION_TABLE: read_matrix(scene["T_world_table"])}
    return table | objects
