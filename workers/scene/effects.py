"""What a scene calls for: one table of effects, one entry an effect, and the plan that follows from it. Pure.

The plan is made from the scene as it is drawn, before anything moves; the kinds are explained in schemas/scene/scene.py.
To add an effect: add an entry with its kind, predicate and stage, let the step that it belongs to ask the plan, and
give it its two scenes (tests/effects/cases.py) and its proof (tests/effects/proofs.py).
"""

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.dataset.layout import SWITCHES, PixelKind, is_stored
from schemas.job.job import Check, Job
from schemas.job.views import SensorEffects, Tier
from schemas.scene.scene import EffectKind, EffectPlan, ScenePlan
from schemas.scene.shape import Part
from schemas.scene.view import Camera, Role
from workers.geometry.camera import is_outside_views
from workers.geometry.colour import has_holes
from workers.physics.effects import PREDICATES
from workers.scene.pairs import place_aligned_camera, place_mirror_camera
from workers.scene.plan import SceneChance, Stream


@dataclass(frozen=True, eq=False)
class Facts:
    """What an effect's predicate may look at: the scene as it is drawn, before anything moves or is rendered."""

    job: Job
    plan: ScenePlan
    raycast_checked: bool


Reason = Callable[[Facts], str | None]
"""Why a scene does not call for an effect; None where it does."""


@dataclass(frozen=True, eq=False)
class Effect:
    """An entry of the table of effects: its predicate, and the stage that its time is counted in."""

    name: str
    kind: EffectKind
    skipped_because: Reason
    stage: str


def plan_effects(facts: Facts, forced: frozenset[str] = frozenset()) -> EffectPlan:
    """Which effects this scene calls for; those `forced` run in any case. Raises ValueError where one cannot be forced."""
    if unknown := forced - {effect.name for effect in EFFECTS}:
        raise ValueError(f"no effects of these names: {', '.join(sorted(unknown))}")
    if asked := forced & names_of_kind("asked"):
        raise ValueError(f"switches of the job, which cannot be forced: {', '.join(sorted(asked))}")
    reasons = {effect.name: effect.skipped_because(facts) for effect in EFFECTS}
    skipped = {name: why for name, why in reasons.items() if why is not None and name not in forced}
    return EffectPlan(tuple(name for name in reasons if name not in skipped), skipped, forced)


def is_raycast_scene(check: Check, chance: SceneChance) -> bool:
    """Whether this scene belongs to the share that is checked against the ray caster: a function of seed and id."""
    return bool(chance.stream(Stream.RAYCAST_CHECK).random() < check.raycast_share)


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


# ------------------------------------------------------------------------------------------- switches of the job


def _where(wanted: Callable[[Facts], object], why_not: str) -> Reason:
    """An effect of the scenes for which `wanted` holds."""
    return lambda facts: None if wanted(facts) else why_not


def _first_of(*reasons: Reason) -> Reason:
    """The first reason that holds."""
    return lambda facts: next((why for reason in reasons if (why := reason(facts)) is not None), None)


def _stored(part: Role | PixelKind) -> Reason:
    """An effect that makes a view, or the colour of every view."""
    return _where(lambda facts: is_stored(part, facts.job), f"{SWITCHES[part]} is false")


def _sensor(name: str) -> Reason:
    """A sensor effect, which runs in every scene where the job asks for it."""
    return _where(lambda facts: getattr(facts.job.sensor, name) is not None, f"sensor.{name} is off")


def _tier(*tiers: Tier) -> Reason:
    """An effect of colour that belongs to these tiers."""

    def skipped_because(facts: Facts) -> str | None:
        return None if facts.job.render.tier in tiers else f"render.tier is {facts.job.render.tier}"

    return _first_of(_stored("rgb"), skipped_because)


_NOT_TRACED = _where(lambda facts: facts.job.render.tier != "pathtraced", "part of global_illumination")
"""Traced paths are shadowed, and spread over a pixel, in any case: nothing of that can be left out."""

_PROJECTION = _stored("projected")
_SPLAT = _where(lambda facts: facts.job.images.projection.splat > 1, "images.projection.splat is 1")
_HIDDEN_POINTS = _where(
    lambda facts: facts.job.images.projection.hidden_point_removal, "images.projection.hidden_point_removal is off"
)
_SAMPLES = _where(lambda facts: facts.job.render.samples > 1, "render.samples is 1")
_RAYCAST = _where(lambda facts: facts.raycast_checked, "not in the share check.raycast_share")

