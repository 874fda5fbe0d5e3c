"""What ends a simulation before rest."""

import math

import numpy as np

from workers.geometry.frames import quaternion_from_rotation
from workers.physics.stop_conditions import (
    falls_below,
    leaves_outline,
    leaves_room,
)


def at(x: float, y: float, R=None):
    return (x, y, 0.0), tuple(quaternion_from_rotation(np.eye(3) if R is None else R))


def test_an_edge_is_near_where_the_nearest_one_is_within_reach():
    outline = np.array([[-0.5, -0.3], [0.9, -0.3], [0.9, 0.3], [-0.5, 0.3]])
    near = leaves_outline(outline, 0.1)
    rng = np.random.default_rng(0)
    for x, y in rng.uniform([-0.6, -0.4], [1.0, 0.4], (500, 2)):
        assert near(at(x, y)) == (min(x + 0.5, 0.9 - x, y + 0.3, 0.3 - y) < 0.1)


def test_a_room_is_a_circle_about_where_the_body_began_however_high_it_is():
    strays = leaves_room(np.array([0.3, -0.2]), 0.05)
    for way in (0.0, 1.0, 2.5, 4.0):
        for far, expected in ((0.0, False), (0.0499, False), (0.0501, True), (3.0, True)):
            x, y = 0.3 + far * math.cos(way), -0.2 + far * math.sin(way)
            assert strays(((x, y, 7.0 * way), at(0, 0)[1])) == expected
    assert not leaves_room(np.zeros(2), math.inf)(at(1e9, 1e9))


def test_what_is_gone_is_below_everything_that_it_could_land_on():
    gone = falls_below(-0.1)
    assert [gone(((5.0, 5.0, z), at(0, 0)[1])) for z in (0.0, -0.0999, -0.1001, -9.0)] == [False, False, True, True]
