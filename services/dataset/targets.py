"""Image targets as numbers: unit normals, coordinates in metres, thickness. Pure; `workers/scene/targets.py` encodes them."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.base import Array
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import FULL, Intrinsics
from workers.geometry.camera import unproject


def decode_normals(codes: NDArray[np.uint16]) -> NDArray[np.float32]:
    """[H, W, 3] float32: unit normals of codes (n + 1) / 2 [H, W, 3]; 0 where all three codes are 0, which says none."""
    normals = codes * (2.0 / FULL) - 1.0
    length = np.where(codes.any(axis=2), np.linalg.norm(normals, axis=2), np.inf)
    return (normals / length[:, :, None]).astype(np.float32)


def decode_coordinates(
    codes: NDArray[np.uint16], region: NDArray[np.uint8], scales: Mapping[int, tuple[float, ArrayLike]]
) -> Array:
    """[H, W, 3] float64: points in their objects' frames, metres, of codes [H, W, 3]; nan where there are none.

    scales: of each region of the mask `region` [H, W], (scale, offset [3]) in metres.
    """
    points = np.full(codes.shape, np.nan)
    for region_id, (scale_m, offset_m) in scales.items():
        own = (region == region_id) & codes.any(axis=2)
        points[own] = codes[own] * (scale_m / FULL) + np.asarray(offset_m)
    return points


def thickness_along_rays(
    layers_m: NDArray[np.float32],
    layers_region: NDArray[np.uint8],
    back: tuple[NDArray, NDArray],
    own: NDArray,
    k: Intrinsics,
) -> NDArray[np.float32]:
    """[H, W] float32: metres along each pixel's ray from its first surface to its last; nan where it does not count.

    layers_m, layers_region [N, H, W]: depth and region of the first surfaces; back: those of the last one [H, W]; own
    [H, W]: the mask. It counts where the mask shows an object and all these surfaces are that object's and have depth.
    """
    back_m, back_region = back
    counts = (own >= REGION_FIRST_OBJECT) & (layers_region[0] == own) & (back_region == own)
    counts &= ((layers_region == own) | (layers_region == 0)).all(axis=0) & (layers_m[0] > 0.0) & (back_m > 0.0)
    rows, columns = np.nonzero(counts)
    rays = unproject(rows, columns, np.ones(len(rows)), k)
    thickness = np.full(own.shape, np.nan, np.float32)
    thickness[counts] = (back_m - layers_m[0])[counts] * np.linalg.norm(rays, axis=1)
    return thickness
