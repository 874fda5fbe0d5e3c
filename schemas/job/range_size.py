"""The number of scenes in a range, where the job does not give it."""

import math

from schemas.job.render import Render
from schemas.job.start import Start

MOST = 16
"""Of quick scenes: a few seconds of work, of which a commit takes about a hundredth."""

FEWEST_RANGES = 32
"""A job has as many ranges at least, if it has the scenes: for that many workers, or for a few that end together."""

RANGE_S = 10.0
"""Processor time that a range should take: about what is lost with a worker."""

SCENE_S, FALLING_S, PILED_S = 0.12, 0.1, 0.25
"""Processor time of a pair with one object (measured), of each further object spread out (a guess), and of each in a pile (a
pile of eight takes 1.7 s on average)."""

PATH_S = 1.0
"""Processor time of each path through every pixel of a pair's three images: 16 paths take 5.6 s an image."""


def choose_range_size(scenes: int, most_objects: int, pairs: int, start: Start, render: Render) -> int:
    """Scenes in a range. It changes no byte of the dataset, and a rough estimate of a scene's time will do."""
    further = PILED_S if start.arrange == "pile" else FALLING_S
    traced = PATH_S * render.path_samples * pairs if render.tier == "pathtraced" else 0.0
    scene_s = SCENE_S * pairs + further * (most_objects - 1) + traced
    return max(1, min(MOST, int(RANGE_S / scene_s), math.ceil(scenes / FEWEST_RANGES)))
