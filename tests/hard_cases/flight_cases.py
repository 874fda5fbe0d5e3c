"""The table of hard cases in the air and on a tip: motions that classical mechanics knows exactly.

Free bodies against Euler's equations, I w' = (I w) x w; tops against Lagrange's: both integrated by Runge-Kutta.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from schemas.base import Array
from tests.kit.gravity import set_gravity
from tests.physics.room import MARGIN_M, G, advance, at, box_body, drop, physics
from workers.geometry.frames import pose, rotation_about, rotation_from_quaternion
from workers.physics.rigid_body import Body

RATE_HZ = 15_360
"""The rate of the shortest step, which is what things that spin get."""

RISES = 0.003
"""Share by which energy may rise: steps that add energy throw things."""

SAMPLES = 400
"""Looks at a flight."""


@dataclass(frozen=True, eq=False)
class Flight:
    """One row: a body let go with this angular velocity, rad/s, along its principal axes, in the air without gravity.

    kept: share by which angular momentum may change and energy fall, which may not rise by more than `RISES`; degrees: by
    which it may be turned otherwise at the end. Steps of the first order lose a share that grows with the spin.
    """

    name: str
    body: Body
    spin: tuple[float, float, float]
    seconds: float
    kept: float
    degrees: float


def flown(flight: Flight) -> tuple[Array, Array]:
    """([N, 3, 3] rotations body to world, [N, 3] angular velocities in the world), at even times."""
    stride = round(RATE_HZ * flight.seconds / SAMPLES)
    turned, spins = [np.eye(3)], [np.array(flight.spin)]
    with drop(flight.body, at(0.0, 3.0), 0.0, physics(step_hz=RATE_HZ), 1) as world:
        set_gravity(world, (0.0, 0.0, 0.0))
        world.set_velocity((0.0, 0.0, 0.0), flight.spin)
        for _ in range(SAMPLES):
            advance(world, stride)
            turned.append(rotation_from_quaternion(np.array(world.pose()[1])))
            spins.append(np.array(world.velocity()[1]))
    return np.array(turned), np.array(spins)


def exact(flight: Flight) -> tuple[Array, Array]:
    """The same by Euler's equations (Goldstein 2002, 5.5)."""
    moments = flight.body.moments

    def rates(_: float, state: Array) -> Array:
        R, w = state[:9].reshape(3, 3), state[9:]
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(R @ cross).ravel(), np.cross(moments * w, w) / moments])

    step = round(RATE_HZ * flight.seconds / SAMPLES) / RATE_HZ
    times = step * np.arange(SAMPLES + 1)
    begun = np.concatenate([np.eye(3).ravel(), flight.spin])
    path = solve_ivp(rates, (0.0, times[-1]), begun, t_eval=times, rtol=1e-11, atol=1e-12, method="DOP853").y.T
    R = path[:, :9].reshape(-1, 3, 3)
    return R, np.einsum("nij,nj->ni", R, path[:, 9:])


def momenta(flight: Flight, R: Array, w: Array) -> Array:
    """[N, 3] angular momentum in the world, kg m^2/s."""
    return np.einsum("nij,j,nkj,nk->ni", R, flight.body.moments, R, w)


def turned_otherwise_deg(R: Array, wanted: Array) -> float:
    """The angle between the last of two series of rotations [N, 3, 3], by the chord between them, which small angles need."""
    return math.degrees(2.0 * math.asin(min(1.0, float(np.linalg.norm(R[-1] - wanted[-1])) / math.sqrt(8.0))))


def energies(flight: Flight, R: Array, w: Array) -> Array:
    """[N] kinetic energy, J."""
    return np.einsum("ni,ni->n", momenta(flight, R, w), w) / 2.0


def flips(R: Array, axis: int) -> Any:
    """Samples at which an axis of the body turns from along its first direction to against it, or back."""
    along = np.einsum("ni,i->n", R[:, :, axis], R[0, :, axis])
    return np.flatnonzero(np.diff(np.sign(along)))


def can_body(radius_m: float, height_m: float, mass_kg: float = 0.3) -> Body:
    """A solid cylinder about z, of 24 sides to touch with."""
    angle = np.arange(24) * np.pi / 12
    rim = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate([np.column_stack([rim, np.full(24, z)]) for z in (-height_m / 2, height_m / 2)])
    across = mass_kg * (3 * radius_m**2 + height_m**2) / 12
    return Body(mass_kg, np.array([across, across, mass_kg * radius_m**2 / 2]), (points,), MARGIN_M)


