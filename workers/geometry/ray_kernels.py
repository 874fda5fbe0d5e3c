"""The compiled loops of the ray caster: which pixels to cast, their rays, exact distances, and which hit is nearer."""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.frames import dot
from workers.geometry.jit import compiled


@compiled
def row_spans(
    u: Array, v: Array, faces: NDArray[np.integer], width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(first [H], end [H]): the columns of each row between the outermost edges of faces [F, 3], a pixel more on each side.

    u, v [V]: image coordinates of corners, pixels. An edge counts in the rows above and below its own too; rows that no
    edge comes near have end <= first.
    """
    first, end = np.full(height, width, np.int64), np.zeros(height, np.int64)
    for f in range(len(faces)):
        for corner in range(3):
            a, b = faces[f, corner], faces[f, (corner + 1) % 3]
            if v[a] > v[b]:
                a, b = b, a
            top, bottom = max(math.floor(v[a]) - 1.0, 0.0), min(math.ceil(v[b]) + 1.0, float(height))
            for row in range(int(top), int(bottom)):
                one, other = u[a], u[b]
                if v[b] - v[a] > 1.0:  # the part of the edge in this row and the two beside it
                    slope = (u[b] - u[a]) / (v[b] - v[a])
                    one = u[a] + slope * (max(row - 1.0, v[a]) - v[a])
                    other = u[a] + slope * (min(row + 2.0, v[b]) - v[a])
                left, right = math.floor(min(one, other)) - 1.0, math.ceil(max(one, other)) + 1.0
                first[row] = min(first[row], int(min(max(left, 0.0), float(width))))
                end[row] = max(end[row], int(min(max(right, 0.0), float(width))))
    return first, end


@compiled
def pixels_between(first: NDArray[np.int64], end: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """Flat numbers, ascending, of the pixels from column `first` [H] up to and without `end` [H] of each row."""
    pixels = np.empty(np.maximum(end - first, 0).sum(), np.int64)
    n = 0
    for row in range(len(first)):
        for column in range(first[row], end[row]):
            pixels[n] = row * width + column
            n += 1
    return pixels


@compiled
def pixel_rays(
    pixels: NDArray[np.int64], width: int, k: tuple[float, float, float, float], near_m: float
) -> tuple[Array, Array]:
    """(origins, directions), each [N, 3]: rays with z = 1 through the centres of pixels, from the near plane on.

    k: fx, fy, cx, cy. As `unproject` has them, in the camera's frame.
    """
    origins, directions = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
    for n in range(len(pixels)):
        row, column = pixels[n] // width, pixels[n] % width
        x, y = (column + 0.5 - k[2]) / k[0], (row + 0.5 - k[3]) / k[1]
        directions[n, 0], directions[n, 1], directions[n, 2] = x, y, 1.0
        origins[n, 0], origins[n, 1], origins[n, 2] = near_m * x, near_m * y, near_m
    return origins, directions


@compiled
def meet_planes(
    face: NDArray[np.int32], planes: tuple[Array, Array], origins: Array, directions: Array, grazing: float
) -> tuple[Array, Array, int]:
    """(distance, cosine, n): where rays [N, 3] meet the planes of faces [N], and how many of them a plane does not fix.

    planes: normals [F, 3] and offsets [F]. Distances, in lengths of the direction, are inf for face -1, and nan where the
    cosine of incidence is at most `grazing`.
    """
    normals, offsets = planes
    distance, cosine, open_ended = np.full(len(face), np.inf), np.zeros(len(face)), 0
    for n in range(len(face)):
        f = face[n]
        if f < 0:
            continue
        towards = dot(normals[f], directions[n])
        cosine[n] = abs(towards) / math.sqrt(dot(directions[n], directions[n]))
        if cosine[n] > grazing:
            distance[n] = (offsets[f] - dot(normals[f], origins[n])) / towards
        else:
            distance[n] = np.nan
            open_ended += 1
    return distance, cosine, open_ended


@compiled
def keep_nearer(
    best: tuple[Array, NDArray[np.uint8], NDArray[np.float32]],
    rays: NDArray[np.int64],
    found: tuple[Array, Array],
    region_id: int,
    apart_m: float,
    grazing: float,
) -> None:
    """Writes hits that are nearer than the best by more than `apart_m` along the normal over these, in place.

    best: distance, region and incidence_cos of all rays; found: distance and cosine [N] of the rays with the numbers `rays`.
    """
    distance, cosine = found
    for n in range(len(rays)):
        slant = grazing if cosine[n] < grazing else cosine[n]
        if distance[n] + apart_m / slant < best[0][rays[n]]:
            best[0][rays[n]], best[1][rays[n]], best[2][rays[n]] = distance[n], region_id, cosine[n]
