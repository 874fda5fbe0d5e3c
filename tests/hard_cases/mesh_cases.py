"""Rows of the table of hard cases: meshes from outside, through the door and then onto a table."""

from tests.hard_cases import bad_meshes, outside
from tests.hard_cases.case import SETTLE, Case, refuse
from tests.hard_cases.drops import X, Y, drop, level, turn
from tests.hard_cases.measures import both, flat, height, on_a_face, tilt

OUTSIDE = (
    Case("mesh in millimetres", SETTLE, height(0.05, 0.01), lambda: drop(outside.millimetres(), level())),
    Case("mesh 10 km from its origin", SETTLE, height(0.05, 0.01), lambda: drop(outside.far_away(), level())),
    Case("mesh with a mirrored scale", SETTLE, both(tilt(0.1), on_a_face()), lambda: drop(outside.mirrored(), level())),
    Case(
        "flat sheet",
        SETTLE,
        both(flat(0.1), height(0.0, 0.01)),
        lambda: drop(outside.flat_sheet(), level()),
        again="minute",
    ),
    Case(
        "flat sheet dropped at 45 degrees",
        SETTLE,
        both(flat(0.1), height(0.0, 0.01)),
        lambda: drop(outside.flat_sheet(), level(), R=turn(X, 45)),
    ),
    Case("mesh with inverted faces", SETTLE, height(0.05, 0.01), lambda: drop(outside.inverted(), level())),
    Case("mesh with mixed faces", SETTLE, height(0.05, 0.01), lambda: drop(outside.mixed(), level())),
    # Five squares of one surface density, four at half the height and one at the bottom: 4/5 of 50 mm.
    Case("mesh of single-sided walls", SETTLE, height(0.04, 0.01), lambda: drop(outside.open_shell(), level())),
    Case("mesh with a hole in its base", SETTLE, both(tilt(0.1), on_a_face()), lambda: drop(outside.holed(), level())),
    Case(
        "mesh with duplicate and degenerate faces", SETTLE, height(0.05, 0.01), lambda: drop(outside.doubled(), level())
    ),
    Case("mesh with coplanar faces", SETTLE, height(0.05, 0.01), lambda: drop(outside.coplanar(), level())),
    Case("mesh with a transparent picture", SETTLE, height(0.05, 0.01), lambda: drop(outside.see_through(), level())),
    Case("mesh with a NaN", refuse("not_finite"), None, lambda: drop(outside.not_a_number(), level())),
    # Whatever such a mesh encloses, it is even about the upright axis through its middle, and as high as wide.
    Case(
        "two cubes that share an edge", SETTLE, height(0.05, 0.01), lambda: drop(bad_meshes.sharing_an_edge(), level())
    ),
    Case(
        "two cubes and the wall between them",
        SETTLE,
        height(0.05, 0.01),
        lambda: drop(bad_meshes.with_inner_wall(), level()),
    ),
    Case("two boxes through one another", SETTLE, height(0.025, 0.01), lambda: drop(bad_meshes.crossing(), level())),
    Case("two cubes, one inside out", SETTLE, height(0.05, 0.01), lambda: drop(bad_meshes.one_inside_out(), level())),
    Case(
        "cube with a cavity inside out",
        SETTLE,
        height(0.05, 0.01),
        lambda: drop(bad_meshes.cavity_inside_out(), level()),
    ),
    # Let go on its base: the sheet is in the middle of the top.
    Case(
        "cube with a fin of one sheet",
        SETTLE,
        both(tilt(0.1), on_a_face()),
        lambda: drop(bad_meshes.with_fin(), level()),
    ),
    # It stands on four corners, two of each cube, or on a side of one whose corner its centre of mass is over.
    Case(
        "two cubes that share a corner",
        SETTLE,
        on_a_face(),
        lambda: drop(bad_meshes.sharing_a_corner(), level(), R=turn(X, 20) @ turn(Y, 10)),
    ),
    Case("band with half a twist", SETTLE, on_a_face(), lambda: drop(bad_meshes.moebius(), level())),
)
