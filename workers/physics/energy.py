"""Mechanical energy of rigid bodies that fall: how far it rises above the least that they had. Pure."""

from collections.abc import Sequence

from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.rigid_body import Body, BodyPose

SHARE = 1e-3
"""Bound on a rise of energy, as a share of what the drop sets free."""

LIFT_M = 2e-5
"""The same as a height that the rise would lift the body by, where that is more: what Bullet leaves a shape to hover by."""

Velocity = tuple[Sequence[float], Sequence[float]]
"""Velocity of the centre of mass, m/s, and angular velocity, rad/s, world axes."""


class EnergyRecord:
    """The energy of bodies from time to time, over their weight, metres: the first, the least and the last of it."""

    def __init__(self, bodies: Sequence[Body], at: Sequence[BodyPose], moving: Sequence[Velocity]) -> None:
        mass_kg = sum(body.mass_kg for body in bodies)
        self._shares = [body.mass_kg / mass_kg for body in bodies]
        self._radii2 = [[float(moment) / body.mass_kg for moment in body.moments] for body in bodies]
        self._first = self._least = self._last = self._height_m(at, moving)
        self._most = 0.0

    def add(self, at: Sequence[BodyPose], moving: Sequence[Velocity]) -> None:
        """Note the energy at these poses and velocities."""
        self._last = self._height_m(at, moving)
        self._least = min(self._least, self._last)
        self._most = max(self._most, self._last - self._least)

    def rise(self) -> float:
        """The most that the energy rose above its least until then, as a share of the bound."""
        return self._most / max(SHARE * (self._first - self._last), LIFT_M)

    def _height_m(self, at: Sequence[BodyPose], moving: Sequence[Velocity]) -> float:
        """The height at which their centre of mass has as much at rest."""
        height_m = 0.0
        for share, radii2, pose, motion in zip(self._shares, self._radii2, at, moving, strict=True):
            height_m += share * energy_height_m(radii2, pose, motion)
        return height_m


def energy_height_m(radii2: Sequence[float], at: BodyPose, moving: Velocity) -> float:
    """The energy of a body over its weight, metres, from these squares [3] of its radii of inertia, metres squared."""
    (_, _, height), (x, y, z, w) = at
    (u, v, s), (p, q, r) = moving
    # The angular velocity along the body's axes
    along = (
        (1 - 2 * (y * y + z * z)) * p + 2 * (x * y + z * w) * q + 2 * (x * z - y * w) * r,
        2 * (x * y - z * w) * p + (1 - 2 * (x * x + z * z)) * q + 2 * (y * z + x * w) * r,
        2 * (x * z + y * w) * p + 2 * (y * z - x * w) * q + (1 - 2 * (x * x + y * y)) * r,
    )
    turning = radii2[0] * along[0] * along[0] + radii2[1] * along[1] * along[1] + radii2[2] * along[2] * along[2]
    return height + (u * u + v * v + s * s + turning) / (2 * GRAVITY_M_S2)
