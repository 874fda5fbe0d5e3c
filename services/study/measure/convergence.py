"""Order of convergence of the integrator, on two smooth cases with a closed-form answer."""

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from schemas.job.job import Job
from workers.physics.bullet import GRAVITY_M_S2, World, open_world
from workers.physics.rigid_body import Body

RATES_HZ = (3840, 7680, 15360)
"""An order shows in the limit: in longer steps a sliding block loses contacts for single steps, and stops a little later."""

FALL_S = 0.5
SLIDE_M_S = 1.0
FRICTION = 0.6

_MARGIN_M = 1e-4
_SIDES_M = (0.2, 0.2, 0.01)
_HEIGHT_M = 3.0


def slopes() -> dict[str, float]:
    """Order in the step of each case, by least squares of log error over log step.

    Semi-implicit Euler, which is what Bullet integrates with, is of the first order (Hairer, Lubich and Wanner 2006, I.1).
    """
    found = {}
    for name, error in (("free fall", _fall_error_m), ("sliding to rest", _slide_error_m)):
        errors = [abs(error(rate)) for rate in RATES_HZ]
        found[name] = float(np.polyfit(-np.log(RATES_HZ), np.log(errors), 1)[0])
    return found


def _block() -> Body:
    x, y, z = _SIDES_M
    corners = np.array(list(itertools.product((-x, x), (-y, y), (-z, z)))) / 2
    return Body(1.0, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 12, (corners,), _MARGIN_M)


@contextmanager
def _world_of(height_m: float, rate_hz: int) -> Iterator[World]:
    """A world with a block at a height."""
    physics = Job(name="convergence").physics.model_copy(update={"step_hz": rate_hz, "friction": math.sqrt(FRICTION)})
    T = np.eye(4)
    T[2, 3] = height_m
    with open_world([(_block(), T)], 0.0, physics, 1) as world:
        yield world


def _fall_error_m(rate_hz: int) -> float:
    """Error of a free fall against half g t squared."""
    with _world_of(_HEIGHT_M, rate_hz) as world:
        _advance(world, round(FALL_S * rate_hz))
        return float(_HEIGHT_M - world.pose()[0][2] - GRAVITY_M_S2 * FALL_S**2 / 2)


def _slide_error_m(rate_hz: int) -> float:
    """Error of a sliding distance against v squared / 2 mu g (Coulomb friction); the block first settles for a second."""
    with _world_of(_SIDES_M[2] / 2 + _MARGIN_M, rate_hz) as world:
        _advance(world, rate_hz)
        before = world.pose()[0][0]
        world.set_velocity((SLIDE_M_S, 0.0, 0.0))
        _advance(world, rate_hz)
        return float(world.pose()[0][0] - before - SLIDE_M_S**2 / (2.0 * FRICTION * GRAVITY_M_S2))


def _advance(world: World, steps: int) -> None:
    for _ in range(steps):
        world.advance()
