"""An oracle for stable rest poses: rocks a body a little and compares potential energies, independently of settling."""

import numpy as np

from schemas.base import Array, Pose
from workers.geometry.frames import transform

ROCK_RAD = 1e-3
"""Angle by which a body is rocked: less than half a facet of a round shape."""

ROCK_AXES = 16
"""Number of directions in which it is rocked."""

SINKS_M = 1e-9
"""Descent of the centre of mass below which it counts as level: rounding."""


def is_energy_minimum(vertices: Array, T_world_obj: Pose, com: Array) -> bool:
    """Whether no small rocking lowers a body on a level plane; also where it touches in a point or a line.

    vertices [N, 3] and com [3] in the object's frame. The centre of mass is as high above a plane with the upward
    normal u as max over vertices of u . (com - v), the support function, whichever part of the body touches.
    """
    depth = transform(T_world_obj, com[None, :]) - transform(T_world_obj, vertices)
    angle = 2.0 * np.pi * np.arange(ROCK_AXES) / ROCK_AXES
    tilted = np.column_stack(
        [np.sin(ROCK_RAD) * np.cos(angle), np.sin(ROCK_RAD) * np.sin(angle), np.full(ROCK_AXES, np.cos(ROCK_RAD))]
    )
    height = (depth @ tilted.T).max(axis=0)
    return bool((height >= depth[:, 2].max() - SINKS_M).all())
