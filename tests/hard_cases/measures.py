"""What is measured of an object at rest: from its mesh, its pose and the table's mesh, not from the simulator."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.scene.scene import Settled
from tests.hard_cases.drops import Drop
from workers.geometry.frames import transform
from workers.physics.separation import Form, find_gaps_m

Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Measure:
    """A figure with its unit and the most that it may be."""

    what: str
    bound: float
    of: Callable[[Drop, Settled], float]


def gap_mm(case: Drop, rest: Settled) -> float:
    """Penetration or gap, whichever there is."""
    forms = [Form(case.start.asset.shape.mesh), Form(case.table.mesh)]
    return abs(find_gaps_m(forms, [rest.T_world_obj, np.eye(4)])[0]) * 1e3


def gap(bound_mm: float = 0.1) -> Measure:
    """Penetration or gap between the meshes."""
    return Measure("penetration or gap, mm", bound_mm, gap_mm)


def _angle_deg(rest: Settled, axis: Array) -> float:
    return math.degrees(math.acos(float(np.clip((rest.T_world_obj[:3, :3] @ axis)[2], -1.0, 1.0))))


def tilt(bound_deg: float, axis: Array = Z) -> Measure:
    """Between an axis of the object and the vertical."""
    return Measure("tilt from upright, deg", bound_deg, lambda _, rest: _angle_deg(rest, axis))


def flat(bound_deg: float) -> Measure:
    """Between the object's z axis and the vertical, either way up."""
    return Measure("tilt from flat, deg", bound_deg, lambda _, r: min(_angle_deg(r, Z), 180.0 - _angle_deg(r, Z)))


def leaning(expected_deg: Callable[[], float], bound_deg: float, axis: Array = Z) -> Measure:
    """Between the angle of an axis to the vertical and what it must be."""
    return Measure("tilt off what it must be, deg", bound_deg, lambda _, r: abs(_angle_deg(r, axis) - expected_deg()))


def _com(case: Drop, T: Array) -> Array:
    return transform(T, case.start.asset.mass.com[None, :])[0]


def shift(bound_mm: float) -> Measure:
    """How far the centre of mass went sideways."""
    return Measure(
        "sideways from the start, mm",
        bound_mm,
        lambda case, rest: float(
            np.linalg.norm((_com(case, rest.T_world_obj) - _com(case, case.start.T_world_obj))[:2]) * 1e3
        ),
    )


def height(expected_m: float, bound_mm: float) -> Measure:
    """How far the centre of mass is from the height above the table's top at which it must be."""
    return Measure(
        "height off what it must be, mm",
        bound_mm,
        lambda case, rest: abs(_com(case, rest.T_world_obj)[2] - case.table.top.height_m - expected_m) * 1e3,
    )
