"""Rows of the table of hard cases: what is thin, small or large."""

import math

from schemas.scene.shape import Asset
from tests.hard_cases.bodies import cube, rod
from tests.hard_cases.case import settles
from tests.hard_cases.drops import X, drop, level, turn
from tests.hard_cases.measures import Measure, both, flat, height, leaning, shift, tilt
from tests.kit.shapes import asset_of, box


def plate(thick_m: float = 0.0005, side_m: float = 0.2) -> Asset:
    return asset_of(box(side_m, side_m, thick_m))


def needle_height_m(radius_m: float, sections: int = 48) -> float:
    """Height of the axis of a prism of so many sides that lies on one of them: its inner radius."""
    return radius_m * math.cos(math.pi / sections)


def lying(radius_m: float) -> Measure:
    """On one of its sides: the axis level, at its inner radius."""
    return both(leaning(lambda: 90.0, 0.1), height(needle_height_m(radius_m), 0.01))


THIN = (
    settles("cube on a top 1 mm thick", height(0.05, 0.01), lambda: drop(cube(), level(0.001), 0.03)),
    settles("thin plate dropped flat", both(flat(0.1), height(0.00025, 0.01)), lambda: drop(plate(), level())),
    settles(
        "thin plate dropped at 45 degrees",
        both(flat(0.1), height(0.00025, 0.01)),
        lambda: drop(plate(), level(), R=turn(X, 45)),
    ),
    # A free body that is let go flat stays flat; let go leaning, it has no other face to stand on than its two large ones.
    settles(
        "foil of 0.1 mm dropped flat", both(flat(0.1), height(0.00005, 0.01)), lambda: drop(plate(1e-4, 0.1), level())
    ),
    settles(
        "foil of 0.1 mm dropped at 30 degrees",
        both(flat(0.1), height(0.00005, 0.01)),
        lambda: drop(plate(1e-4, 0.1), level(), R=turn(X, 30)),
    ),
    settles("needle dropped lying", lying(0.0005), lambda: drop(rod(0.0005, 0.06), level(), R=turn(X, 90))),
    settles("needle dropped at 60 degrees", lying(0.0005), lambda: drop(rod(0.0005, 0.06), level(), R=turn(X, 60))),
    # Its side facets are 13 micrometres wide. It may roll a little; it can lie on nothing but one of them.
    settles(
        "needle of 0.2 by 200 mm dropped lying", lying(0.0001), lambda: drop(rod(0.0001, 0.2), level(), R=turn(X, 90))
    ),
    settles(
        "needle of 0.2 by 200 mm dropped at 60 degrees",
        lying(0.0001),
        lambda: drop(rod(0.0001, 0.2), level(), R=turn(X, 60)),
        again="minute",
    ),
)

SMALL_AND_LARGE = (
    settles("cube of 5 mm", both(tilt(0.1), height(0.0025, 0.01)), lambda: drop(cube(0.005), level(), 0.02)),
    settles("cube of 5 mm from 1 m on a top 1 mm thick", tilt(0.1), lambda: drop(cube(0.005), level(0.001), 1.0)),
    # It lands on a whole face with its centre over the middle: the impulse has no arm, and it neither turns nor goes aside.
    settles(
        "cube of 2 mm from 1 m",
        both(tilt(0.1), height(0.001, 0.01), shift(0.1)),
        lambda: drop(cube(0.002), level(), 1.0),
    ),
    # Beyond 45 degrees it would fall onto another face; at 20 it falls back, and its mass does not matter.
    settles(
        "cube of 1 m let go on an edge at 20 degrees",
        both(tilt(0.01), height(0.5, 0.01)),
        lambda: drop(cube(1.0), level(), R=turn(X, 20)),
    ),
)
