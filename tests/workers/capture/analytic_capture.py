"""A capture with exact truth: a board, a sphere and a box, seen by pinholes; rays are intersected in closed form."""

from dataclasses import dataclass, field

import numpy as np

from schemas.base import frozen_array
from schemas.job.captures import Board
from schemas.scene.view import Camera, Intrinsics
from workers.capture.surface.posed_view import PosedView
from workers.geometry.camera import look_at

BOARD = Board()
SPHERE, RADIUS = np.array([-0.06, 0.0, 0.07]), 0.06
"""The sphere hangs 1 cm above the board, its far pole 13 cm."""
LOW, HIGH = np.array([-0.02, -0.05, 0.0]), np.array([0.08, 0.05, 0.10])


def kinect(scale=0.25):
    f = 912.0 * scale
    width, height = round(1920 * scale), round(1080 * scale)
    return Intrinsics(width=width, height=height, fx=f, fy=f, cx=width / 2 + 0.3, cy=height / 2 - 0.2)


def poses(count, distance_m=0.7, seed=0, target=(0.0, 0.0, 0.04)):
    """Cameras on two rings, rolled by hand."""
    rng = np.random.default_rng(seed)
    found = []
    for n in range(count):
        tilt, turn = (0.6, 1.0)[n % 2] + rng.normal(0, 0.05), 2 * np.pi * (n + 0.3) / count
        towards = np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
        T = look_at(np.array(target) + distance_m * towards, np.array(target) + rng.normal(0, 0.01, 3))
        roll = rng.normal(0, 0.2)
        R = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        T[:3, :3] = T[:3, :3] @ R
        found.append(T)
    return found


@dataclass
class Thing:
    """What stands on the board: any of a sphere and boxes."""

    sphere: tuple | None = (SPHERE, RADIUS)
    boxes: list = field(default_factory=lambda: [(LOW, HIGH)])

    def distance(self, points):
        """[N] unsigned distance to the surface of the union, where the parts do not overlap much."""
        best = np.full(len(points), np.inf)
        if self.sphere is not None:
            best = np.abs(np.linalg.norm(points - self.sphere[0], axis=1) - self.sphere[1])
        for low, high in self.boxes:
            q = np.abs(points - (low + high) / 2) - (high - low) / 2
            outside = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
            best = np.minimum(best, np.abs(outside))
        return best


def cast(thing, camera):
    """(depth [H, W], object [H, W] bool, rgb [H, W, 3]): exact z at pixel centres; the board alone is seen beside the object."""
    k, T = camera.intrinsics, camera.T_world_cam
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    rays = np.stack([(columns + 0.5 - k.cx) / k.fx, (rows + 0.5 - k.cy) / k.fy, np.ones(rows.shape)], axis=-1)
    d = rays @ T[:3, :3].T
    o = T[:3, 3]
    board = -o[2] / d[..., 2]
    at = o + board[..., None] * d
    on_board = (board > 0) & (np.abs(at[..., 0]) < BOARD.width_m / 2) & (np.abs(at[..., 1]) < BOARD.height_m / 2)
    nearest = np.where(on_board, board, np.inf)
    part = np.where(on_board, 1, 0)
    for number, z in enumerate(_things(thing, o, d), start=2):
        part = np.where(z < nearest, number, part)
        nearest = np.minimum(nearest, z)
    depth = np.where(np.isfinite(nearest), nearest, 0.0)
    return depth, part >= 2, _paint(o + depth[..., None] * d, part)


def _things(thing, o, d):
    with np.errstate(divide="ignore", invalid="ignore"):
        if thing.sphere is not None:
            c, r = thing.sphere
            a, b, e = (d * d).sum(-1), (d * (o - c)).sum(-1), ((o - c) ** 2).sum() - r * r
            root = b * b - a * e
            yield np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        for low, high in thing.boxes:
            one, two = (low - o) / d, (high - o) / d
            enter, leave = np.minimum(one, two).max(-1), np.maximum(one, two).min(-1)
            yield np.where((enter < leave) & (enter > 0), enter, np.inf)


def _paint(points, part):
    """Smooth colours by place: the board grey with a slow pattern, parts in colours of their own."""
    wave = np.stack([np.sin(40 * points[..., i] + i) for i in range(3)], axis=-1)
    base = np.array([[0, 0, 0], [150, 150, 150], [180, 90, 60], [60, 120, 180], [90, 170, 80]])[np.minimum(part, 4)]
    return np.where(part[..., None] > 0, np.clip(base + 40 * wave, 0, 255), 0).astype(np.uint8)


def noisy(depth, rng, sigma_m, coarse=2):
    """Depth of a coarser sensor: noise that grows with z^2, mixing at edges, and holes; sampled up to the colour image."""
    low = depth[::coarse, ::coarse].copy()
    mixed = low.copy()
    step = np.roll(low, 1, axis=1)
    jump = (np.abs(step - low) > 0.02) & (step > 0) & (low > 0)
    share = rng.uniform(size=low.shape)
    mixed[jump] = (share * low + (1 - share) * step)[jump]
    mixed[(jump & (rng.uniform(size=low.shape) < 0.2)) | (low == 0)] = 0
    measured = np.where(mixed > 0, mixed + rng.normal(size=low.shape) * sigma_m * mixed**2, 0)
    up = np.kron(measured, np.ones((coarse, coarse)))[: depth.shape[0], : depth.shape[1]]
    # A plane's depth changes within a coarse pixel; a real registration interpolates, so the step is taken out again.
    truth = np.kron(low, np.ones((coarse, coarse)))[: depth.shape[0], : depth.shape[1]]
    smooth = (np.abs(depth - truth) < 0.01) & (up > 0) & (depth > 0)
    return np.where(smooth, up + depth - truth, up)


def capture(thing=None, count=24, scale=0.25, sigma_m=0.0, seed=0, distance_m=0.7):
    """Posed views with depth to the millimetre, as it is stored."""
    thing, rng = thing or Thing(), np.random.default_rng(seed + 100)
    k = kinect(scale)
    views = []
    for number, T in enumerate(poses(count, distance_m, seed)):
        camera = Camera(k, frozen_array(T))
        depth, _, rgb = cast(thing, camera)
        depth = noisy(depth, rng, sigma_m) if sigma_m else depth
        stored = (np.rint(np.maximum(depth, 0) * 1000) / 1000).astype(np.float32)
        views.append(PosedView(number, camera, camera, rgb, stored))
    return views
