"""Depth of a board with a box or a ball on it by arithmetic, as a depth camera with systematic and random errors has it."""

import functools
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Array, Pose
from schemas.scene.view import Intrinsics
from workers.geometry.frames import invert, transform, translation

GROUND_M = 0.02
"""Thickness of the board above the floor."""
BOX = (np.array([-0.05, -0.03, 0.0]), np.array([0.05, 0.03, 0.09]))
"""Two corners of a box that stands on the board, metres."""


@dataclass(frozen=True, eq=False)
class DepthErrors:
    """What is wrong with depth: sigma at 1 m (grows with z squared), bias, factor, and a wrong place of the depth camera."""

    sigma_m: float = 0.0
    bias_m: float = 0.0
    scale: float = 1.0
    shift_m: Array = field(default_factory=lambda: np.zeros(3))
    wave_m: float = 0.0
    """Height of a wave of the error along z, 0.25 m long, and of another across the image."""


@functools.cache
def rays_of(k: Intrinsics) -> Array:
    """[H W, 3]: through the pixels' centres, z = 1."""
    v, u = np.mgrid[: k.height, : k.width]
    return np.stack([(u + 0.5 - k.cx) / k.fx, (v + 0.5 - k.cy) / k.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)


def surface_depth(T_board_cam: Pose, k: Intrinsics, *, box=True, shift_m=None, scale=1.0, size_m=(0.6, 0.4)) -> Array:
    """[H, W] metres: z of board, floor and box seen by a camera that stands at the pose, by intersection with planes.

    `shift_m` moves the surface in camera axes: what a wrong registration does to it.
    """
    T = T_board_cam if shift_m is None else T_board_cam @ invert(translation(*shift_m))
    rays = rays_of(k)
    origin, direction = T[:3, 3], rays @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.full(len(rays), np.inf)
        for height in (0.0, -GROUND_M):
            t = (height - origin[2]) / direction[:, 2]
            x, y = (origin[i] + t * direction[:, i] for i in (0, 1))
            inside = (np.abs(x) < scale * size_m[0] / 2) & (np.abs(y) < scale * size_m[1] / 2) if height == 0 else True
            depth = np.where((t > 0) & inside & (t < depth), t, depth)
        if box:
            low, high = (BOX[0] - origin) / direction, (BOX[1] - origin) / direction
            enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
            depth = np.where((enter < leave) & (enter > 0) & (enter < depth), enter, depth)
    return np.where(np.isfinite(depth), depth, 0.0).reshape(k.height, k.width)


def measured_depth(
    T_board_cam: Pose, k: Intrinsics, wrong: DepthErrors, rng: np.random.Generator, *, box=True, scale=1.0, grain_px=2
) -> np.ndarray:
    """[H, W] uint16 millimetres. Noise is equal over pieces of `grain_px` pixels, as a coarser depth camera's is."""
    z = surface_depth(T_board_cam, k, box=box, shift_m=wrong.shift_m, scale=scale)
    grains = rng.standard_normal((k.height // grain_px + 1, k.width // grain_px + 1))
    noise = grains.repeat(grain_px, axis=0).repeat(grain_px, axis=1)[: k.height, : k.width]
    across = np.sin(np.arange(k.width) * 2 * np.pi / (0.3 * k.width))
    wave = wrong.wave_m * (np.sin(2 * np.pi * z / 0.25) + across)
    read = (z - wrong.bias_m) / wrong.scale + wave + wrong.sigma_m * z**2 * noise
    return np.where(z > 0, np.rint(np.clip(read, 0, 60) * 1000), 0).astype(np.uint16)


def on_object(T_board_cam: Pose, k: Intrinsics) -> np.ndarray:
    """[H, W] bool: pixels of the box."""
    z = surface_depth(T_board_cam, k)
    return (z > 0) & (z < surface_depth(T_board_cam, k, box=False) - 1e-6)


def board_points(depth_m: Array, T_board_cam: Pose, k: Intrinsics) -> Array:
    """[N, 3] board frame of all pixels with depth."""
    v, u = np.nonzero(depth_m)
    z = depth_m[v, u]
    return transform(T_board_cam, np.stack([(u + 0.5 - k.cx) / k.fx * z, (v + 0.5 - k.cy) / k.fy * z, z], axis=1))
