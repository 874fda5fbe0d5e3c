"""Rows of the table of hard cases: what falls from high, lies on its side, or may tip over."""

import math
from functools import partial

import trimesh

from schemas.scene.shape import Asset
from tests.hard_cases.bodies import built_in, cube, laptop_angles, laptop_leaning, rod
from tests.hard_cases.case import EITHER, Case, settles
from tests.hard_cases.drops import X, Y, drop, level, ring, turn
from tests.hard_cases.measures import Z, both, flat, height, leaning, on_a_face, shift, tilt
from tests.kit.shapes import asset_of

HIGH = (
    settles("cube from 1 m", both(tilt(0.1), shift(0.1)), lambda: drop(cube(), level(), 1.0)),
    settles("cube from 5 m", both(tilt(0.1), shift(0.1)), lambda: drop(cube(), level(), 5.0)),
    settles(
        "tumbled mug from 1 m", on_a_face(), lambda: drop(built_in("mug"), level(), 1.0, turn(X, 130) @ turn(Y, 40))
    ),
    settles("cube from 1 m on a ring", tilt(0.1), lambda: drop(cube(), ring(), 1.0, xy=(0.45, 0.0))),
    settles("cube from 5 m on a ring", tilt(0.1), lambda: drop(cube(), ring(), 5.0, xy=(0.45, 0.0))),
)

VESSELS = tuple(
    settles(f"{category} {way}", measure, partial(lambda c, R: drop(built_in(c), level(), R=R), category, R))
    for category in ("mug", "bowl", "jar")
    for way, measure, R in (
        ("upside down", leaning(lambda: 180.0, 0.1), turn(X, 180)),
        ("on its side", on_a_face(), turn(X, 90)),
    )
)

CONE_M = (0.03, 0.06)
"""Radius and height."""

CONE_SECTIONS = 64


def cone() -> Asset:
    """A cone of 64 sides, its apex at +z, its base at z = 0."""
    return asset_of(trimesh.creation.cone(*CONE_M, sections=CONE_SECTIONS))


def cone_lies_deg() -> float:
    """Between a cone's axis and the vertical where it lies on one of its sides.

    It falls about its tip, and when its base's rim strikes the ground its angular momentum about the point that is struck
    would press the tip down: the impact stops it, and it never gets up onto its base.
    """
    inner_m = CONE_M[0] * math.cos(math.pi / CONE_SECTIONS)
    return 90.0 + math.degrees(math.atan2(inner_m, CONE_M[1]))


TIPPING = (
    settles("open laptop 2 degrees before it tips over", tilt(0.1), lambda: laptop_leaning(-2.0), again="minute"),
    settles(
        "open laptop 2 degrees after it tips over",
        leaning(lambda: laptop_angles()[1], 1.0),
        lambda: laptop_leaning(2.0),
        again="minute",
    ),
    settles("bottle upright", tilt(0.1), lambda: drop(built_in("bottle"), level())),
    settles("tall thin rod upright", tilt(0.1), lambda: drop(rod(0.01, 0.3), level())),
    settles("tall thin rod at 2 of 3.8 degrees", tilt(0.1), lambda: drop(rod(0.01, 0.3), level(), 0.0002, turn(X, 2))),
    settles(
        "tall thin rod at 5 of 3.8 degrees",
        both(leaning(lambda: 90.0, 0.1), height(0.01 * math.cos(math.pi / 48), 0.01)),
        lambda: drop(rod(0.01, 0.3), level(), 0.0002, turn(X, 5) @ turn(Z, 1)),
    ),
    # It stands on one of its 48 sides or lies on one of its two faces.
    Case(
        "coin on its edge", EITHER, on_a_face(), lambda: drop(rod(0.012, 0.002), level(), R=turn(X, 90) @ turn(Z, 3.75))
    ),
    settles(
        "coin leaning 10 of 4.8 degrees",
        both(flat(0.1), height(0.001, 0.01)),
        lambda: drop(rod(0.012, 0.002), level(), 0.0002, turn(X, 80)),
    ),
    settles(
        "cone on its tip, 1 degree aside",
        leaning(cone_lies_deg, 0.1),
        lambda: drop(cone(), level(), 0.0002, turn(X, 181)),
        again="minute",
    ),
    settles("cone on its base", both(tilt(0.1), height(0.015, 0.01)), lambda: drop(cone(), level())),
)
