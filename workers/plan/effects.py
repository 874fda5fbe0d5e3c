"""What a scene calls for: which effects run, which do not, and why. Data in one table, one entry an effect.

The plan is made from the scene as it is drawn, before anything moves; the kinds are explained in effect.py. To add an
effect, add an entry with its kind, predicate, cost and stage, let the step that it belongs to ask the plan, and give it
its three tests (tests/effects/): a scene that needs it, one that does not, and the plan's choice on both.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from schemas.base import Array
from schemas.job.job import Job, Tier
from schemas.job.sensor import SensorEffects
from schemas.scene.camera import Camera
from schemas.scene.effects import EffectKind, EffectPlan
from schemas.scene.scene import ScenePlan
from schemas.scene.shape import Part
from workers.cameras.placement import place_aligned_camera, place_mirror_camera
from workers.geometry.frustum import is_outside_views
from workers.geometry.texels import has_holes
from workers.physics.effects import COSTS, PREDICATES
from workers.plan.effect import Effect, Facts
from workers.plan.randomness import Stream, stream

Reason = Callable[[Facts], str | None]


def plan_effects(facts: Facts, forced: frozenset[str] = frozenset()) -> EffectPlan:
    """Which effects this scene calls for; those `forced` run in any case. Raises ValueError where one cannot be forced."""
    _require_forcible(forced)
    reasons = {effect.name: effect.skipped_because(facts) for effect in EFFECTS}
    skipped = {name: why for name, why in reasons.items() if why is not None and name not in forced}
    return EffectPlan(tuple(name for name in reasons if name not in skipped), skipped, forced)


def is_raycast_scene(job: Job, scene_id: int) -> bool:
    """Whether this scene belongs to the share that is checked against the ray caster: a function of seed and id."""
    return bool(stream(job.seed, scene_id, Stream.RAYCAST_CHECK).random() < job.check.raycast_share)


def write_receipt(plan: EffectPlan, called: Iterable[str] = ()) -> tuple[list[str], list[dict[str, str]]]:
    """(names of the effects that ran, [{effect, why}] of those that did not), in the table's order.

    `called` names effects that the plan had left out and that were found to be called for after all: they ran.
    """
    late = frozenset(called)
    ran = [effect.name for effect in EFFECTS if plan.runs(effect.name) or effect.name in late]
    return ran, [{"effect": name, "why": why} for name, why in plan.skipped.items() if name not in late]


def names_of_kind(kind: str) -> frozenset[str]:
    """The names of all effects of one kind."""
    return frozenset(effect.name for effect in EFFECTS if effect.kind == kind)


def _require_forcible(forced: frozenset[str]) -> None:
    names, asked = {effect.name for effect in EFFECTS}, names_of_kind("asked")
    if forced - names:
        raise ValueError(f"no effects of these names: {', '.join(sorted(forced - names))}")
    if forced & asked:
        raise ValueError(f"switches of the job, which cannot be forced: {', '.join(sorted(forced & asked))}")


# ------------------------------------------------------------------------------------------- switches of the job


def _switch(key: str) -> Reason:
    """An effect that a key of the job switches on and off."""

    def why(facts: Facts) -> str | None:
        branch: Any = facts.job
        for name in key.split("."):
            branch = getattr(branch, name)
        return None if branch else f"{key} is false"

    return why


def _first_of(*reasons: Reason) -> Reason:
    """The first reason that holds."""
    return lambda facts: next((why for reason in reasons if (why := reason(facts)) is not None), None)


def _splat(facts: Facts) -> str | None:
    return "images.projection.splat is 1" if facts.job.images.projection.splat == 1 else None


def _hidden_points(facts: Facts) -> str | None:
    asked = facts.job.images.projection.hidden_point_removal
    return None if asked else "images.projection.hidden_point_removal is off"


def _samples(facts: Facts) -> str | None:
    return "render.samples is 1" if facts.job.render.samples == 1 else None


def _raycast(facts: Facts) -> str | None:
    return None if facts.raycast_checked else "not in the share check.raycast_share"


def _sensor(name: str) -> Reason:
    """A sensor effect runs in every scene where the job asks for it."""
    return lambda facts: f"sensor.{name} is off" if getattr(facts.job.sensor, name) is None else None


def _tier(*tiers: Tier) -> Reason:
    """An effect of colour that belongs to these tiers."""
    return lambda facts: None if facts.job.render.tier in tiers else f"render.tier is {facts.job.render.tier}"


_DEPTH_CAMERA, _MIRROR = _switch("cameras.depth.enabled"), _switch("cameras.mirror.enabled")
_PROJECTION, _RGB = _switch("images.projection.enabled"), _switch("render.rgb")


# ------------------------------------------------------------------------------------------- exact no-ops


def _parts(plan: ScenePlan) -> Iterator[Part]:
    for shape in (plan.floor, plan.table.asset.shape, *(start.asset.shape for start in plan.objects)):
        yield from shape.parts


def _textures(facts: Facts) -> str | None:
    textured = any(part.uv is not None and part.material.texture is not None for part in _parts(facts.plan))
    return None if textured else "no surface has a texture"


def _transparency(facts: Facts) -> str | None:
    holes = any(part.uv is not None and has_holes(part.material.texture) for part in _parts(facts.plan))
    return None if holes else "no texture has clear texels"


def _floor(facts: Facts) -> str | None:
    return None if _seen(facts, facts.plan.floor.vertices) else "outside of every view"


def _table(facts: Facts) -> str | None:
    low, high = facts.plan.table.mesh.vertices.min(axis=0), facts.plan.table.mesh.vertices.max(axis=0)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    return None if _seen(facts, corners) else "outside of every view"


def _seen(facts: Facts, points: Array) -> bool:
    """Whether any view may see something of the convex hull of points [N, 3], world."""
    return any(not is_outside_views(points, cameras) for cameras in _views(facts.job, facts.plan))


def _views(job: Job, plan: ScenePlan) -> Iterator[tuple[Camera, ...]]:
    """Every camera of the scene. The mirror's place follows from a depth that is not drawn yet: both ends of its way."""
    for camera in plan.input_cameras:
        yield (camera,)
        yield (place_aligned_camera(camera, job.cameras.depth),)
        yield tuple(place_mirror_camera(camera, d_z, job.cameras.mirror) for d_z in job.images.depth_range_m)


