"""The independent judge of things at rest: overlap by booleans, hover by least distances, balance by a linear program.

It shares no code with what it judges: it reads meshes, masses and centres of mass, and computes the rest by itself from
numpy, scipy, manifold3d and python-fcl. docs/rest.md defines the figures.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Mesh
from tests.judge.contacts import find_contacts
from tests.judge.nearest import boxes_apart_m, distance_m
from tests.judge.overlap import overlap_m
from tests.judge.statics import GROUND, Body, Touch, unbalanced_shares
from tests.judge.surface import Surface, surface

BAND_M = 1e-5
"""Distance or overlap up to which surfaces count as touching in the balance of forces: the bound on both."""


@dataclass(frozen=True, eq=False)
class Thing:
    """One thing at rest: its mesh in world coordinates, its mass, and its centre of mass [3] in world coordinates."""

    mesh: Mesh
    mass_kg: float
    com: Array


@dataclass(frozen=True)
class Verdict:
    """What is wrong with one thing's rest.

    overlap_mm: the depth to which it is inside the ground or another thing; hover_mm: its distance to the nearest of them,
    0 where it meets one; unbalanced: the share of its weight, or of weight times size, that no contact forces balance.
    """

    overlap_mm: float
    hover_mm: float
    unbalanced: float


def judge(things: Sequence[Thing], ground: Mesh, friction: float | Sequence[float]) -> tuple[Verdict, ...]:
    """A verdict on each thing. Gravity is along -z.

    friction: the coefficient of each contact; or of each thing, and last of the ground: a contact has the product of two.
    """
    surfaces = [surface(each.mesh) for each in things]
    everything = [*surfaces, surface(ground)]
    overlaps, hovers = np.zeros(len(everything)), np.full(len(everything), np.inf)
    touches = []
    for i, j in itertools.combinations(range(len(everything)), 2):
        a, b = everything[i], everything[j]
        apart = boxes_apart_m(a, b)
        if apart <= BAND_M:
            deep_m = overlap_m(a, b)
            overlaps[[i, j]] = np.maximum(overlaps[[i, j]], deep_m)
            mu = friction if isinstance(friction, float) else friction[i] * friction[j]
            touches.append(Touch(i, j if j < len(things) else GROUND, find_contacts(a, b, BAND_M, deep_m), mu))
        if apart < max(hovers[i], hovers[j]):
            hovers[[i, j]] = np.minimum(hovers[[i, j]], distance_m(a, b))
    bodies = [Body(each.mass_kg, each.com, _size_m(of)) for each, of in zip(things, surfaces, strict=True)]
    shares = unbalanced_shares(bodies, touches)
    figures = zip(overlaps[:-1] * 1e3, hovers[:-1] * 1e3, shares, strict=True)
    return tuple(Verdict(*map(float, three)) for three in figures)


def _size_m(of: Surface) -> float:
    """The longest side of the bounding box."""
    return float(np.ptp(of.bounds, axis=0).max())
