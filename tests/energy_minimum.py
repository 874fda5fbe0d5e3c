"""Whether a body at rest is least in energy: told by rocking it, and by nothing that settles it."""

import numpy as np

from schemas.base import Array, Pose
from workers.geometry.frames import transform

ROCK_RAD = 1e-3
"""How far a body is rocked to see whether its centre of mass sinks: less than half a facet of a round shape."""

ROCK_AXES = 16
"""Directions in which it is rocked."""

SINKS_M = 1e-9
"""A centre of mass that sinks by less did not sink."""


def is_energy_minimum(vertices: Array, T_world_obj: Pose, com: Array) -> bool:
    """Whether a body on a level plane, rocked a little any way, does not sink: for what touches in a point or a line.

    vertices [N, 3] and com [3] in the object's frame. The centre of mass is as high above a plane with the upward
    normal u as max over vertices of u . (com - v), whichever part of the body touches (its support function).
    """
    depth = transform(T_world_obj, com[None, :]) - transform(T_world_obj, vertices)
    angle = 2.0 * np.pi * np.arange(ROCK_AXES) / ROCK_AXES
    tilted = np.column_stack(
        [np.sin(ROCK_RAD) * np.cos(angle), np.sin(ROCK_RAD) * np.sin(angle), np.full(ROCK_AXES, np.cos(ROCK_RAD))]
    )
    height = (depth @ tilted.T).max(axis=0)
    return bool((height >= depth[:, 2].max() - SINKS_M).all())