FLIGHTS = (
    # Dzhanibekov: about the axis of the middle moment, but for a hundredth, it turns over again and again.
    Flight("box flips about its middle axis", box_body(0.02, 0.06, 0.1), (0.12, 12.0, 0.12), 6.0, 0.01, 10.0),
    Flight("box spun about a skew axis at 50 rad/s", box_body(0.06, 0.09, 0.14), (30.0, 30.0, 26.0), 1.0, 0.02, 10.0),
    Flight(
        "box spun about a skew axis at 200 rad/s", box_body(0.06, 0.09, 0.14), (120.0, 120.0, 106.0), 0.25, 0.1, 45.0
    ),
    Flight("can spun about a skew axis at 200 rad/s", can_body(0.033, 0.12), (100.0, 0.0, 173.0), 0.25, 0.15, 90.0),
    # It wobbles twice as fast as it turns (Feynman 1985, Surely You're Joking).
    Flight("plate that wobbles", can_body(0.12, 0.002), (2.0, 0.0, 20.0), 1.0, 0.005, 5.0),
)

# ---------------------------------------------------------------------------------------------- tops


TOP_M = (0.03, 0.03)
"""Radius of a top's disc, and the height of its middle over the tip."""

TOP_KG = 0.1


def top() -> Body:
    """A cone on its tip, with the mass of a thin disc at its base; the frame's origin is the centre of mass."""
    radius, height = TOP_M
    angle = np.arange(48) * np.pi / 24
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(48)])
    points = np.concatenate([rim, [[0.0, 0.0, -height]]])
    across = TOP_KG * radius**2 / 4
    return Body(TOP_KG, np.array([across, across, 2.0 * across]), (points,), 1e-5)


def sleeping_rad_s() -> float:
    """The least spin at which an upright top sleeps: 2 sqrt(m g l I) / I3, I about its tip (Goldstein 2002, 5.7)."""
    _, height = TOP_M
    across, _, along = top().moments
    return 2.0 * math.sqrt(TOP_KG * G * height * (across + TOP_KG * height**2)) / along


def lean_of_top(spin_rad_s: float, lean_rad: float, seconds: float) -> tuple[float, float]:
    """(the most that it leans, radians, radians that it precesses) of a simulated top that is let go on its tip."""
    axis = np.array([0.0, 1.0, 0.0])
    R = rotation_about(axis, lean_rad)
    start = pose(R, R @ [0.0, 0.0, TOP_M[1]] + [0.0, 0.0, 1e-5])
    settings = physics(step_hz=RATE_HZ, friction=1.0, rolling_friction=0.0, spinning_friction=0.0)
    worst, turned, before = 0.0, 0.0, 0.0
    with drop(top(), start, 0.0, settings, 1) as world:
        world.set_velocity((0.0, 0.0, 0.0), tuple(R[:, 2] * spin_rad_s))
        for _ in range(SAMPLES):
            advance(world, round(RATE_HZ * seconds / SAMPLES))
            up = rotation_from_quaternion(np.array(world.pose()[1]))[:, 2]
            worst, now = max(worst, math.acos(float(np.clip(up[2], -1.0, 1.0)))), math.atan2(up[1], up[0])
            turned += math.remainder(now - before, 2.0 * math.pi)
            before = now
    return worst, turned


def exact_top(spin_rad_s: float, lean_rad: float, seconds: float) -> tuple[float, float]:
    """The same by Lagrange's equations: lean and precession of a symmetric top about a fixed tip, let go with spin alone."""
    height = TOP_M[1]
    across, _, along = top().moments
    about_tip, L3 = across + TOP_KG * height**2, along * spin_rad_s
    L = L3 * math.cos(lean_rad)

    def rates(_: float, state: Array) -> list[float]:
        lean, speed, _ = state
        s, c = math.sin(lean), math.cos(lean)
        precession = (L - L3 * c) / (about_tip * s * s)
        pull = TOP_KG * G * height * s - L3 * precession * s + about_tip * precession**2 * s * c
        return [speed, pull / about_tip, precession]

    times = np.linspace(0.0, seconds, SAMPLES + 1)
    path = solve_ivp(rates, (0.0, seconds), [lean_rad, 0.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12).y
    return float(path[0].max()), float(path[2][-1])
