"""What is measured of objects at rest: from their meshes, their poses and the table's, not from the simulator."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import ConvexHull

from schemas.base import Array
from schemas.scene.scene import ObjectStart, Settled, Table
from workers.geometry.frames import transform

Z = np.array([0.0, 0.0, 1.0])

SAME_PLANE = 1e-9
"""Of cosines and metres, between triangles of one face."""


class Made(Protocol):
    """Objects at release, and their table."""

    @property
    def starts(self) -> tuple[ObjectStart, ...]: ...

    @property
    def table(self) -> Table: ...


Rest = Sequence[Settled]


@dataclass(frozen=True)
class Measure:
    """A figure with its unit and the most that it may be."""

    what: str
    bound: float
    of: Callable[[Made, Rest], float]


def coms(made: Made, rest: Rest | None = None) -> Array:
    """[N, 3] metres: the centres of mass, z from the table's top, at rest or else where they are let go."""
    placed: Sequence[ObjectStart | Settled] = rest or made.starts
    pairs = zip(made.starts, placed, strict=True)
    found = [transform(each.T_world_obj, start.asset.mass.com[None, :])[0] for start, each in pairs]
    return np.array(found) - [0.0, 0.0, made.table.top.height_m]


# ---------------------------------------------------------------------------------------------- angles


def angle_deg(rest: Settled, axis: Array = Z) -> float:
    """Between an axis of the object and the vertical."""
    return math.degrees(math.acos(float(np.clip((rest.T_world_obj[:3, :3] @ axis)[2], -1.0, 1.0))))


def tilt(bound_deg: float, body: int = 0) -> Measure:
    """Between the object's z axis and the vertical."""
    return Measure("tilt from upright, deg", bound_deg, lambda _, rest: angle_deg(rest[body]))


def flat(bound_deg: float, body: int = 0) -> Measure:
    """Between the object's z axis and the vertical, either way up."""

    def off(_: Made, rest: Rest) -> float:
        return min(angle_deg(rest[body]), 180.0 - angle_deg(rest[body]))

    return Measure("tilt from flat, deg", bound_deg, off)


def leaning(expected_deg: Callable[[], float], bound_deg: float, axis: Array = Z, body: int = 0) -> Measure:
    """Between the angle of an axis to the vertical and what it must be."""
    return Measure(
        "tilt off what it must be, deg", bound_deg, lambda _, rest: abs(angle_deg(rest[body], axis) - expected_deg())
    )


def tilts(*expected_deg: float, bound_deg: float) -> Measure:
    """Between the angle of each object's z axis to the vertical and what it must be: the worst."""

    def off(_: Made, rest: Rest) -> float:
        return max(abs(angle_deg(one) - wanted) for one, wanted in zip(rest, expected_deg, strict=True))

    return Measure("worst tilt off what it must be, deg", bound_deg, off)


def on_a_face(bound_deg: float = 0.1, body: int = 0) -> Measure:
    """Between the vertical and the nearest face of the object's hull that has the centre of mass over it."""

    def off(made: Made, rest: Rest) -> float:
        down = rest[body].T_world_obj[:3, :3].T @ -Z
        normals = stable_faces(made.starts[body])
        return math.degrees(math.acos(float(np.clip((normals @ down).max(), -1.0, 1.0))))

    return Measure("tilt from a face to stand on, deg", bound_deg, off)


def stable_faces(start: ObjectStart) -> Array:
    """[N, 3] outward normals, in the object's frame, of the faces on which it can stand on a level."""
    asset = start.asset
    hull = ConvexHull(asset.shape.vertices - asset.mass.com)
    planes, found = hull.equations, []
    for k, plane in enumerate(planes):
        same = (planes[:, :3] @ plane[:3] > 1.0 - SAME_PLANE) & (np.abs(planes[:, 3] - plane[3]) < SAME_PLANE)
        if np.flatnonzero(same)[0] != k:
            continue
        if any(_is_inside(hull.points[triangle], plane) for triangle in hull.simplices[same]):
            found.append(plane[:3])
    return np.array(found)


