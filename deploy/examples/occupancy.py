"""What an occupancy network may know of an object from one view, where it is asked, the answers, baselines and the score.

The network's frame stands on the table: z is up and 0 at the table top, x is level and points away from the camera, and
x = y = 0 at the median of the object's seen points. Its unit is SCALE_M. A stored sample p, metres in the object's frame,
has there the coordinates

    q = T_net_world @ T_world_obj @ (p, 1),    T_net_world = upright_frame(...),    T_world_obj = pair.T_world[3]

The object's pose brings the samples there, and is used nowhere else. What goes into the network is depth and mask of the
input view, its camera, and the height of the table top.
"""

from dataclasses import dataclass

import numpy as np
from mirror_depth import close_holes, pixels_of, table_top, transform, unproject
from numpy.typing import NDArray

from schemas.scene.shape import REGION_FIRST_OBJECT
from services.dataset.pair import Pair
from services.dataset.view import Pixels, pick

SCALE_M = 0.1
"""The unit of the network's frame: objects are some units large, so that a network's inputs are about 1."""
WALL_M = 0.005
"""About the thickness of a wall."""
SEEN = 256
"""Seen points that the network gets."""
FEATURES = 9

Points = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Example:
    """One pair in the network's frame and unit.

    seen [SEEN, 3] float32: points of the input view. queries [M, FEATURES] float32: where is asked, and `shadow_of` of that
    place and of the same after half a turn. inside [M]: the truth. Baselines [M]: shadow, all that is behind the seen
    surface; turned, what is so after half a turn as well. M are all stored samples, or those that are uniform in the object's
    box times 1.05: those about its surface lie nearer to it than the noise of depth.
    """

    seen: NDArray[np.float32]
    queries: NDArray[np.float32]
    inside: Flags
    shadow: Flags
    turned: Flags


def make_example(pair: Pair, region: int = REGION_FIRST_OBJECT, uniform: bool = True) -> Example | None:
    """The example of an object of a pair; None where the patch leaves the image, or has fewer than 20 points of the object.

    uniform: without the samples about the surface. Raises InputError where the dataset has no samples.
    """
    samples, view = pair.samples(region), pair.input.patch(region)
    if view is None:
        return None
    depth, mask = view.depth_m(), view.segment() == region
    cloud = transform(view.T_world_cam, unproject(view, depth, mask))
    if len(cloud) < 20:
        return None
    T_net_world = upright_frame(view.T_world_cam, cloud, table_top(pair)[0])
    seen = transform(T_net_world, cloud)
    chosen = slice((len(samples["volume_points"]) + 1) // 2 if uniform else None)
    stored = samples["volume_points"][chosen].astype(np.float64)
    points = transform(T_net_world @ pair.T_world[region], stored)
    front = np.where(mask, close_holes(np.where(mask, depth, np.float32(0))), np.float32(0))
    T_cam_net = np.asarray(np.linalg.inv(T_net_world @ view.T_world_cam), np.float64)
    shadows = [shadow_of(view, front, transform(T_cam_net, places)) for places in (points, half_turn(points, seen))]
    shadow, other = ((behind[:, 0] > 0) & (points[:, 2] > 0) for behind in shadows)
    return Example(
        pick(seen, SEEN, np.random.default_rng(pair.pose_id)).astype(np.float32),
        np.concatenate([points, *shadows], axis=1).astype(np.float32),
        samples["volume_occupancy"][chosen] > 0,
        shadow,
        shadow & other,
    )


def upright_frame(T_world_cam: Points, seen: Points, table_m: float) -> Points:
    """[4, 4] T_net_world, which takes metres in the world to the network's frame and unit; seen [N, 3] in the world."""
    x = T_world_cam[:3, 2] * (1, 1, 0)
    x /= np.linalg.norm(x)
    origin = np.array([*np.median(seen[:, :2], axis=0), table_m])
    R = np.stack([x, np.cross((0, 0, 1), x), (0, 0, 1)])
    T = np.eye(4)
    T[:3] = np.concatenate([R, -R @ origin[:, None]], axis=1) / SCALE_M
    return T


def half_turn(points: Points, seen: Points) -> Points:
    """The points turned by 180 degrees about the vertical axis of the seen ones, as if the object were as deep as it is wide."""
    left, right = np.percentile(seen[:, 1], [1, 99])
    axis = np.array([np.percentile(seen[:, 0], 2) + (right - left) / 2, (left + right) / 2])
    return np.concatenate([2 * axis - points[:, :2], points[:, 2:]], axis=1)


def shadow_of(view: Pixels, front: NDArray[np.float32], points: Points) -> Points:
    """[N, 3]: how far points in the camera's frame, metres, lie behind the seen surface, in SCALE_M and in WALL_M, and 1.

    front [H, W]: depth of the object, 0 elsewhere. All are 0 for points whose pixel does not show the object.
    """
    rows, columns = pixels_of(view, points)
    height, width = front.shape
    within = (rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)
    depth = np.where(within, front[rows.clip(0, height - 1), columns.clip(0, width - 1)], 0)
    behind = points[:, 2] - depth
    maps = [np.clip(behind / unit, -3, 3) for unit in (SCALE_M, WALL_M)]
    return np.stack([*maps, np.ones(len(points))], axis=1) * (depth > 0)[:, None]


def iou(predicted: Flags, inside: Flags) -> float:
    """Intersection over union of two volumes, by samples [M] that are uniform in the box; nan where both are empty."""
    union = predicted | inside
    return float((predicted & inside).sum() / union.sum()) if union.any() else float("nan")
