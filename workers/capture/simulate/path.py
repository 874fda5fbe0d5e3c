"""The path of a hand-held camera around an object, as poses at the moments of its photographs."""

import math

import numpy as np

from schemas.base import Array
from schemas.job.captures import Simulate
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import pose, rotation_about

VIEWS_PER_TURN = 14
"""A turn around the object at one height has about as many views, and a path has at most `MOST_TURNS`."""

MOST_TURNS = 3

AIM_M = 0.02
"""Standard deviation of the point that the camera looks at about the object's middle."""

JITTER = 0.25
"""Share of an irregular step from view to view in what otherwise changes smoothly."""

OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


def plan_path(simulate: Simulate, target: Array, rng: np.random.Generator) -> Array:
    """[V, 4, 4] float64: poses in the frame of `target` [3], whose z points up, optical frame.

    The camera goes around the target up to three times, higher each time, looks at it and rolls. Its distance and its
    inclination stay within the intervals of `simulate`; the roll is normal with the standard deviation that it gives.
    """
    views = simulate.views
    turns = min(max(round(views / VIEWS_PER_TURN), 1), MOST_TURNS)
    time = (np.arange(views) + 0.5) / views
    yaw0, way = rng.uniform(-math.pi, math.pi), rng.choice([-1.0, 1.0])
    step = 2.0 * math.pi * turns / views
    yaw = yaw0 + way * (2.0 * math.pi * turns * time + JITTER * step * rng.uniform(-1.0, 1.0, views))
    level = (_climb(time, turns) + 0.5 * _sway(time, rng)) / turns
    inclination = _within(simulate.inclination_rad, level)
    distance = _within(simulate.distance_m, 0.5 + 0.5 * _sway(time, rng))
    roll = np.radians(simulate.roll_deg) * _normal_sway(time, rng)
    aim = target + AIM_M * rng.standard_normal((views, 3))
    poses = [_rolled(orbit_pose(aim[n], inclination[n], yaw[n], distance[n]), float(roll[n])) for n in range(views)]
    return np.stack(poses)


def _within(interval: tuple[float, float], share: Array) -> Array:
    """Values at shares of an interval; shares are clipped to [0, 1]."""
    low, high = interval
    return low + (high - low) * np.clip(share, 0.0, 1.0)


def _climb(time: Array, turns: int) -> Array:
    """0.5 on the first turn, 1.5 on the second, ..., rising smoothly in the last third of each but the last."""
    at = time * turns
    turn = np.minimum(np.floor(at), turns - 1)
    late = np.clip(3.0 * (at - turn) - 2.0, 0.0, 1.0)
    rise = late * late * (3.0 - 2.0 * late)
    return turn + 0.5 + np.where(turn < turns - 1, rise, 0.0)


def _sway(time: Array, rng: np.random.Generator) -> Array:
    """Within [-1, 1]: a smooth swaying and a little irregular jitter."""
    cycles, phase = rng.uniform(1.0, 5.0, 3), rng.uniform(0.0, 2.0 * math.pi, 3)
    smooth = np.sin(2.0 * math.pi * cycles * time[:, None] + phase).mean(axis=1)
    return (1.0 - JITTER) * smooth + JITTER * rng.uniform(-1.0, 1.0, len(time))


def _normal_sway(time: Array, rng: np.random.Generator) -> Array:
    """Standard normal at each moment; neighbours are alike, because a hand turns back slowly."""
    keep = 0.7
    drawn = rng.standard_normal(len(time))
    value = np.empty(len(time))
    for n in range(len(time)):
        value[n] = drawn[n] if n == 0 else keep * value[n - 1] + math.sqrt(1.0 - keep * keep) * drawn[n]
    return value


def _rolled(T: Array, roll_rad: float) -> Array:
    """The camera turned about its optical axis."""
    return T @ pose(rotation_about(OPTICAL_AXIS, roll_rad), np.zeros(3))
