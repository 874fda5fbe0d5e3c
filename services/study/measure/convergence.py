"""Order of convergence of the integrator, on two smooth cases with a closed-form answer."""

import math
from collections.abc import Sequence

import numpy as np

from schemas.base import Array
from schemas.job.job import Job
from schemas.job.physics import Physics
from workers.physics.bullet import GRAVITY_M_S2, World, open_world
from workers.physics.rigid_body import Body

RATES_HZ = (960, 1920, 3840, 7680)
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
    cases = {"free fall": _fall_error_m, "sliding to rest": _slide_error_m}
    return {name: _order([error(rate) for rate in RATES_HZ]) for name, error in cases.items()}


def _order(errors: Sequence[float]) -> float:
    return float(np.polyfit(-np.log(RATES_HZ), np.log(np.abs(errors)), 1)[0])


def _physics(rate_hz: int) -> Physics:
    return Job(name="convergence").physics.model_copy(update={"step_hz": rate_hz, "friction": math.sqrt(FRICTION)})


def _block() -> Body:
    x, y, z = _SIDES_M
    corners = np.array([[i, j, k] for i in (-x, x) for j in (-y, y) for k in (-z, z)]) / 2
    moments = np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 12
    return Body(1.0, moments, (corners,), _MARGIN_M)


def _at(height_m: float) -> Array:
    T = np.eye(4)
    T[2, 3] = height_m
    return T


def _fall_error_m(rate_hz: int) -> float:
    """Error of a free fall against half g t squared."""
    with open_world([(_block(), _at(_HEIGHT_M))], 0.0, _physics(rate_hz), 1) as world:
        _advance(world, round(FALL_S * rate_hz))
        return float(_HEIGHT_M - world.pose()[0][2] - GRAVITY_M_S2 * FALL_S**2 / 2)


def _slide_error_m(rate_hz: int) -> float:
    """Error of a sliding distance against v squared / 2 mu g (Coulomb friction); the block first settles for a second."""
    with open_world([(_block(), _at(_SIDES_M[2] / 2 + _MARGIN_M))], 0.0, _physics(rate_hz), 1) as world:
        _advance(world, rate_hz)
        before = world.pose()[0][0]
        world.set_velocity((SLIDE_M_S, 0.0, 0.0))
        _advance(world, rate_hz)
        return float(world.pose()[0][0] - before - SLIDE_M_S**2 / (2.0 * FRICTION * GRAVITY_M_S2))


def _advance(world: World, steps: int) -> None:
    for _ in range(steps):
        world.advance()
