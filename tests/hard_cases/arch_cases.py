"""Rows of the table of hard cases: arches, which stand where a line of thrust fits into them (Heyman 1966, The stone skeleton).

A half-ring of thickness t and mean radius R stands for t / R above about 0.107 (Heyman 1969, Int. J. Mech. Sci. 11); with
few joints for a little less. `thrust_fits` decides it for these joints and this friction, by a linear program.
"""

import math

import numpy as np
from scipy.optimize import linprog

from schemas.base import Array
from tests.hard_cases.case import settles
from tests.hard_cases.drops import level
from tests.hard_cases.groups import Group, place, prism, together
from tests.hard_cases.measures import below, moved

RADIUS_M, WIDTH_M = 0.1, 0.06


def joints(count: int, thick_m: float) -> Array:
    """[count + 1, 2, 2] metres: the inner and outer end of every joint of a half-ring, from +x on."""
    angle = np.linspace(0.0, math.pi, count + 1)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.stack([along * (RADIUS_M - thick_m / 2), along * (RADIUS_M + thick_m / 2)], axis=1)


def arch(count: int, thick_m: float) -> Group:
    """A half-ring of voussoirs that touch one another, on the table."""
    table, ends = level(), joints(count, thick_m)
    outlines = [[ends[k, 0], ends[k, 1], ends[k + 1, 1], ends[k + 1, 0]] for k in range(count)]
    return together(table, [place(prism([tuple(p) for p in one], WIDTH_M), table) for one in outlines])


def thrust_fits(count: int, thick_m: float, friction: float) -> bool:
    """Whether forces at the joints can hold every voussoir up: none pulls, none is out of its friction cone.

    Unknown are the normal forces at both ends of each joint and its shear; three equations for each block.
    """
    ends, rows, right = joints(count, thick_m), [], []
    angle = np.linspace(0.0, math.pi, count + 1)
    for k in range(count):
        corners = np.array([ends[k, 0], ends[k, 1], ends[k + 1, 1], ends[k + 1, 0]])
        area, middle = _area_and_middle(corners)
        block = np.zeros((3, 3 * (count + 1)))
        for joint, sign in ((k, 1.0), (k + 1, -1.0)):
            normal = sign * np.array([-math.sin(angle[joint]), math.cos(angle[joint])])
            shear = sign * np.array([math.cos(angle[joint]), math.sin(angle[joint])])
            for column, force, point in (
                (0, normal, ends[joint, 0]),
                (1, normal, ends[joint, 1]),
                (2, shear, ends[joint, 0]),
            ):
                arm = point - middle
                block[:, 3 * joint + column] = [*force, arm[0] * force[1] - arm[1] * force[0]]
        rows.append(block)
        right.append([0.0, area, 0.0])
    cone = np.zeros((2 * (count + 1), 3 * (count + 1)))
    for joint in range(count + 1):
        cone[2 * joint, 3 * joint : 3 * joint + 3] = [-friction, -friction, 1.0]
        cone[2 * joint + 1, 3 * joint : 3 * joint + 3] = [-friction, -friction, -1.0]
    bounds = [(0.0, None), (0.0, None), (None, None)] * (count + 1)
    found = linprog(
        np.zeros(3 * (count + 1)),
        A_ub=cone,
        b_ub=np.zeros(len(cone)),
        A_eq=np.concatenate(rows),
        b_eq=np.concatenate(right),
        bounds=bounds,
    )
    return bool(found.status == 0)


def _area_and_middle(corners: Array) -> tuple[float, Array]:
    after = np.roll(corners, -1, axis=0)
    twice = corners[:, 0] * after[:, 1] - after[:, 0] * corners[:, 1]
    return float(twice.sum()) / 2.0, ((corners + after) * twice[:, None]).sum(axis=0) / (3.0 * twice.sum())


THICK_M, THIN_M = 0.035, 0.006

ARCHES = (
    settles("arch of seven, thick", moved(1.0), lambda: arch(7, THICK_M), tier="minute"),
    settles("arch of seven, too thin for its thrust", below(0.05, 3), lambda: arch(7, THIN_M), tier="minute"),
)
