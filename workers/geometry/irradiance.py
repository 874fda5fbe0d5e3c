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
class Lobe:
    """A bright part: direction [3] unit, color [3], the radiance of a white surface that faces it, and the angle across it."""

    direction: Array
    color: Array
    size_rad: float


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


@dataclass(frozen=True, eq=False)
class FittedLight:
    """terms [TERMS, 3]: irradiance / pi of a whole map; its bright parts as lights, and terms of each of them."""

    terms: Array
    lobes: tuple[Lobe, ...]
    of_lobes: tuple[Array, ...]

    def without(self, count: int) -> Array:
        """[TERMS, 3]: what is left beside the first so many lights: together they are all of the light."""
        return np.asarray(self.terms - sum(self.of_lobes[:count], np.zeros((TERMS, 3))), np.float64)


def fit_light(radiance: Map, most: int) -> FittedLight:
    """A map's irradiance as harmonics and lights, those that give most to a level surface first.

    Of a wide bright part a light takes what the harmonics cannot hold, by least squares; of a small one all.
    """
    from scipy.optimize import lsq_linear  # a fifth of a second, of maps alone

    small, normals = reduce_map(radiance, WORK_PX), even_directions(FIT_NORMALS)
    parts, light = _bright_parts(radiance, small, most), irradiance(small, normals)
    basis, level = polynomials(normals), light @ LUMINANCE
    weight = 1.0 / np.maximum(light, 0.02 * light.max(axis=0))
    columns = [(p.color @ LUMINANCE) * np.maximum(normals @ p.direction, 0.0) for p in parts]
    least = [0.999 if p.size_rad < SMALL_RAD else 0.0 for p in parts]
    bounds = [-np.inf] * TERMS + least, [np.inf] * TERMS + [1.0] * len(parts)
    matrix, green = np.column_stack([basis, *columns]), weight[:, 1]
    shares = lsq_linear(matrix * green[:, None], level * green, bounds).x[TERMS:].tolist()
    lobes = [Lobe(p.direction, share * p.color, p.size_rad) for p, share in zip(parts, shares, strict=True)]
    strong = (lobe for lobe in lobes if lobe.color @ LUMINANCE > LEAST_SHARE * level.mean())
    lobes = sorted(strong, key=lambda lobe: -float(lobe.color @ LUMINANCE * lobe.direction[2]))
    inverses = [np.linalg.pinv(basis * weight[:, c : c + 1]) * weight[:, c] for c in range(3)]

    def fit(values: Array) -> Array:
        return np.stack([inverse @ values[:, c] for c, inverse in enumerate(inverses)], axis=1)

    of_lobes = [fit(np.outer(np.maximum(normals @ lobe.direction, 0.0), lobe.color)) for lobe in lobes]
    return FittedLight(fit(light), tuple(lobes), tuple(of_lobes))


def _bright_parts(radiance: Map, small: Map, most: int) -> list[Lobe]:
    """The strongest connected bright parts, each with all of its light."""
    times = len(radiance) // len(small)
    light, angle, directions = radiance @ LUMINANCE, solid_angles(len(radiance)), map_directions(len(radiance))
    left, small_angle = small @ LUMINANCE, np.broadcast_to(solid_angles(len(small)), small.shape[:2])
    least, dark, parts = LEAST_SHARE * float((light * angle).sum()), np.zeros(left.shape, np.bool_), list[Lobe]()
    while len(parts) < most:
        mean = np.average(left[~dark], weights=small_angle[~dark])
        labels = _connected(left > BRIGHT * mean)
        energy = np.bincount(labels.ravel(), (left * small_angle).ravel())
        energy[0] = 0.0
        strongest = int(energy.argmax())
        if energy[strongest] < least:
            break
        dark |= labels == strongest
        left[labels == strongest] = 0.0
        inside = np.kron(labels == strongest, np.ones((times, times), np.bool_))
        weight, pixels = (angle * np.ones_like(light))[inside], radiance[inside].astype(np.float64)
        towards = (directions[inside] * (light[inside] * weight)[:, None]).sum(axis=0)
        flux = light[inside] @ weight
        towards /= np.linalg.norm(towards)
        color = (pixels * (weight * np.maximum(directions[inside] @ towards, 0.0))[:, None]).sum(axis=0) / math.pi
        size_rad = 2.0 * math.sqrt(flux**2 / (light[inside] ** 2 @ weight) / math.pi)
        parts.append(Lobe(towards.astype(np.float64), color, size_rad))
    return parts


def _connected(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """[H, W] int32 labels, from 1, of what hangs together in a mask whose left and right edges meet, over gaps of two pixels."""
    closed = cv2.dilate(mask.view(np.uint8), np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(closed, connectivity=8, ltype=cv2.CV_32S)
    labels = np.asarray(labels, np.int32) * mask
    for here, there in zip(labels[:, 0].tolist(), labels[:, -1].tolist(), strict=True):
        if here and there:
            labels[labels == there] = here
    return labels
