"""Drops by the plan beside drops with every effect of physics forced, from the same starts, by kind of scene."""

from collections.abc import Iterable
from functools import cache
from typing import Any

from schemas.base import Pose
from tests.effects.physics_scenes import settled
from tests.effects.scenes import Setting, facts_of
from workers.scene.effects import Facts, names_of_kind, plan_effects

NEAR_THE_EDGE, SPREAD = {"offset_m": [-0.6, 0.6]}, {"objects_per_scene": 5}

KINDS: dict[str, dict[str, Any]] = {
    "upright": {},
    "upright near the edge": {"start": NEAR_THE_EDGE},
    "upright, five spread": SPREAD,
}
"""What differs from a job's defaults, in all eight categories; nothing is drawn again."""


@cache
def facts_like(kind: str, scene_id: int) -> Facts:
    """A scene of a kind as it is drawn. Raises SceneError."""
    categories = ["bottle", "camera", "can", "jar", "laptop", "mug", "bowl", "box"]
    return facts_of(Setting({"categories": categories, **KINDS[kind]}, scene_id=scene_id))


def ends(facts: Facts, forced: Iterable[str] = ()) -> list[Pose]:
    """`T_world_obj` of every object at rest, by the plan with these effects forced. Raises SettleError."""
    return [rest.T_world_obj for rest in settled(facts, plan_effects(facts, frozenset(forced))).settled]


def left_out(facts: Facts) -> list[str]:
    """The effects of physics that the plan leaves out although a scene may be made with them."""
    return sorted(names_of_kind("approximation") & plan_effects(facts).skipped.keys())
