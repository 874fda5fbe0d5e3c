"""Rows of the table of hard cases: what rolls, and what spins when it is let go.

Rolling friction of r metres on each body holds back with an arm of 2 r times the friction of a body: 0.7 mm by default.
"""

import math

import trimesh

from schemas.scene.shape import Asset
from tests.hard_cases.bodies import ball, built_in, cube, globe, rod
from tests.hard_cases.case import EITHER, UNDEFINED, Case, falls, settles
from tests.hard_cases.drops import EDGE_M, X, drop, level, slope, turn
from tests.hard_cases.measures import Z, both, height, on_a_face, shift, tilt
from tests.kit.shapes import asset_of, box

SMOOTH = {"friction": 0.0, "rolling_friction": 0.0, "spinning_friction": 0.0}
NO_ROLLING = {"rolling_friction": 0.0}

HALF_SIDE_MM = 33.0 * math.sin(math.pi / 48)
"""Of a can of 48 sides: as far as its axis goes from over a ridge to over a side. Each side that it rolls over costs the arm
of 0.7 mm times 7.5 degrees, 92 micrometres of height, and a ridge is 71 high: it stays on the side onto which it tips."""

ROLLING = (
    settles("can lying", on_a_face(), lambda: drop(built_in("can"), level(), R=turn(X, 90) @ turn(Z, 1))),
    settles(
        "can balanced on a ridge between two of its sides",
        both(on_a_face(), shift(HALF_SIDE_MM + 0.5)),
        lambda: drop(rod(0.033, 0.12), level(), R=turn(X, 90)),
    ),
    settles(
        "can lying, axis 5 mm inside the edge",
        both(on_a_face(), shift(HALF_SIDE_MM + 0.5)),
        lambda: drop(rod(0.033, 0.12), level(), 0.001, turn(X, 90), (EDGE_M - 0.005, 0.0)),
    ),
    falls(
        "can lying, axis 2 mm outside the edge",
        lambda: drop(rod(0.033, 0.12), level(), 0.001, turn(X, 90), (EDGE_M + 0.002, 0.0)),
    ),
    # Gravity's arm is 33 mm times sin 2 degrees, 1.15 mm, and at the least 0.86 where it begins, on a side: more than 0.7.
    # It goes 0.4 m with 0.09 m/s^2, in 3 s.
    falls(
        "can of 360 sides rolls off a slope of 2 degrees",
        lambda: drop(rod(0.033, 0.12, 360), slope(2.0), 0.001, turn(X, 90), (0.3, 0.0)),
        tier="minute",
    ),
    # The drop leaves it over a corner, which is 32 micrometres above a face and 24 above an edge. Rolling friction stops it
    # within 1 mm; 20 are for where the landing may send it.
    settles(
        "ball on a level, friction", both(on_a_face(), shift(20.0)), lambda: drop(ball(0.04), level()), again="minute"
    ),
    # No force acts sideways. It rocks, and loses 0.6 % of that at each face.
    settles(
        "ball on a level, no friction",
        both(on_a_face(), shift(0.1)),
        lambda: drop(ball(0.04), level()),
        SMOOTH,
        again="minute",
    ),
    # Without rolling friction a ball of 5,120 faces that leaves a corner keeps more than it needs for an edge over a
    # thousand faces, at 0.13 % a face: it may still roll after 20 s. Whatever has stopped has stopped on a face.
    Case(
        "ball on a level, rolling friction 0",
        UNDEFINED,
        on_a_face(),
        lambda: drop(ball(0.04), level()),
        NO_ROLLING,
        tier="minute",
    ),
    # Its meridians are 1 degree apart: it stands on none of them on a slope over half a degree. It goes 0.15 m in 1.6 s.
    falls(
        "ball on a slope of 1 degree, friction",
        lambda: drop(globe(0.04), slope(1.0), 0.001, turn(X, 90), (0.55, 0.0)),
        NO_ROLLING,
        tier="minute",
    ),
    # It slides: 0.3 m with 0.17 m/s^2.
    falls(
        "ball on a slope of 1 degree, no friction",
        lambda: drop(ball(0.04), slope(1.0), 0.001, xy=(0.4, 0.0)),
        SMOOTH,
        tier="minute",
    ),
    settles(
        "ball on a slope of 1 degree, rolling friction of 5 mm",
        shift(20.0),
        lambda: drop(ball(0.04), slope(1.0), 0.001),
        {"rolling_friction": 0.005},
        tier="minute",
    ),
)


