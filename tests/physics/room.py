"""Bodies with mass properties in closed form, and worlds to try them in: what the oracles of mechanics share."""

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager

import numpy as np

from schemas.base import Array, Pose
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.shape import Mesh
from workers.geometry.frames import pose, rotation_about
from workers.physics.bullet import GRAVITY_M_S2, World, open_world
from workers.physics.rigid_body import Body

G = GRAVITY_M_S2
PHYSICS = Job(name="t").physics
RATES_HZ = (240, 480, 960, 1920)
LEVEL = 0.0
"""Height of the ground, metres."""

Y = np.array([0.0, 1.0, 0.0])


def physics(**changes) -> Physics:
    """The production settings with these changes."""
    return Physics.model_validate({**PHYSICS.model_dump(), **changes})


MARGIN_M = 1e-4
"""Of boxes here: their faces stand so far from the ground."""


def box_body(x: float, y: float, z: float, mass_kg: float = 1.0) -> Body:
    """A solid box of these sides, metres."""
    corners = np.array([[i, j, k] for i in (-x, x) for j in (-y, y) for k in (-z, z)]) / 2
    return Body(mass_kg, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) * mass_kg / 12, (corners,), MARGIN_M)


def ball_body(radius_m: float, mass_kg: float = 1.0) -> Body:
    """A solid ball: Bullet's hull of one point, with the radius as its margin."""
    return Body(mass_kg, np.full(3, 0.4 * mass_kg * radius_m**2), (np.zeros((1, 3)),), radius_m)


def at(x: float, z: float, lean_rad: float = 0.0) -> Pose:
    """[4, 4]: a body there, leaning towards +x."""
    return pose(rotation_about(Y, lean_rad), np.array([x, 0.0, z]))


def drop(
    body: Body, T_world_body: Pose, ground: float | Mesh, settings: Physics, steps: int
) -> AbstractContextManager[World]:
    """A world with one body."""
    return open_world([(body, T_world_body)], ground, settings, steps)


def lean(world: World) -> float:
    """How far the body's z axis leans towards +x, radians."""
    x, y, z, w = world.pose()[1]
    return math.atan2(2 * (x * z + y * w), 1 - 2 * (x * x + y * y))


def advance(world: World, steps: int) -> None:
    """`steps` steps of a world that was opened for one at a time."""
    for _ in range(steps):
        world.advance()


def slope(angle_rad: float, heading_rad: float = 0.0) -> tuple[float, float, float]:
    """Gravity, m/s^2, in the axes of ground that falls off by `angle_rad` towards `heading_rad` from x."""
    down = G * math.sin(angle_rad)
    return down * math.cos(heading_rad), down * math.sin(heading_rad), -G * math.cos(angle_rad)


def order(rates_hz: Sequence[int], errors: Array | Sequence[float]) -> float:
    """The slope of log error against log step, by least squares: 1 for a method of the first order."""
    steps = 1.0 / np.asarray(rates_hz, float)
    return float(np.polyfit(np.log(steps), np.log(np.abs(errors)), 1)[0])
