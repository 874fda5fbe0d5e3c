"""Keys that choose what falls and whether it is corrected: each does what it says, and the defaults stay as they were."""

import math

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from schemas.job.physics import Collision, Physics
from schemas.scene.scene import ObjectStart
from tests.kit.shapes import asset_of, box, table
from tests.physics.settling import settle_single
from workers.geometry.frames import angle_between, pose, rotation_about
from workers.geometry.hull import convex_hull
from workers.physics.effects import PREDICATES, called_for
from workers.physics.support import place_table

PHYSICS = Job(name="t").physics
TABLE = place_table(table())
TOP = TABLE.top.height_m
UPRIGHT = np.eye(3)
LYING = rotation_about(np.array([1.0, 0.0, 0.0]), math.pi / 2)
CAN = asset_of(trimesh.creation.cylinder(0.04, 0.12, sections=48))
TRAY = asset_of(box(0.2, 0.2, 0.05).difference(box(0.18, 0.18, 0.05).apply_translation([0, 0, 0.01])))


def with_(**changes: object) -> Physics:
    return Physics.model_validate({**PHYSICS.model_dump(), **changes})


def start_of(asset, turn=UPRIGHT, height: float = 0.1) -> ObjectStart:
    hull = convex_hull(asset.shape.vertices)
    low = float((hull.vertices @ turn.T)[:, 2].min())
    return ObjectStart(asset, hull, 3, pose(turn, np.array([0.0, 0.0, TOP + height - low])), 0, False)


def test_a_can_that_falls_as_a_box_comes_to_lie_on_a_side_of_the_box():
    """A can on its side would roll to one of its 48 facets; its box lies on its own face, and does not roll."""
    turned = rotation_about(np.array([0.0, 1.0, 0.0]), math.radians(20.0)) @ LYING
    rest = settle_single(start_of(CAN, turned), TABLE, with_(collision="box"))
    moved = angle_between(rest.T_world_obj[:3, :3], turned)
    assert math.degrees(moved) == pytest.approx(20.0, abs=4.0)
    own = settle_single(start_of(CAN, turned), TABLE, PHYSICS)
    assert math.degrees(angle_between(own.T_world_obj[:3, :3], turned)) < 10.0


@pytest.mark.parametrize(
    ("collision", "why"),
    [
        ("planned", "over a flat top an object touches with its hull alone"),
        ("hull", "physics.collision is hull"),
        ("box", "physics.collision is box"),
        ("parts", None),
    ],
)
def test_convex_parts_are_called_for_as_the_key_says(collision: Collision, why: str | None):
    start, physics = start_of(TRAY), with_(collision=collision)
    assert PREDICATES["decomposition"]((start,), TABLE, physics) == why
    assert ("decomposition" in called_for((start,), TABLE, physics)) == (why is None)


def test_parts_of_what_is_convex_are_never_called_for():
    assert PREDICATES["decomposition"]((start_of(CAN),), TABLE, with_(collision="parts")) == "every object is convex"


def test_without_exact_rest_an_object_stays_where_the_simulator_left_it():
    """Bullet leaves what rests some micrometres deep or tilted; with exact rest nothing of that is left."""
    tilted = rotation_about(np.array([0.8, 0.6, 0.0]), math.radians(3.0))
    for asset in (CAN, TRAY):
        raw = settle_single(start_of(asset, tilted, 0.005), TABLE, with_(exact_rest=False))
        corrected = settle_single(start_of(asset, tilted, 0.005), TABLE, PHYSICS)
        assert 0.0 < raw.penetration_mm + raw.hover_gap_mm < 0.1
        assert corrected.penetration_mm + corrected.hover_gap_mm < 1e-9
        assert np.abs(corrected.T_world_obj[2, :3]).max() == pytest.approx(1.0, abs=1e-12)
        assert np.abs(raw.T_world_obj[2, :3]).max() == pytest.approx(1.0, abs=1e-5)