def _exact_agreement(facts: Facts) -> str | None:
    return "stored depth is exact: sensor.depth_noise is off" if facts.job.sensor.depth_noise is None else None


def _of_physics(name: str) -> Effect:
    """An effect of physics, whose predicate looks at objects, table and settings alone."""

    def skipped_because(facts: Facts) -> str | None:
        return PREDICATES[name](facts.plan.objects, facts.plan.table, facts.job.physics)

    kind: EffectKind = "asked" if name == "restitution" else "approximation"
    return Effect(name, kind, skipped_because, COSTS[name], "physics")


PHYSICS_EFFECTS: tuple[Effect, ...] = tuple(_of_physics(name) for name in PREDICATES)

EFFECTS: tuple[Effect, ...] = (
    *PHYSICS_EFFECTS,
    Effect("depth_camera", "asked", _DEPTH_CAMERA, "a third view", "render"),
    Effect("mirror", "asked", _MIRROR, "a second view", "render"),
    Effect("projection", "asked", _PROJECTION, "the input's cloud carried over", "projection"),
    Effect("splat", "asked", _first_of(_PROJECTION, _splat), "several pixels a point", "projection"),
    Effect(
        "hidden_point_removal",
        "asked",
        _first_of(_PROJECTION, _hidden_points),
        "normals of the input's cloud",
        "projection",
    ),
    Effect("rgb", "asked", _RGB, "colour in every view", "render"),
    Effect("shadows", "asked", _first_of(_RGB, _tier("raster", "pathtraced")), "one shadow map a scene", "render"),
    Effect("ambient_occlusion", "asked", _first_of(_RGB, _tier("raster")), "two level maps a scene", "render"),
    Effect("antialiasing", "asked", _first_of(_RGB, _tier("raster", "pathtraced")), "1 to 2 ms a view", "render"),
    Effect("samples", "asked", _first_of(_RGB, _tier("raster"), _samples), "three more draws of edges", "render"),
    Effect("global_illumination", "asked", _first_of(_RGB, _tier("pathtraced")), "seconds a view", "render"),
    Effect("glass", "asked", _first_of(_RGB, _tier("pathtraced")), "longer paths", "render"),
    *(
        Effect(f"sensor_{name}", "asked", _sensor(name), "an image pass", "sensor")
        for name in SensorEffects.model_fields
    ),
    Effect("raycast_check", "asked", _raycast, "every view cast by rays: 0.2 s", "raycast"),
    Effect("release_again", "asked", _raycast, "a second of simulation", "recheck"),
    Effect("floor", "no_op", _floor, "a draw in each view", "render"),
    Effect("table", "no_op", _table, "a draw in each view", "render"),
    Effect("textures", "no_op", _first_of(_RGB, _textures), "a look-up for each fragment", "render"),
    # In tier flat there is nothing to force: it has no such pass. The path tracer has it in its materials.
    Effect(
        "transparency",
        "no_op",
        _first_of(_RGB, _tier("raster", "pathtraced"), _transparency),
        "two more draws a view",
        "render",
    ),
    Effect(
        "light_maps", "no_op", _first_of(_RGB, _tier("raster")), "maps of shadow and openness, once a scene", "render"
    ),
    Effect(
        "exact_agreement", "no_op", _first_of(_MIRROR, _exact_agreement), "the two views compared once more", "check"
    ),
)
"""Every effect there is. A receipt names them in this order."""
