"""Rows of the table of hard cases: meshes from outside, through the door and then onto a table."""

from tests.hard_cases import bad_meshes, outside
from tests.hard_cases.case import Case, refuse, settles
from tests.hard_cases.drops import X, Y, drop, level, turn
from tests.hard_cases.measures import both, flat, height, on_a_face, tilt

OUTSIDE = (
    settles("mesh in millimetres", height(0.05, 0.01), lambda: drop(outside.millimetres(), level())),
    settles("mesh 10 km from its origin", height(0.05, 0.01), lambda: drop(outside.far_away(), level())),
    settles("mesh with a mirrored scale", both(tilt(0.1), on_a_face()), lambda: drop(outside.mirrored(), level())),
    settles(
        "flat sheet", both(flat(0.1), height(0.0, 0.01)), lambda: drop(outside.flat_sheet(), level()), again="minute"
    ),
    settles(
        "flat sheet dropped at 45 degrees",
        both(flat(0.1), height(0.0, 0.01)),
        lambda: drop(outside.flat_sheet(), level(), R=turn(X, 45)),
    ),
    settles("mesh with inverted faces", height(0.05, 0.01), lambda: drop(outside.inverted(), level())),
    settles("mesh with mixed faces", height(0.05, 0.01), lambda: drop(outside.mixed(), level())),
    # Five squares of one surface density, four at half the height and one at the bottom: 4/5 of 50 mm.
    settles("mesh of single-sided walls", height(0.04, 0.01), lambda: drop(outside.open_shell(), level())),
    settles("mesh with a hole in its base", both(tilt(0.1), on_a_face()), lambda: drop(outside.holed(), level())),
    settles("mesh with duplicate and degenerate faces", height(0.05, 0.01), lambda: drop(outside.doubled(), level())),
    settles("mesh with coplanar faces", height(0.05, 0.01), lambda: drop(outside.coplanar(), level())),
    settles("mesh with a transparent picture", height(0.05, 0.01), lambda: drop(outside.see_through(), level())),
    Case("mesh with a NaN", refuse("not_finite"), None, lambda: drop(outside.not_a_number(), level())),
    # Whatever such a mesh encloses, it is even about the upright axis through its middle, and as high as wide.
    settles("two cubes that share an edge", height(0.05, 0.01), lambda: drop(bad_meshes.sharing_an_edge(), level())),
    settles(
        "two cubes and the wall between them", height(0.05, 0.01), lambda: drop(bad_meshes.with_inner_wall(), level())
    ),
    settles("two boxes through one another", height(0.025, 0.01), lambda: drop(bad_meshes.crossing(), level())),
    settles("two cubes, one inside out", height(0.05, 0.01), lambda: drop(bad_meshes.one_inside_out(), level())),
    settles("cube with a cavity inside out", height(0.05, 0.01), lambda: drop(bad_meshes.cavity_inside_out(), level())),
    # Let go on its base: the sheet is in the middle of the top.
    settles("cube with a fin of one sheet", both(tilt(0.1), on_a_face()), lambda: drop(bad_meshes.with_fin(), level())),
    # It stands on four corners, two of each cube, or on a side of one whose corner its centre of mass is over.
    settles(
        "two cubes that share a corner",
        on_a_face(),
        lambda: drop(bad_meshes.sharing_a_corner(), level(), R=turn(X, 20) @ turn(Y, 10)),
    ),
    settles("band with half a twist", on_a_face(), lambda: drop(bad_meshes.moebius(), level())),
)