def egg() -> Asset:
    """A ball of 642 corners, a fifth longer than wide, lying."""
    shape = trimesh.creation.icosphere(subdivisions=3, radius=0.025)
    shape.apply_scale((1.2, 1.0, 1.0))
    return asset_of(shape)


SPINS = (
    settles(
        "cube spun at 50 rad/s on a level",
        both(tilt(0.1), height(0.05, 0.01)),
        lambda: drop(cube(), level()),
        spin=(0.0, 0.0, 50.0),
    ),
    settles(
        "cube spun at 200 rad/s on a level",
        both(tilt(0.1), height(0.05, 0.01)),
        lambda: drop(cube(), level()),
        spin=(0.0, 0.0, 200.0),
    ),
    settles(
        "can spun upright at 50 rad/s",
        both(tilt(0.1), height(0.06, 0.01)),
        lambda: drop(rod(0.033, 0.12), level()),
        spin=(0.0, 0.0, 50.0),
    ),
    # Nothing slows either: the contact has no friction, or is on the axis of the spin. Production takes the turn that it has.
    settles(
        "cube spun at 5 rad/s without friction",
        both(tilt(0.1), height(0.05, 0.01)),
        lambda: drop(cube(), level()),
        SMOOTH,
        spin=(0.0, 0.0, 5.0),
    ),
    settles(
        "egg spun at 1 rad/s, spinning friction 0",
        on_a_face(),
        lambda: drop(egg(), level(), 0.0002),
        {"spinning_friction": 0.0},
        spin=(0.0, 0.0, 1.0),
    ),
    settles(
        "can spun lying at 50 rad/s",
        on_a_face(),
        lambda: drop(rod(0.033, 0.12), level(), R=turn(X, 90)),
        spin=(0.0, 0.0, 50.0),
    ),
    # It slides until it rolls, at a third of 50 rad/s times 33 mm: rolling friction would stop it after 1.1 m.
    falls(
        "can of 360 sides spun about its axis at 50 rad/s",
        lambda: drop(rod(0.033, 0.12, 360), level(), R=turn(X, 90), xy=(0.4, 0.0)),
        spin=(0.0, 50.0, 0.0),
        again="minute",
    ),
    Case(
        "coin spun on its edge at 50 rad/s",
        EITHER,
        on_a_face(),
        lambda: drop(rod(0.012, 0.002), level(), 0.0002, turn(X, 85)),
        spin=(0.0, 0.0, 50.0),
    ),
    Case(
        "box tumbling at 50 rad/s",
        EITHER,
        on_a_face(),
        lambda: drop(asset_of(box(0.1, 0.08, 0.2)), level()),
        spin=(30, 40, 0),
    ),
    Case(
        "can tumbling at 200 rad/s",
        EITHER,
        on_a_face(),
        lambda: drop(built_in("can"), level(), 0.1, turn(X, 30)),
        spin=(160.0, 0.0, 120.0),
        again="minute",
    ),
    # A solid cone 30 mm wide and high sleeps on its tip above 90 rad/s: 2 sqrt(m g l I) / I3. The arm of 0.7 mm slows it by
    # 26 rad/s^2, and below that it falls over and lies.
    settles(
        "top spun at 150 rad/s on its tip, 1 degree aside",
        on_a_face(),
        lambda: drop(asset_of(trimesh.creation.cone(0.03, 0.03, sections=64)), level(), 0.0002, turn(X, 181)),
        spin=(0.0, 0.0, 150.0),
        tier="minute",
    ),
)
