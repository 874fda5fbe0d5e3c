"""Light from all directions: equirectangular maps, their irradiance by harmonics, and the bright parts that cast shadows. Pure.

Maps are [H, 2 H, 3] linear RGB radiance: rows from the zenith to the nadir, the middle column +x, columns to its right clockwise
from above. Irradiance is stated as the radiance of a white surface, that is divided by pi.
"""

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array

Map = NDArray[np.float32]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear RGB (IEC 61966-2-1)."""

BRIGHT = 4.0
"""A part whose luminance is this many times the mean of the rest is a light of its own."""

LEAST_SHARE = 0.01
"""Of all light: a part with less stays in the harmonics."""

TERMS, FIT_NORMALS = 18, 600

SMALL_RAD = 0.1
"""A bright part that is not wider is a light as a whole."""

WORK_PX = 128
"""Height at which bright parts are looked for: 1.4 degrees a pixel."""


@dataclass(frozen=True, eq=False)
class LightMap:
    """A map, and its irradiance / pi as terms [TERMS, 3] of `polynomials`, of which lights stand for K bright parts.

    towards [K, 3] unit; colors [K, 3], radiance of a white surface that faces each; sizes_rad [K]; of_lights [K, TERMS, 3].
    """

    radiance: Map
    terms: Array
    towards: Array
    colors: Array
    sizes_rad: Array
    of_lights: Array


def map_directions(height: int) -> Map:
    """[H, 2 H, 3] float32 unit: the direction of the middle of each pixel."""
    fall = (np.arange(height, dtype=np.float32) + np.float32(0.5)) * np.float32(math.pi / height)
    turn = np.float32(math.pi) - (np.arange(2 * height, dtype=np.float32) + np.float32(0.5)) * np.float32(
        math.pi / height
    )
    level, up = np.sin(fall)[:, None], np.cos(fall)[:, None]
    return np.stack([np.cos(turn) * level, np.sin(turn) * level, np.broadcast_to(up, (height, 2 * height))], axis=2)


def solid_angles(height: int) -> Array:
    """[H, 1]: the solid angle of a pixel of each row."""
    edges = np.cos(np.arange(height + 1) * (math.pi / height))
    return ((edges[:-1] - edges[1:]) * (math.pi / height))[:, None]


def reduce_map(radiance: Map, height: int) -> Map:
    """A map of another height; pixels are means by solid angle where it shrinks, so that no light is lost."""
    size = (2 * height, height)
    if height >= len(radiance):
        return np.asarray(cv2.resize(radiance, size, interpolation=cv2.INTER_LINEAR), np.float32)
    weight = solid_angles(len(radiance)).astype(np.float32)
    weighed = cv2.resize(radiance * weight[..., None], size, interpolation=cv2.INTER_AREA)
    weights = cv2.resize(weight, (1, height), interpolation=cv2.INTER_AREA)
    return np.asarray(weighed / np.reshape(weights, (height, 1, 1)), np.float32)


def polynomials(n: NDArray) -> NDArray:
    """[N, TERMS]: x, y, z and the products of four of them, for unit vectors [N, 3].

    They span the harmonics of orders 0, 1, 2 and 4. Lambert's cosine has none of order 3 (Ramamoorthi and Hanrahan 2001).
    """
    fours = [np.prod(n[:, list(axes)], axis=1) for axes in combinations_with_replacement(range(3), 4)]
    return np.column_stack([n, *fours])


def turn_polynomials(terms: Array, R: Array) -> Array:
    """The terms [TERMS, 3] in axes that R [3, 3] takes theirs to."""
    n = even_directions(4 * TERMS)
    return np.asarray(np.linalg.lstsq(polynomials(n), polynomials(n @ R) @ terms, rcond=None)[0], np.float64)


def even_directions(count: int) -> Array:
    """[count, 3] unit: a Fibonacci lattice."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    level = np.sqrt(1.0 - z * z)
    return np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)


def irradiance(radiance: Map, normals: Array) -> Array:
    """[N, 3]: irradiance / pi on surfaces of normals [N, 3], summed over the pixels of a small map."""
    height = len(radiance)
    cosine = np.maximum(normals.astype(np.float32) @ map_directions(height).reshape(-1, 3).T, np.float32(0.0))
    weighed = (radiance * (solid_angles(height)[..., None] / math.pi)).reshape(-1, 3)
    return cosine.astype(np.float64) @ weighed


