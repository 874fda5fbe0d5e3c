"""The random numbers of a scene: a stream for each use, from the seed of the dataset and the id of the scene alone. Pure."""

from dataclasses import dataclass
from enum import IntEnum
from zlib import crc32

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
    HIDDEN_MARKERS = 13
    MOTION = 14
    HELD_OUT = 15
    LOST = 16
    SENSOR = 17
    ORBIT = 18
    MORE = 19
    MIRROR = 20
    LIGHTS = 21
    ENVIRONMENT = 22
    SURROUNDINGS = 23
    CLUTTER = 24
    GIVEN = 27


_SENSORS = {"depth_noise": Stream.SENSOR_DEPTH, "rgb_noise": Stream.SENSOR_RGB, "exposure": Stream.SENSOR_EXPOSURE}
"""The streams of the first effects of sensors; those after them share one, and have a part of it each by their names."""


@dataclass(frozen=True)
class SceneChance:
    """The random numbers of one scene: a function of the dataset's seed and the scene's id alone."""

    seed: int
    scene_id: int

    def stream(self, name: Stream, *within: int) -> np.random.Generator:
        """The generator of one step.

        `within` names a part of a step that must not depend on how many parts there are: (pair, role) for a view's noise.
        """
        key = (self.scene_id, int(name), *within)
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    def object_stream(self, name: Stream, number: int) -> np.random.Generator:
        """The generator of one step for an object by its number: the first object's is that of a scene with only one."""
        return self.stream(name, *([number] if number else []))

    def sensor_stream(self, effect: str, *within: int) -> np.random.Generator:
        """The generator of an effect of a sensor, by its key of `sensor`."""
        if effect in _SENSORS:
            return self.stream(_SENSORS[effect], *within)
        return self.stream(Stream.SENSOR, crc32(effect.encode()), *within)
