"""Normals of the input view: what a network may know of them, the baselines from depth alone, and the scores.

Everything lies in the patch about the object. Truth are the stored normals: unit, in the camera's frame (x right, y down,
z forward), towards the camera. RGB and depth of the patch go in, with the sensor's noise where the job has some.
"""

from dataclasses import dataclass

import numpy as np
from mirror_depth import rays_through
from numpy.typing import NDArray

from schemas.scene.shape import REGION_FIRST_OBJECT
from services.dataset.pair import Pair
from services.dataset.view import Pixels

SCALE_M = 0.1
"""Depths are given to the network relative to the patch's median, in this unit."""
STEP_M = 0.02
"""Pixels of a window that differ more than this in depth from its middle are of another surface."""
WINDOWS = {"differences": 3, "planes": 7}
"""Sides, pixels, of the windows of the two baselines: the smallest there is, and the best of 3 to 15 at 1.25 m."""
WITHIN_DEG = (11.25, 22.5, 30.0)
"""Usual bounds of good pixels (Fouhey et al. 2013)."""
CHANNELS = 11

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Example:
    """One patch: features [CHANNELS, H, W], baselines by name and truth [H, W, 3], and the object's pixels, mask [H, W]."""

    features: Image
    baselines: dict[str, Image]
    truth: Image
    mask: NDArray[np.bool_]


def make_example(pair: Pair) -> Example | None:
    """The example of a pair; None where the patch leaves the image or has no depth.

    Raises InputError where the dataset has no normals.
    """
    view = pair.input.patch()
    if view is None or not (depth := view.depth_m()).any():
        return None
    baselines = {name: normals_of_depth(view, depth, size) for name, size in WINDOWS.items()}
    relative = np.clip((depth - np.median(depth[depth > 0])) / SCALE_M, -3, 3) * (depth > 0)
    maps = [*np.moveaxis(view.rgb() / 255, 2, 0), relative, depth > 0]
    maps += [image for normals in baselines.values() for image in np.moveaxis(normals, 2, 0)]
    truth = view.normals()
    mask = (view.segment() == REGION_FIRST_OBJECT) & truth.any(axis=2)
    return Example(np.stack(maps).astype(np.float32), baselines, truth, mask)


def normals_of_depth(view: Pixels, depth: Image, size: int) -> Image:
    """[H, W, 3] unit normals, towards the camera, of planes fitted to depth [H, W] in windows of size x size pixels.

    1 / z of a plane n . p = 1 is n . ray, linear in the image: least squares over the pixels of the window with depth near
    that of its middle. Towards the camera where that has no depth, or too few such pixels.
    """
    k, half, (height, width) = view.camera.intrinsics, size // 2, depth.shape
    padded = np.pad(depth, half)
    left, right = np.zeros((height, width, 3, 3)), np.zeros((height, width, 3))
    for dy, dx in np.ndindex(size, size):
        z = padded[dy : dy + height, dx : dx + width].astype(np.float64)
        used = (z > 0) & (depth > 0) & (np.abs(z - depth) < STEP_M)
        at = np.array([(dx - half) / k.fx, (dy - half) / k.fy, 1.0])
        left += used[..., None, None] * np.outer(at, at)
        right += (used / np.maximum(z, 1e-6))[..., None] * at
    rays = rays_through(view, *np.indices(depth.shape).reshape(2, -1)).reshape(height, width, 3)
    enough = np.linalg.det(left) > 0.5 / (k.fx * k.fy) ** 2  # three pixels that are not in a row give 1
    slope = np.linalg.solve(np.where(enough[..., None, None], left, np.eye(3)), right[..., None])[..., 0]
    slope[..., 2] -= (slope[..., :2] * rays[..., :2]).sum(axis=2)
    normals = -np.where(enough[..., None], slope, rays)
    return (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)


def errors_deg(predicted: Image, example: Example) -> NDArray[np.float64]:
    """[N] angles, degrees, between predicted unit normals [H, W, 3] and the true ones, of the object's pixels."""
    a, b = (one[example.mask].astype(np.float64) for one in (predicted, example.truth))
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))


def score(errors: NDArray[np.float64]) -> dict[str, float]:
    """Mean and median of errors [N], degrees, and the shares within WITHIN_DEG."""
    shares = {f"within {bound:g}": float((errors < bound).mean()) for bound in WITHIN_DEG}
    return {"mean": float(errors.mean()), "median": float(np.median(errors)), **shares}
