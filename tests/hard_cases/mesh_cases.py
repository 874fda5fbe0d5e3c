"""Rows of the table of hard cases: meshes from outside, through the door and then onto a table."""

from tests.hard_cases import outside
from tests.hard_cases.case import SETTLE, Case, refuse
from tests.hard_cases.drops import X, drop, level, turn
from tests.hard_cases.measures import flat, gap, height, tilt

OUTSIDE = (
    Case("mesh in millimetres", SETTLE, height(0.05, 0.1), lambda: drop(outside.millimetres(), level())),
    Case("mesh 10 km from its origin", SETTLE, height(0.05, 0.1), lambda: drop(outside.far_away(), level())),
    Case("mesh with a mirrored scale", SETTLE, tilt(0.1), lambda: drop(outside.mirrored(), level())),
    Case("flat sheet", SETTLE, flat(0.1), lambda: drop(outside.flat_sheet(), level())),
    Case(
        "flat sheet dropped at 45 degrees",
        SETTLE,
        flat(0.1),
        lambda: drop(outside.flat_sheet(), level(), R=turn(X, 45)),
    ),
    Case("mesh with inverted faces", SETTLE, height(0.05, 0.1), lambda: drop(outside.inverted(), level())),
    Case("mesh with mixed faces", SETTLE, height(0.05, 0.1), lambda: drop(outside.mixed(), level())),
    # Five squares of one surface density, four at half the height and one at the bottom: 4/5 of 50 mm.
    Case("mesh of single-sided walls", SETTLE, height(0.04, 0.1), lambda: drop(outside.open_shell(), level())),
    Case("mesh with a hole in its base", SETTLE, tilt(0.1), lambda: drop(outside.holed(), level())),
    Case(
        "mesh with duplicate and degenerate faces", SETTLE, height(0.05, 0.1), lambda: drop(outside.doubled(), level())
    ),
    Case("mesh with coplanar faces", SETTLE, height(0.05, 0.1), lambda: drop(outside.coplanar(), level())),
    Case("mesh with a transparent picture", SETTLE, height(0.05, 0.1), lambda: drop(outside.see_through(), level())),
    Case("mesh with a NaN", refuse("not_finite"), gap(), lambda: drop(outside.not_a_number(), level())),
)
