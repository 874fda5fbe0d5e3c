"""What is measured of several objects at rest: from their meshes and poses, not from the simulator."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.scene.scene import Settled
from tests.hard_cases.groups import Group
from workers.geometry.frames import transform
from workers.physics.separation import Form, find_gaps_m


@dataclass(frozen=True)
class GroupMeasure:
    """A figure with its unit and the most that it may be."""

    what: str
    bound: float
    of: Callable[[Group, Sequence[Settled]], float]


def worst_gap_mm(group: Group, rest: Sequence[Settled]) -> float:
    """The most by which any object overlaps or hovers over the table and the others."""
    forms = [*(Form(start.asset.shape.mesh) for start in group.starts), Form(group.table.mesh)]
    return max(map(abs, find_gaps_m(forms, [*(each.T_world_obj for each in rest), np.eye(4)])[:-1])) * 1e3


def gaps(bound_mm: float = 0.1) -> GroupMeasure:
    """Penetration or gap between the meshes."""
    return GroupMeasure("worst penetration or gap, mm", bound_mm, worst_gap_mm)


def coms(group: Group, rest: Sequence[Settled]) -> Array:
    """[N, 3] metres: the centres of mass, z from the table's top."""
    found = [
        transform(each.T_world_obj, start.asset.mass.com[None, :])[0]
        for start, each in zip(group.starts, rest, strict=True)
    ]
    return np.array(found) - [0.0, 0.0, group.table.top.height_m]


def heights(*expected_m: float, bound_mm: float = 0.1) -> GroupMeasure:
    """How far each centre of mass is from the height above the table's top at which it must be: the worst."""

    def off(group: Group, rest: Sequence[Settled]) -> float:
        return float(np.abs(coms(group, rest)[:, 2] - expected_m).max()) * 1e3

    return GroupMeasure("worst height off what it must be, mm", bound_mm, off)


def _tilts_deg(rest: Sequence[Settled]) -> list[float]:
    return [math.degrees(math.acos(float(np.clip(each.T_world_obj[2, 2], -1.0, 1.0)))) for each in rest]


def tilts(*expected_deg: float, bound_deg: float) -> GroupMeasure:
    """Between the angle of each object's z axis to the vertical and what it must be: the worst."""

    def off(_: Group, rest: Sequence[Settled]) -> float:
        return max(abs(found - wanted) for found, wanted in zip(_tilts_deg(rest), expected_deg, strict=True))

    return GroupMeasure("worst tilt off what it must be, deg", bound_deg, off)


def apart(bound_mm: float) -> GroupMeasure:
    """How far the farthest went sideways from where it was let go."""

    def farthest(group: Group, rest: Sequence[Settled]) -> float:
        middles = [transform(start.T_world_obj, start.asset.mass.com[None, :])[0] for start in group.starts]
        return float(np.linalg.norm((coms(group, rest) - middles)[:, :2], axis=1).max()) * 1e3

    return GroupMeasure("farthest sideways from the start, mm", bound_mm, farthest)