# ------------------------------------------------------------------------------------------- exact no-ops


def _parts(facts: Facts) -> Iterator[Part]:
    plan = facts.plan
    for shape in (plan.floor, plan.table.asset.shape, *(start.asset.shape for start in plan.objects)):
        yield from shape.parts


_TEXTURES = _where(
    lambda facts: any(part.uv is not None and part.material.texture is not None for part in _parts(facts)),
    "no surface has a texture",
)
_HOLES = _where(
    lambda facts: any(part.uv is not None and has_holes(part.material.texture) for part in _parts(facts)),
    "no texture has clear texels",
)


def _floor(facts: Facts) -> str | None:
    return _outside(facts, facts.plan.floor.vertices)


def _table(facts: Facts) -> str | None:
    vertices = facts.plan.table.mesh.vertices
    corners = itertools.product(*zip(vertices.min(axis=0), vertices.max(axis=0), strict=True))
    return _outside(facts, np.array(list(corners)))


def _outside(facts: Facts, points: Array) -> str | None:
    """Whether no view sees anything of the convex hull of points [N, 3], world."""
    unseen = all(is_outside_views(points, cameras) for cameras in _views(facts))
    return "outside of every view" if unseen else None


def _views(facts: Facts) -> Iterator[tuple[Camera, ...]]:
    """Every camera of the scene; of the mirror camera, whose d_z is not known yet, the two ends of where it may be."""
    job = facts.job
    for camera in facts.plan.input_cameras:
        yield (camera,)
        yield (place_aligned_camera(camera, job.cameras.depth),)
        yield tuple(place_mirror_camera(camera, d_z, job.cameras.mirror) for d_z in job.images.depth_range_m)


_NOISY_DEPTH = _where(
    lambda facts: facts.job.sensor.depth_noise is not None, "stored depth is exact: sensor.depth_noise is off"
)


# ------------------------------------------------------------------------------------------- the table


def _of_physics(name: str) -> Effect:
    """An effect of physics, whose predicate looks at objects, table and settings alone."""
    kind: EffectKind = "asked" if name == "restitution" else "approximation"
    predicate = PREDICATES[name]
    return Effect(name, kind, lambda f: predicate(f.plan.objects, f.plan.table, f.job.physics), "physics")


PHYSICS_EFFECTS: tuple[Effect, ...] = tuple(_of_physics(name) for name in PREDICATES)

EFFECTS: tuple[Effect, ...] = (
    *PHYSICS_EFFECTS,
    Effect("depth_camera", "asked", _stored("aligned"), "render"),
    Effect("mirror", "asked", _stored("mirror"), "render"),
    Effect("projection", "asked", _PROJECTION, "projection"),
    Effect("splat", "asked", _first_of(_PROJECTION, _SPLAT), "projection"),
    Effect("hidden_point_removal", "asked", _first_of(_PROJECTION, _HIDDEN_POINTS), "projection"),
    Effect("rgb", "asked", _stored("rgb"), "render"),
    Effect("shadows", "asked", _first_of(_stored("rgb"), _NOT_TRACED, _tier("raster")), "render"),
    Effect("ambient_occlusion", "asked", _tier("raster"), "render"),
    Effect("antialiasing", "asked", _first_of(_stored("rgb"), _NOT_TRACED, _tier("raster")), "render"),
    Effect("samples", "asked", _first_of(_tier("raster"), _SAMPLES), "render"),
    Effect("global_illumination", "asked", _tier("pathtraced"), "render"),
    Effect("glass", "asked", _tier("pathtraced"), "render"),
    *(Effect(f"sensor_{name}", "asked", _sensor(name), "sensor") for name in SensorEffects.model_fields),
    Effect("raycast_check", "asked", _RAYCAST, "raycast"),
    Effect("release_again", "asked", _RAYCAST, "recheck"),
    Effect("floor", "no_op", _floor, "render"),
    Effect("table", "no_op", _table, "render"),
    Effect("textures", "no_op", _first_of(_stored("rgb"), _TEXTURES), "render"),
    # Tier flat has no such pass that could be forced, and the path tracer has it in its materials.
    Effect("transparency", "no_op", _first_of(_tier("raster", "pathtraced"), _HOLES), "render"),
    Effect("light_maps", "no_op", _tier("raster"), "render"),
    Effect("exact_agreement", "no_op", _first_of(_stored("mirror"), _NOISY_DEPTH), "check"),
)
"""Every effect there is. A receipt names them in this order."""