def _is_inside(corners: Array, plane: Array) -> bool:
    """Whether the foot of the centre of mass, the origin, is within a triangle of this plane."""
    foot = -plane[3] * plane[:3]
    turns = [float(np.cross(corners[(k + 1) % 3] - corners[k], foot - corners[k]) @ plane[:3]) for k in range(3)]
    return all(each >= -1e-12 for each in turns) or all(each <= 1e-12 for each in turns)


# ---------------------------------------------------------------------------------------------- places


def shift(bound_mm: float, body: int = 0) -> Measure:
    """How far the centre of mass went sideways."""

    def off(made: Made, rest: Rest) -> float:
        return float(np.linalg.norm((coms(made, rest) - coms(made))[body, :2])) * 1e3

    return Measure("sideways from the start, mm", bound_mm, off)


def apart(bound_mm: float) -> Measure:
    """How far the farthest went sideways from where it was let go."""

    def farthest(made: Made, rest: Rest) -> float:
        return float(np.linalg.norm((coms(made, rest) - coms(made))[:, :2], axis=1).max()) * 1e3

    return Measure("farthest sideways from the start, mm", bound_mm, farthest)


def moved(bound_mm: float) -> Measure:
    """How far the centre of mass that moved most is from where it was let go, any way."""

    def farthest(made: Made, rest: Rest) -> float:
        return float(np.linalg.norm(coms(made, rest) - coms(made), axis=1).max()) * 1e3

    return Measure("farthest from the start, mm", bound_mm, farthest)


def height(expected_m: float, bound_mm: float, body: int = 0) -> Measure:
    """How far the centre of mass is from the height above the table's top at which it must be."""
    return Measure(
        "height off what it must be, mm", bound_mm, lambda made, rest: abs(coms(made, rest)[body, 2] - expected_m) * 1e3
    )


def heights(*expected_m: float, bound_mm: float = 0.1) -> Measure:
    """The same of every object: the worst."""

    def off(made: Made, rest: Rest) -> float:
        return float(np.abs(coms(made, rest)[:, 2] - expected_m).max()) * 1e3

    return Measure("worst height off what it must be, mm", bound_mm, off)


def below(height_m: float, body: int) -> Measure:
    """Height of a centre of mass above the table's top."""
    return Measure("height of what must be down, mm", height_m * 1e3, lambda made, r: coms(made, r)[body, 2] * 1e3)


def beside(bound_mm: float, body: int = 1, other: int = 0) -> Measure:
    """Sideways between the centres of mass of two objects."""

    def off(made: Made, rest: Rest) -> float:
        found = coms(made, rest)
        return float(np.linalg.norm((found[body] - found[other])[:2])) * 1e3

    return Measure("sideways from the other, mm", bound_mm, off)


def bounces_for(drop_m: float, restitution: float) -> Measure:
    """Between the time to rest of what falls straight down and bounces, and the sum of its flights.

    The first takes t = sqrt(2 h / g), each further one 2 t times a power of the contact's restitution. The last window of rest
    takes up to 0.25 s more, a ball of flat faces rocks for another 0.06 s, and what is slower than 0.05 m/s does not bounce,
    which is as long at 0.99.
    """
    seconds = math.sqrt(2.0 * drop_m / 9.81) * (1.0 + restitution) / (1.0 - restitution)
    return Measure(
        "seconds off the sum of its flights",
        0.08 * seconds + 0.35,
        lambda _, rest: abs(max(one.settle_s for one in rest) - seconds),
    )


def both(*measures: Measure) -> Measure:
    """Several at once: the one that is worst against its bound, as a share of it."""
    return Measure(
        "; ".join(each.what for each in measures) + ": worst share of the bounds",
        1.0,
        lambda made, rest: max(each.of(made, rest) / each.bound for each in measures),
    )
