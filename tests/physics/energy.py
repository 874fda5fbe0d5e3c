"""Mechanical energy of what production simulates, step by step, and how far it rises."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Asset
from tests.physics.room import G
from workers.geometry.frames import rotation_from_quaternion
from workers.physics import bullet
from workers.physics.bullet import World
from workers.physics.rigid_body import body_frame

SHARE = 1e-3
"""Of the energy that the drop sets free."""
LIFT_M = 2e-5
"""Height that the rise would lift the body by."""


@dataclass(frozen=True)
class Rise:
    """The most that energy rises above its running minimum: over the bound, and as a height."""

    over_bound: float
    lift_m: float


def worst_of(falls: Iterable[Array], weight: float) -> Rise:
    """Of each simulation's energies [steps], joules, of things of this weight, newtons."""
    rises = []
    for energy in falls:
        rise = float((energy - np.minimum.accumulate(energy)).max())
        rises.append(Rise(rise / max(SHARE * (energy[0] - energy[-1]), LIFT_M * weight), rise / weight))
    return max(rises, key=lambda rise: rise.over_bound)


@contextmanager
def watched(assets: Sequence[Asset], spin: Sequence[float] = (0.0, 0.0, 0.0)) -> Iterator[Callable[[], list[Array]]]:
    """Within the block production settles these objects; then [1 + steps] joules in all, at the start and after every step.

    Of several from one start, as in shorter steps or on a mesh, the last one counts: it led to the rest. Kinetic and potential
    energy. In the air semi-implicit Euler only loses energy, g^2 h / 2 a second and kilogram, so that no rise is its own.
    `spin` is what they are let go with, rad/s.
    """
    falls = dict[tuple[float, ...], list[float]]()
    moments = [body_frame(asset.mass)[1] for asset in assets]

    def energy(world: World, body: int) -> float:
        (x, quaternion), (v, w) = world.pose(body), world.velocity(body)
        spins = rotation_from_quaternion(np.array(quaternion)).T @ np.array(w)
        return assets[body].mass.mass_kg * (np.dot(v, v) / 2 + G * x[2]) + float(moments[body] @ (spins * spins)) / 2

    @dataclass(frozen=True)
    class Watched(World):
        """Steps one at a time, and looks at the energy after each."""

        together: int = 1
        energies: list[float] = field(default_factory=list)

        def advance(self) -> None:
            for _ in range(self.together):
                super().advance()
                self.energies.append(sum(energy(self, body) for body in range(len(self.bodies))))

        def set_velocity(self, velocity: Sequence[float], _: Any = None, body: int = 0) -> None:
            super().set_velocity(velocity, spin, body)
            self.energies[:] = [sum(energy(self, each) for each in range(len(self.bodies)))]

    def begin(client: int, grounds: tuple[int, ...], bodies: tuple[int, ...], steps: int, slop_m: float) -> World:
        world = Watched(client, grounds, bodies, 1, slop_m, together=steps)
        places = [world.pose(body) for body in range(len(bodies))]
        # A free fall ends at another height over a mesh
        falls[tuple(np.round([value for (x, y, _), turned in places for value in (x, y, *turned)], 9))] = world.energies
        return world

    with mock.patch.object(bullet, "World", begin):
        yield lambda: [np.array(energies) for energies in falls.values()]
