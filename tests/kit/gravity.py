"""Gravity of another strength or direction in an open world, which production has no need of."""

from collections.abc import Sequence

from workers.physics.bullet import World, pybullet


def set_gravity(world: World, gravity: Sequence[float]) -> None:
    """Set gravity, m/s^2, in this world alone."""
    pybullet.setGravity(*gravity, physicsClientId=world.client)
