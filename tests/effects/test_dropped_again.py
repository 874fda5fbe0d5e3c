"""What is skipped must not matter from the start on: drops by the plan against drops with every effect of physics forced.

A drop is chaotic: two that differ by a rounding may end apart. What must agree is how far things go on average and on which
face they rest. The shapes are chosen against the plan: they tip from side to side, roll, slide and stand on edges.
"""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from schemas.errors import SceneError
from services.read.audit import MOST_WAY, Drops
from tests.effects.physics_scenes import facts_with, settled
from tests.hard_cases.drops import drop, level
from tests.kit.shapes import asset_of
from workers.geometry.frames import transform
from workers.physics.effects import PREDICATES
from workers.scene.effects import plan_effects

MOST_FACES = 0.1
"""Largest change of the share that rests on its commonest face."""


def cylinder(radius_m, height_m, sides):
    return trimesh.creation.cylinder(radius=radius_m, height=height_m, sections=sides)


def egg():
    ball = trimesh.creation.icosphere(subdivisions=3)
    return ball.apply_scale((0.02, 0.02, 0.027))


SHAPES = {
    "nut": lambda: cylinder(0.01, 0.008, 6),
    "pencil": lambda: cylinder(0.004, 0.1, 6),
    "prism of eight sides": lambda: cylinder(0.015, 0.05, 8),
    "coin": lambda: cylinder(0.012, 0.002, 48),
    "domino": lambda: trimesh.creation.box((0.024, 0.048, 0.0075)),
    "cone": lambda: trimesh.creation.cone(radius=0.03, height=0.06, sections=32),
    "ring": lambda: trimesh.creation.annulus(r_min=0.015, r_max=0.02, height=0.006, sections=32),
    "egg": egg,
    "thin plate": lambda: trimesh.creation.box((0.1, 0.1, 0.003)),
    "box": lambda: trimesh.creation.box((0.05, 0.08, 0.12)),
}


@pytest.mark.parametrize(
    "drops", [pytest.param(40, marks=pytest.mark.minute), pytest.param(200, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.timeout(1200)
def test_what_was_skipped_changes_neither_how_far_things_go_nor_on_which_face_they_rest(name, drops, record_figure):
    asset, found, heights = asset_of(SHAPES[name]()), Drops(), []
    for seed in range(drops):
        facts = facts_with(drop(asset, level(), 0.05, Rotation.random(rng=seed).as_matrix()))
        try:
            ends = [
                settled(facts, plan).settled[0].T_world_obj
                for plan in (plan_effects(facts), plan_effects(facts, frozenset(PREDICATES) - {"restitution"}))
            ]
        except SceneError:
            found.lost += 1
            continue
        found.add(facts.plan.objects, ends[:1], ends[1:])
        heights.append([transform(T, asset.mass.com[None, :])[0, 2] for T in ends])
    faces = np.round(np.array(heights) * 2e3)  # half a millimetre apart
    values, counts = np.unique(faces, return_counts=True)
    rests = faces == values[counts.argmax()]
    change = rests[:, 1].astype(float) - rests[:, 0]
    error = 2.0 * change.std() / np.sqrt(len(change))
    record_figure(
        f"{name}: mean way with every effect, share of its size", "none may", float(np.mean(found.longer)), MOST_WAY
    )
    record_figure(
        f"{name}: share on its commonest face with every effect", "none may", float(change.mean()), MOST_FACES
    )
    assert found.lost <= 0.1 * drops
    assert abs(np.mean(found.longer)) <= MOST_WAY, found.describe()
    assert abs(change.mean()) - error <= MOST_FACES
