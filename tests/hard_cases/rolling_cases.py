"""Rows of the table of hard cases: what rolls, and what spins when it is let go."""

from tests.hard_cases.bodies import ball, built_in, cube, globe, rod
from tests.hard_cases.case import EITHER, FALL, SETTLE, Case
from tests.hard_cases.drops import EDGE_M, X, drop, level, slope, turn
from tests.hard_cases.measures import Z, gap, shift, tilt
from tests.shapes import asset_of, box

SMOOTH = {"friction": 0.0, "rolling_friction": 0.0, "spinning_friction": 0.0}
NO_ROLLING = {"rolling_friction": 0.0}

ROLLING = (
    Case("can lying", SETTLE, gap(), lambda: drop(built_in("can"), level(), R=turn(X, 90) @ turn(Z, 1))),
    Case(
        "can balanced on a ridge between two of its sides",
        SETTLE,
        gap(),
        lambda: drop(rod(0.033, 0.12), level(), R=turn(X, 90)),
    ),
    Case(
        "can lying, axis 5 mm inside the edge",
        SETTLE,
        gap(),
        lambda: drop(rod(0.033, 0.12), level(), 0.001, turn(X, 90), (EDGE_M - 0.005, 0.0)),
    ),
    Case(
        "can lying, axis 2 mm outside the edge",
        FALL,
        gap(),
        lambda: drop(rod(0.033, 0.12), level(), 0.001, turn(X, 90), (EDGE_M + 0.002, 0.0)),
    ),
    Case(
        "can of 360 sides rolls off a slope of 2 degrees",
        FALL,
        gap(),
        lambda: drop(rod(0.033, 0.12, 360), slope(2.0), 0.001, turn(X, 90), (0.6, 0.0)),
    ),
    Case("ball on a level, friction", SETTLE, shift(20.0), lambda: drop(ball(0.04, 3), level())),
    Case("ball on a level, no friction", SETTLE, shift(1.0), lambda: drop(ball(0.04), level()), SMOOTH),
    Case(
        "ball on a slope of 1 degree, friction",
        FALL,
        gap(),
        lambda: drop(globe(0.04), slope(1.0), 0.001, turn(X, 90), (0.64, 0.0)),
        NO_ROLLING,
    ),
    Case(
        "ball on a slope of 1 degree, no friction",
        FALL,
        gap(),
        lambda: drop(ball(0.04, 3), slope(1.0), 0.001, xy=(0.64, 0.0)),
        SMOOTH,
    ),
    Case(
        "ball on a slope of 1 degree, rolling friction of 5 mm",
        SETTLE,
        shift(20.0),
        lambda: drop(ball(0.04, 3), slope(1.0), 0.001),
        {"rolling_friction": 0.005},
    ),
)

SPINS = (
    Case("cube spun at 50 rad/s on a level", SETTLE, tilt(0.1), lambda: drop(cube(), level()), spin=(0.0, 0.0, 50.0)),
    Case("cube spun at 200 rad/s on a level", SETTLE, tilt(0.1), lambda: drop(cube(), level()), spin=(0.0, 0.0, 200.0)),
    *(
        Case(
            f"can spun upright at {rad_s:g} rad/s",
            SETTLE,
            tilt(0.1),
            lambda: drop(rod(0.033, 0.12), level()),
            spin=(0.0, 0.0, rad_s),
        )
        for rad_s in (50.0, 200.0)
    ),
    Case(
        "can spun lying at 50 rad/s",
        SETTLE,
        gap(),
        lambda: drop(rod(0.033, 0.12), level(), R=turn(X, 90)),
        spin=(0.0, 0.0, 50.0),
    ),
    # It slides until it rolls, at a third of 50 rad/s times 33 mm: rolling friction would stop it after 1.1 m.
    Case(
        "can of 360 sides spun about its axis at 50 rad/s",
        FALL,
        gap(),
        lambda: drop(rod(0.033, 0.12, 360), level(), R=turn(X, 90), xy=(0.4, 0.0)),
        spin=(0.0, 50.0, 0.0),
    ),
    Case(
        "coin spun on its edge at 50 rad/s",
        EITHER,
        gap(),
        lambda: drop(rod(0.012, 0.002), level(), 0.0002, turn(X, 85)),
        spin=(0.0, 0.0, 50.0),
    ),
    Case(
        "box tumbling at 50 rad/s",
        EITHER,
        gap(),
        lambda: drop(asset_of(box(0.1, 0.08, 0.2)), level()),
        spin=(30, 40, 0),
    ),
    Case(
        "can tumbling at 200 rad/s",
        EITHER,
        gap(),
        lambda: drop(built_in("can"), level(), 0.1, turn(X, 30)),
        spin=(160.0, 0.0, 120.0),
    ),
)
