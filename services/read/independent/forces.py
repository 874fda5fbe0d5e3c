"""Static equilibrium of a stored scene, from its contact forces alone: weights, levers, friction and reaction."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from services.read.independent.derive import TABLE, Array, Row

GRAVITY_M_S2 = 9.81

SHARE = 0.01
"""Of a weight, or of a weight at the lever of the farthest contact: what may be without balance."""

ROUNDING = 1e-9
"""Of a weight: what the order of sums leaves."""


def check_forces(job: Mapping[str, Any], scene: Row) -> Iterator[str]:
    """What the forces of a scene's contacts do not explain, a sentence each."""
    bodies = scene["bodies"]
    if not bodies or job.get("captures") is not None or not job["physics"]["exact_rest"]:
        return
    friction = job["physics"]["friction"] ** 2
    for body in bodies:
        for fault in _check_body(body, friction):
            yield f"scene {scene['scene_id']}, region {body['region_id']}: {fault}"
    yield from (f"scene {scene['scene_id']}: {fault}" for fault in _check_reactions(bodies))


def _check_body(body: Row, friction: float) -> Iterator[str]:
    contacts = body["contacts"]
    if not contacts:
        yield "nothing holds it"
        return
    force, normal, point = (np.array([contact[name] for contact in contacts]) for name in ("force", "normal", "point"))
    weight, lever = body["mass_kg"] * GRAVITY_M_S2, point - np.array(body["com"])
    left = np.linalg.norm(force.sum(axis=0) - [0.0, 0.0, weight]) / weight
    turning = np.linalg.norm(np.cross(lever, force).sum(axis=0)) / (weight * np.linalg.norm(lever, axis=1).max())
    if not left <= SHARE:
        yield f"its contact forces leave {left:.1%} of its weight over"
    if not turning <= SHARE:
        yield f"its contact forces turn it, by {turning:.1%} of its weight at the lever of its farthest contact"
    if not np.allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-9):
        yield "a normal of a contact has not the length 1"
    pressed = (force * normal).sum(axis=1)
    slipping = np.linalg.norm(force - pressed[:, None] * normal, axis=1)
    if (pressed < -ROUNDING * weight).any():
        yield "a contact pulls"
    if (slipping > friction * pressed + ROUNDING * weight).any():
        yield f"a contact needs more than its friction of {friction:g}"


def _check_reactions(bodies: list[Row]) -> Iterator[str]:
    """Two bodies press one another with one force at one point."""
    found = dict[tuple[int, int], Array]()
    for body in bodies:
        for contact in body["contacts"]:
            if contact["with_region"] != TABLE:
                pair = (body["region_id"], contact["with_region"])
                total = found.setdefault(pair, np.zeros(3))
                total += contact["force"]
    for (one, other), force in found.items():
        back = found.get((other, one), np.zeros(3))
        if not np.allclose(force, -back, rtol=1e-9, atol=1e-9):
            yield f"region {one} presses region {other} with another force than that region it"
