"""Points of a view in space: what its pixels see as a cloud, the box about an object, samples of a whole surface. Pure."""

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.base import Array, Pose
from schemas.scene.view import Intrinsics
from workers.geometry.camera import project
from workers.geometry.frames import transform

if TYPE_CHECKING:
    import trimesh

Frame = Literal["object", "camera", "world"]
"""The frame of points: an object's own, the camera's (x right, y down, z forward), or the world (z up); metres in all."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """What the pixels of a view see, a point for each pixel with depth, row after row.

    points [N, 3] float64, metres; colours [N, 3] uint8 sRGB, None without RGB; normals [N, 3] float64, unit, towards the
    camera, None without the target `normals`; pixels [N, 2] int64, row and column, so that `image[tuple(cloud.pixels.T)]` are
    the points' values in any image of the view.
    """

    points: Array
    colours: NDArray[np.uint8] | None
    normals: Array | None
    pixels: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Box:
    """The corners of the box about an object that lies along the axes of the object's frame.

    corners [8, 3] float64 in the camera's frame, metres; image [8, 2] float64, their (u, v) in pixels, also outside of the
    image, nan where a corner is not before the camera. Corner 4 i + 2 j + k is at the lower (0) or upper (1) end along the
    object's x (i), y (j) and z (k).
    """

    corners: Array
    image: Array


def box_corners(extents_m: ArrayLike, T_cam_obj: Pose, intrinsics: Intrinsics) -> Box:
    """The box of this size [3], whose middle is the origin of the object's frame."""
    ends = np.array(list(product((-0.5, 0.5), repeat=3)))
    corners = transform(T_cam_obj, ends * np.asarray(extents_m))
    image, ahead = np.full((8, 2), np.nan), corners[:, 2] > 0.0
    image[ahead] = np.stack(project(corners[ahead], intrinsics), axis=1)
    return Box(corners, image)


def pick(points: Array, count: int, rng: np.random.Generator) -> Array:
    """[count, 3]: some of points [N, 3], N > 0, in random order; none twice, unless there are fewer than `count`."""
    return points[rng.choice(len(points), count, replace=len(points) < count)]


def sample_mesh(mesh: "trimesh.Trimesh", count: int, seed: int) -> Array:
    """[count, 3] float64: points uniform over the area of a mesh."""
    import trimesh  # takes as long to load as all the rest

    points: Array = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0], dtype=np.float64)
    return points
