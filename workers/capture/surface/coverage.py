"""Which part of a surface its views saw only at grazing angles, and from where another view would see it better."""

import math
from collections.abc import Mapping

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.assets.samples import draw_points
from workers.capture.surface.posed_view import CLEAR_M, UNSEEN, best_cosine
from workers.geometry.mesh import face_planes
from workers.geometry.raycast import Caster

GRAZING_DEG = 70.0
"""Angle of incidence beyond which depth has three times the noise that it has at 0, and little of it is merged."""

WELL_DEG = 55.0
"""A view helps where it sees the surface at less."""

LEAST_SHARE = 0.015
"""The user is told of more, where another view sees so much better: rims and edges of a well-seen object come to less."""

SAMPLES = 2_000

SEED = 20_240_801
"""Of the surface samples, so that the same capture has the same figures."""

ELEVATIONS_DEG, SECTORS = (10, 25, 40, 55, 70, 85), 12
"""Where another view may stand, about the object: angles above the board, each all around in so many steps."""


def sample_surface(mesh: Mesh, count: int) -> tuple[Array, Array]:
    """(points, unit normals), each [N, 3]: evenly over the area, the same for the same mesh."""
    chance = np.random.default_rng(SEED).uniform(size=(3, count))
    chance[0] = (np.arange(count) + chance[0]) / count  # one in each of N equal shares of the area
    face, _, points = draw_points(mesh, chance)
    return points, face_planes(mesh)[0][face]


def describe_grazing(mesh: Mesh, cameras: Mapping[int, Camera]) -> str | None:
    """A sentence about what of a mesh in the board frame no camera sees at less than `GRAZING_DEG`, and where one would.

    None where that is little, or no other view would see it better. `cameras` by the number of their view, at least one.
    """
    (points, normals), caster = sample_surface(mesh, SAMPLES), Caster(mesh)
    cosine = best_cosine(caster, points, normals, list(cameras.values()))
    seen = cosine > UNSEEN
    grazing = seen & (cosine <= math.cos(math.radians(GRAZING_DEG)))
    least = max(LEAST_SHARE * seen.sum(), 1.0)
    advice = _advice(caster, (points[grazing], normals[grazing]), cameras, least) if grazing.sum() >= least else None
    if advice is None:
        return None
    words = f"{grazing.sum() / seen.sum():.0%} of the surface that the views see was seen only at more than"
    return f"{words} {GRAZING_DEG:g} degrees from its normal, and what goes on from there may be missing: {advice}"


def _advice(caster: Caster, at: tuple[Array, Array], cameras: Mapping[int, Camera], least: float) -> str | None:
    """Where other views see most of the points with normals `at` well, by height and the nearest view; None for under `least`."""
    points, normals = at
    middle, places = points.mean(axis=0), np.array([camera.position for camera in cameras.values()])
    distance_m = float(np.median(np.linalg.norm(places - middle, axis=1)))
    elevation, turn = np.meshgrid(np.radians(ELEVATIONS_DEG), 2.0 * np.pi * np.arange(SECTORS) / SECTORS, indexing="ij")
    ways = np.stack([np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), np.sin(elevation)], axis=-1)
    towards = (middle + distance_m * ways)[:, :, None] - points  # [elevations, sectors, N, 3]
    cosine = (towards * normals).sum(axis=-1) / np.linalg.norm(towards, axis=-1)
    sees = cosine > math.cos(math.radians(WELL_DEG))
    starts = np.broadcast_to(points + CLEAR_M * normals, towards.shape)[sees]
    sees[sees] = caster.cast(starts, towards[sees])[0] > 1.0
    level = int(np.argmax(sees.sum(axis=(1, 2))))
    if sees[level].any(axis=0).sum() < least:
        return None
    around, side = sees[level].sum(axis=1), " all around"
    if (around > 0.5 * around.max()).mean() < 0.6:
        best = ways[level, int(np.argmax(around)), :2]
        off = places[:, :2] - middle[:2]
        numbers = list(cameras)
        side = f" on the side of view {numbers[int(np.argmax(off @ best / np.linalg.norm(off, axis=1)))]}"
    return f"add views about {ELEVATIONS_DEG[level]} degrees above the board{side}"