def fit_light(radiance: Map, most: int) -> LightMap:
    """A map's irradiance as harmonics and at most so many lights, those that give most to a level surface first.

    Of a wide bright part a light takes what the harmonics cannot hold, by least squares; of a small one all.
    """
    from scipy.optimize import lsq_linear  # a fifth of a second, of maps alone

    small, normals = reduce_map(radiance, WORK_PX), even_directions(FIT_NORMALS)
    towards, colors, sizes = _bright_parts(radiance, small, most)
    light, basis, facing = irradiance(small, normals), polynomials(normals), np.maximum(normals @ towards.T, 0.0)
    level, weight = light @ LUMINANCE, 1.0 / np.maximum(light, 0.02 * light.max(axis=0))
    bounds = np.array([[-np.inf, np.inf]] * TERMS + [[0.999 * (size < SMALL_RAD), 1.0] for size in sizes]).T
    matrix = np.column_stack([basis, facing * (colors @ LUMINANCE)]) * weight[:, 1:2]
    colors = colors * lsq_linear(matrix, level * weight[:, 1], bounds).x[TERMS:, None]
    bright = colors @ LUMINANCE
    order = [k for k in np.argsort(-bright * towards[:, 2]) if bright[k] > LEAST_SHARE * level.mean()]
    inverses = [np.linalg.pinv(basis * weight[:, c : c + 1]) * weight[:, c] for c in range(3)]
    terms = np.stack([inverse @ light[:, c] for c, inverse in enumerate(inverses)], axis=1)
    of_lights = np.stack([(inverse @ facing).T * colors[:, c : c + 1] for c, inverse in enumerate(inverses)], axis=2)
    return LightMap(radiance, terms, towards[order], colors[order], sizes[order], of_lights[order])


def _bright_parts(radiance: Map, small: Map, most: int) -> tuple[Array, Array, Array]:
    """(towards [K, 3], colors [K, 3], sizes_rad [K]) of the strongest connected bright parts, each with all of its light."""
    times, angle = len(radiance) // len(small), solid_angles(len(radiance)) * np.ones((1, 2 * len(radiance)))
    light, directions = radiance @ LUMINANCE, map_directions(len(radiance)).astype(np.float64)
    left, small_angle = small @ LUMINANCE, np.broadcast_to(solid_angles(len(small)), small.shape[:2])
    least, dark, parts = LEAST_SHARE * float((light * angle).sum()), np.zeros(left.shape, np.bool_), list[Array]()
    while len(parts) < most:
        labels = _connected(left > BRIGHT * np.average(left[~dark], weights=small_angle[~dark]))
        energy = np.bincount(labels.ravel(), (left * small_angle).ravel())
        energy[0] = 0.0
        part = labels == energy.argmax()
        if energy.max() < least:
            break
        dark |= part
        left[part] = 0.0
        inside = np.kron(part, np.ones((times, times), np.bool_))
        n, weight, bright = directions[inside], angle[inside], light[inside]
        middle = (bright * weight) @ n
        middle /= np.linalg.norm(middle)
        color = (weight * np.maximum(n @ middle, 0.0)) @ radiance[inside].astype(np.float64) / math.pi
        size_rad = 2.0 * math.sqrt((bright @ weight) ** 2 / (bright**2 @ weight) / math.pi)
        parts.append(np.array([*middle, *color, size_rad]))
    table = np.array(parts).reshape(-1, 7)
    return table[:, :3], table[:, 3:6], table[:, 6]


def _connected(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """[H, W] int32 labels, from 1, of what hangs together in a mask whose left and right edges meet, over gaps of two pixels."""
    closed = cv2.dilate(mask.view(np.uint8), np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(closed, connectivity=8, ltype=cv2.CV_32S)
    labels = np.asarray(labels, np.int32) * mask
    for here, there in zip(labels[:, 0].tolist(), labels[:, -1].tolist(), strict=True):
        if here and there:
            labels[labels == there] = here
    return labels
