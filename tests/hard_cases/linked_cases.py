"""Rows of the table of chaotic cases: what is linked or threaded, and may not come apart; a seed turns and leans it."""

import itertools
from collections.abc import Sequence

import numpy as np
import trimesh

from schemas.base import Array
from schemas.scene.shape import Asset
from tests.hard_cases.bodies import rod
from tests.hard_cases.drops import X, Y, level, turn
from tests.hard_cases.groups import Group, place, together
from tests.hard_cases.measures import Made, Measure, Rest, Z
from tests.kit.shapes import asset_of
from workers.geometry.frames import pose, transform, uniform_rotation

RING_M, POINTS = 0.03, 400
"""Radius of the axis of a ring of wire, and the points of it that its linking is summed over."""

FALL_M, ROD_M = 0.1, 0.2


def ring(wire_m: float) -> Asset:
    """A ring of round wire about z."""
    wire = trimesh.creation.torus(RING_M, wire_m / 2, major_sections=48, minor_sections=16)
    return asset_of(wire, mass_kg=0.05)


def circle() -> Array:
    """[N, 3]: the axis of a ring."""
    angle = 2.0 * np.pi * np.arange(POINTS) / POINTS
    return RING_M * np.stack([np.cos(angle), np.sin(angle), np.zeros(POINTS)], axis=1)


def linking(one: Array, other: Array) -> float:
    """The linking number of two closed lines of points [N, 3], by Gauss's integral over the middles of their edges."""
    along, across = (np.roll(line, -1, axis=0) - line for line in (one, other))
    apart = (one + along / 2)[:, None] - (other + across / 2)[None]
    volumes = np.einsum("ijk,ijk->ij", np.cross(along[:, None], across[None]), apart)
    return float((volumes / np.linalg.norm(apart, axis=2) ** 3).sum() / (4.0 * np.pi))


def rod_line() -> Array:
    """[N, 3]: a rod's axis along z, closed by a square 100 times as wide as a ring beside it."""
    far_m = 100.0 * RING_M
    corners = np.array([[0, -ROD_M / 2], [0, ROD_M / 2], [0, far_m], [far_m, far_m], [far_m, -far_m], [0, -far_m]])
    sides = [
        np.linspace(a, b, POINTS, endpoint=False) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    line = np.concatenate(sides)
    return np.stack([line[:, 0], np.zeros(len(line)), line[:, 1]], axis=1)


def stay_linked(*lines: Array) -> Measure:
    """How far the linking numbers of neighbours are from those at release: the worst."""

    def links(poses: Sequence[Array]) -> Array:
        at = [transform(T, line) for T, line in zip(poses, lines, strict=True)]
        return np.array([linking(one, other) for one, other in itertools.pairwise(at)])

    def worst(made: Made, rest: Rest) -> float:
        before = links([one.T_world_obj for one in made.starts])
        return float(np.abs(links([one.T_world_obj for one in rest]) - np.rint(before)).max())

    return Measure("linking number off what it was", 0.5, worst)


def let_fall(assets: Sequence[Asset], poses: Sequence[Array], R: Array) -> Group:
    """The objects as they are linked, turned together by R [3, 3]; their lowest point 100 mm up."""
    table, turned = level(), [pose(R, np.zeros(3)) @ T for T in poses]
    low_m = min(transform(T, one.shape.vertices)[:, 2].min() for one, T in zip(assets, turned, strict=True))
    starts = [
        place(one, table, T[:3, 3] + [0.0, 0.0, FALL_M - low_m], T[:3, :3])
        for one, T in zip(assets, turned, strict=True)
    ]
    return together(table, starts)


def chain(wire_m: float, count: int, seed: int) -> Group:
    """Rings, each across the one before; as they are for seed 0, where the second lands on its rim, else turned any way."""
    step_m = RING_M if count == 2 else 1.4 * RING_M
    poses = [pose(turn(X, 90.0 * (k % 2)), np.array([k * step_m, 0.0, 0.0])) for k in range(count)]
    R = np.eye(3) if seed == 0 else uniform_rotation(np.random.default_rng(seed))
    return let_fall([ring(wire_m)] * count, poses, R)


def threaded(seed: int) -> Group:
    """A ring of 4 mm about the middle of a rod of 10 mm, 200 mm long, that lies to within 15 degrees."""
    rng = np.random.default_rng(seed)
    lying = turn(Z, rng.uniform(0.0, 360.0)) @ turn(Y, 90.0 + rng.uniform(-15.0, 15.0))
    around = pose(turn(Y, 20.0), np.array([0.02, 0.0, 0.0]))
    return let_fall([ring(0.004), rod(0.005, ROD_M)], [around, np.eye(4)], lying)
