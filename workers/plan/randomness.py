"""Named streams of random numbers: one for each step, append-only, so that adding a camera never moves an object."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Every use of chance in a scene. A new one gets the next number; a number is never used for anything else."""

    CATEGORY = 0
    OBJECT = 1
    TABLE = 2
    START = 3
    REDRAW = 4
    CAMERA = 5
    APPEARANCE = 6
    RAYCAST_CHECK = 7
    SENSOR_DEPTH = 8
    SENSOR_RGB = 9
    SENSOR_EXPOSURE = 10
    PATHS = 11
    COUNT = 12


def stream(seed: int, scene_id: int, name: Stream, *within: int) -> np.random.Generator:
    """The generator of one step of one scene: a function of the dataset's seed, the scene and the step alone.

    `within` names a part of a step that must not depend on how many parts there are: (pair, role) for a view's noise.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(scene_id, int(name), *within)))


def of_object(number: int) -> tuple[int, ...]:
    """What `within` is for an object by its number: the first object's streams are those of a scene that has only one."""
    return (number,) if number else ()
