"""Rows of the table of hard cases: edges and holes of tables, and what surfaces are set to."""

import math

from tests.hard_cases.bodies import ball, built_in, cube, handle_reach, mug_handle_over_edge, mug_on_peg, over_edge
from tests.hard_cases.case import EITHER, Case, falls, refuse, settles
from tests.hard_cases.drops import (
    EDGE_M,
    X,
    Y,
    drop,
    level,
    lowered,
    ring,
    sheet,
    slope,
    turn,
    with_hole,
    with_raised_ring,
)
from tests.hard_cases.measures import Measure, both, bounces_for, flat, height, leaning, on_a_face, shift, tilt
from tests.hard_cases.rolling_cases import SMOOTH
from tests.hard_cases.thin_cases import plate


def hung_by_its_handle() -> Measure:
    """Height of a mug that hangs by its handle: as far below the peg as its centre of mass is from the handle's inner side.

    That is 67 mm. Friction holds it up to 26 degrees off plumb, on a peg 8 mm wide: 58 mm at the least.
    """
    com, (x, z) = built_in("mug").mass.com, handle_reach()
    arm_m = math.hypot(com[0] - x, com[2] - z)
    return height(-arm_m + 0.0044, 4.6)


EDGES = (
    Case("cube over the edge by 50 %", EITHER, tilt(0.1), lambda: over_edge(0.50)),
    falls("cube over the edge by 51 %", lambda: over_edge(0.51)),
    settles(
        "mug hung by its handle on a peg at the edge", hung_by_its_handle(), mug_on_peg, tier="minute", again="slow"
    ),
    falls("mug with nothing but its handle over the edge", mug_handle_over_edge),
    settles("cube over the edge of a sheet by 40 %", tilt(0.1), lambda: drop(cube(), sheet(), xy=(EDGE_M - 0.01, 0.0))),
)

TABLES = (
    settles("cube bridging a hole of 60 mm", tilt(0.1), lambda: drop(cube(), with_hole(0.06))),
    settles("plate bridging a hole of 195 mm", height(0.00025, 0.01), lambda: drop(plate(), with_hole(0.195))),
    falls("cube of 50 mm over a hole of 60 mm", lambda: drop(cube(0.05), with_hole(0.06))),
    settles("cube on a ring", tilt(0.1), lambda: drop(cube(), ring(), xy=(0.45, 0.0))),
    falls("cube over a ring's hole", lambda: drop(cube(), ring())),
    settles(
        "cube of 150 mm on a raised ring",
        height(0.08, 0.01),
        lambda: drop(cube(0.15), with_raised_ring()),
        again="minute",
    ),
    settles("cube inside a raised ring", height(0.02, 0.01), lambda: drop(cube(0.04), with_raised_ring())),
    settles("cube on a sheet without thickness", tilt(0.1), lambda: drop(cube(), sheet())),
    settles("cube on a slope of 1 degree", leaning(lambda: 1.0, 0.1), lambda: drop(cube(), slope(1.0))),
    settles("cube that begins 10 mm inside the table", tilt(1.0), lambda: lowered(drop(cube(), level(), 0.0), 0.01)),
    Case(
        "cube of 20 mm that begins within the table",
        EITHER,
        on_a_face(),
        lambda: lowered(drop(cube(0.02), level(), 0.0), 0.025),
    ),
)

SURFACES = (
    settles("cube, friction 0", both(tilt(0.1), shift(0.1)), lambda: drop(cube(), level()), SMOOTH),
    settles("cube, friction 2", both(tilt(0.1), shift(0.1)), lambda: drop(cube(), level()), {"friction": 2.0}),
    settles(
        "cube at 30 degrees, friction 2",
        both(flat(0.1), height(0.05, 0.01)),
        lambda: drop(cube(), level(), R=turn(X, 30)),
        {"friction": 2.0},
    ),
    settles(
        "cube on a slope of 2.5 degrees, friction 2",
        shift(1.0),
        lambda: drop(cube(), slope(2.5), 0.0001, turn(Y, 2.5)),
        {"friction": 2.0},
    ),
    falls("cube on a slope of 2.5 degrees, friction 0", lambda: drop(cube(), slope(2.5), xy=(0.4, 0.0)), SMOOTH),
    settles(
        "cube from 100 mm, restitution 0",
        both(tilt(0.1), shift(0.1)),
        lambda: drop(cube(), level(), 0.1),
        {"restitution": 0.0},
    ),
    settles(
        "cube from 100 mm, restitution 0.9",
        both(flat(0.1), height(0.05, 0.01)),
        lambda: drop(cube(), level(), 0.1),
        {"restitution": 0.9},
    ),
    *(
        settles(
            f"ball from 100 mm, restitution {e:g}",
            both(on_a_face(), bounces_for(0.1, e * e)),
            lambda: drop(ball(0.04), level(), 0.1),
            {"restitution": e},
            tier="" if e in (0.3, 0.9) else "minute",
            again="minute",
        )
        for e in (0.3, 0.5, 0.7, 0.9, 0.95, 0.99)
    ),
    settles(
        "cube from 100 mm flat, restitution 0.95",
        both(flat(0.1), bounces_for(0.1, 0.95**2)),
        lambda: drop(cube(), level(), 0.1),
        {"restitution": 0.95},
    ),
    Case(
        "ball from 100 mm, restitution 1",
        refuse("not_at_rest"),
        None,
        lambda: drop(ball(0.04), level(), 0.1),
        {"restitution": 1.0},
    ),
)
