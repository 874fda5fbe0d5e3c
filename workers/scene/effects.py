"""What a scene or a simulated capture calls for: one table of effects, one row an effect, and the plan. Pure.

The plan is made from the scene as it is drawn, before anything moves; the kinds are explained in schemas/scene/scene.py.
To add an effect: add a row with its kind, predicate and stage, let the step that it belongs to ask the plan, and
give it its two scenes (tests/effects/cases.py) and its proof (tests/effects/proofs.py).
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np

from schemas.base import Array
from schemas.dataset.layout import SWITCHES, PixelKind, is_stored
from schemas.job.captures import Simulate
from schemas.job.job import Check, Job
from schemas.job.look import OF_COLOUR, OFF
from schemas.job.views import SensorEffects, Tier, ViewTarget
from schemas.scene.scene import EffectKind, EffectPlan, ScenePlan
from schemas.scene.shape import Part
from schemas.scene.view import VIEW_ROLES, Camera, Role
from workers.geometry.camera import is_outside_views
from workers.geometry.colour import has_holes
from workers.physics.effects import ONLY_LATE, PREDICATES
from workers.scene.cameras import place_beside, place_mirror_camera
from workers.scene.chance import SceneChance, Stream


@dataclass(frozen=True, eq=False)
class Facts:
    """What an effect's predicate may look at: the scene as it is drawn, before anything moves or is rendered."""

    job: Job
    plan: ScenePlan
    raycast_checked: bool


Reason = Callable[[Facts], str | None]
"""Why a scene does not call for an effect; None where it does."""

CaptureReason = Callable[[Simulate], str | None]
"""Why a simulated capture does not call for an effect; None where it does."""


@dataclass(frozen=True, eq=False)
class Effect:
    """A row of the table of effects: its predicates, and the stage that its time is counted in."""

    name: str
    kind: EffectKind
    skipped_because: Reason | None
    """Of scenes; None where they do not have the effect, or where no scene is known to call for it before it runs."""
    stage: str
    in_captures: CaptureReason | None = None
    """Of simulated captures; None where they do not have it."""


def plan_effects(facts: Facts, forced: frozenset[str] = frozenset()) -> EffectPlan:
    """Which effects this scene calls for; those `forced` run in any case. Raises ValueError where one cannot be forced."""
    if unknown := forced - {effect.name for effect in EFFECTS}:
        raise ValueError(f"no effects of these names: {', '.join(sorted(unknown))}")
    if asked := forced & names_of_kind("asked"):
        raise ValueError(f"switches of the job, which cannot be forced: {', '.join(sorted(asked))}")
    reasons = {effect.name: why(facts) for effect in EFFECTS if (why := effect.skipped_because) is not None}
    for name in names_of_kind("no_op"):
        reason = reasons[name]
        if reason is not None and not reason.startswith(UNFORCED):  # where there is nothing to force
            reasons[name] = f"{reason}; proof: exact, forced it changes no byte"
    # Not in the receipt of a job without them, which is then as it was before there were any.
    unasked = set(get_args(ViewTarget)) if not facts.job.targets.views else set()
    unasked |= {"further_views"} if not facts.job.cameras.more and not _is_studio(facts) else set()
    unasked |= {"alpha"} if not _is_studio(facts) else set()
    unasked |= {"kept_poses"} if facts.job.scenes_from is None else set()
    left = {name for name, branch in BRANCHES.items() if not facts.job.look.asks_for(branch)}
    unasked |= left if left >= BRANCHES.keys() - {"recolour"} else set()
    return _plan({name: why for name, why in reasons.items() if name not in unasked}, forced)


def plan_capture(simulate: Simulate) -> EffectPlan:
    """Which effects a simulated capture runs, and why each of the others does not."""
    return _plan({effect.name: why(simulate) for effect in TABLE if (why := effect.in_captures) is not None})


def _plan(reasons: Mapping[str, str | None], forced: frozenset[str] = frozenset()) -> EffectPlan:
    """The plan that follows from why each effect is not called for; None where it is."""
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
    ran = [effect.name for effect in TABLE if plan.runs(effect.name) or effect.name in late]
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


STUDIO, KEPT = "scene is studio", "poses of scenes_from are kept"
UNFORCED = (STUDIO, KEPT)
"""Begin the reasons of effects that a scene has no use for, which cannot be forced."""


def _is_studio(facts: Facts) -> bool:
    """Whether the object stands alone, on nothing."""
    return facts.job.scene == "studio"


def _on_ground(why_not: str, reason: Reason | None = None) -> Reason:
    """An effect that a studio scene has no use for; of others it is skipped for `reason`."""
    return lambda facts: f"{STUDIO}: {why_not}" if _is_studio(facts) else reason(facts) if reason else None


def _in_motion(why_not: str, reason: Reason) -> Reason:
    """An effect of what falls and rests, which a studio scene has no use for, nor one whose poses are kept.

    What falls beside kept objects calls for it where it needs it, once these are measured.
    """
    moved = _on_ground(why_not, reason)

    def skipped(facts: Facts) -> str | None:
        if not facts.plan.kept:
            return moved(facts)
        still = all(start.placed for start in facts.plan.shown)
        return f"{KEPT}: {why_not}" if still else f"{KEPT}, and what falls does not need it"

    return skipped


def _stored(part: Role | PixelKind) -> Reason:
    """An effect that makes a view, or the colour of every view."""
    return _where(lambda facts: is_stored(part, facts.job), f"{SWITCHES[part]} is false")


def _sensor(name: str) -> Reason:
    """A sensor effect, which runs in every scene where the job asks for it."""
    return _where(lambda facts: getattr(facts.job.sensor, name) is not None, f"sensor.{name} is off")


def _target(name: str) -> Reason:
    """An image target, which runs in every scene where the job asks for it."""
    return _where(lambda facts: name in facts.job.targets.views, f"targets.views has no {name}")


def _tier(*tiers: Tier) -> Reason:
    """An effect of colour that belongs to these tiers."""

    def skipped_because(facts: Facts) -> str | None:
        return None if facts.job.render.tier in tiers else f"render.tier is {facts.job.render.tier}"

    return _first_of(_stored("rgb"), skipped_because)


def _look(name: str) -> Reason:
    """A branch of `look`, which runs in every scene where it is not off."""
    branch = BRANCHES[name]
    off = OFF.get(branch)
    return _where(lambda facts: getattr(facts.job.look, branch) != off, f"look.{branch} is {off or 'off'}")


BRANCHES = {
    "recolour": "recolour",
    "floor_cover": "floor",
    "table_cover": "table",
    "backdrop": "background",
    "room": "room",
    "clutter": "clutter",
    "lights": "lights",
    "environment": "environment",
}
"""Effects of surroundings, and the branch of `look` that asks for each."""

_NOT_TRACED = _where(lambda facts: facts.job.render.tier != "pathtraced", "part of global_illumination")
"""Traced paths are shadowed, and spread over a pixel, in any case: nothing of that can be left out."""

_PROJECTION = _stored("projected")
_SPLAT = _where(lambda facts: facts.job.images.projection.splat > 1, "images.projection.splat is 1")
_HIDDEN_POINTS = _where(
    lambda facts: facts.job.images.projection.hidden_point_removal, "images.projection.hidden_point_removal is off"
)
_SAMPLES = _where(lambda facts: facts.job.render.samples > 1, "render.samples is 1")
_RAYCAST = _where(lambda facts: facts.raycast_checked, "not in the share check.raycast_share")

_UNSHADED = _on_ground("its light has no shadows")
_CLEAR = _where(
    lambda facts: not facts.job.has_alpha,
    "studio.background is transparent: alpha has the edges",
)
_ALPHA = _first_of(
    _stored("rgb"),
    _where(lambda facts: facts.job.has_alpha, "studio.background is a colour"),
)

# ------------------------------------------------------------------------------------------- exact no-ops


def _parts(facts: Facts) -> Iterator[Part]:
    plan = facts.plan
    shapes = [start.asset.shape for start in plan.objects]
    if (ground := plan.ground) is not None:
        shapes += [ground.floor, ground.cover or ground.table.asset.shape]
        shapes += [] if ground.walls is None else [ground.walls.shape]
    for shape in shapes:
        yield from shape.parts


_TEXTURES = _where(
    lambda facts: any(part.uv is not None and part.material.texture is not None for part in _parts(facts)),
    "no surface has a texture",
)
_HOLES = _where(
    lambda facts: any(part.uv is not None and has_holes(part.material.texture) for part in _parts(facts)),
    "no texture has clear texels",
)


_GLASS = _where(lambda facts: any(part.material.transmission > 0.0 for part in _parts(facts)), "no surface is of glass")


def _floor(facts: Facts) -> str | None:
    walled = facts.plan.ground is not None and facts.plan.ground.walls is not None  # walls are of the floor's region
    return None if walled else _outside(facts, facts.plan.floor.vertices)


def _table(facts: Facts) -> str | None:
    vertices = facts.plan.table.mesh.vertices
    corners = itertools.product(*zip(vertices.min(axis=0), vertices.max(axis=0), strict=True))
    return _outside(facts, np.array(list(corners)))


def _outside(facts: Facts, points: Array) -> str | None:
    """Whether no view sees anything of the convex hull of points [N, 3], world."""
    if facts.job.cameras.orbit.share is not None or facts.job.cameras.more:
        return None  # where the cameras stand follows from where the objects come to rest
    unseen = all(is_outside_views(points, cameras) for cameras in _views(facts))
    return "outside of every view" if unseen else None


def _views(facts: Facts) -> Iterator[tuple[Camera, ...]]:
    """Every camera of the scene; of the mirror camera, whose d_z is not known yet, the ends of where it may be."""
    job = facts.job
    for camera in facts.plan.input_cameras:
        yield (camera,)
        yield from ((near,) for near in place_beside(camera, job).values())
        ends = itertools.product(job.images.depth_range_m, (0.0, 1.0))
        yield tuple(place_mirror_camera(camera, d_z, job.cameras.mirror, share) for d_z, share in ends)


_NOISY_DEPTH = _where(
    lambda facts: facts.job.sensor.depth_noise is not None, "stored depth is exact: sensor.depth_noise is off"
)


# ------------------------------------------------------------------------------------------- captures


def _always(simulate: Simulate) -> None:
    """An effect of every picture."""


def _of_tier(tier: Tier) -> CaptureReason:
    """An effect of the pictures of one tier."""
    return lambda simulate: None if simulate.tier == tier else f"tier is {simulate.tier}"


def _simulated(name: str) -> CaptureReason:
    """An effect that runs where `captures.simulate` has a branch of this name."""
    return lambda simulate: f"captures.simulate.{name} is off" if getattr(simulate, name) is None else None


# ------------------------------------------------------------------------------------------- the table


def _of_physics(name: str) -> Effect:
    """An effect of physics, whose predicate looks at objects, table and settings alone."""
    kind: EffectKind = "asked" if name == "restitution" else "approximation"
    predicate = PREDICATES[name]

    def skipped_because(facts: Facts) -> str | None:
        return predicate(facts.plan.objects, facts.plan.table, facts.job.physics)

    return Effect(name, kind, _in_motion("nothing falls or rests", skipped_because), "physics")


PHYSICS_EFFECTS: tuple[Effect, ...] = tuple(_of_physics(name) for name in PREDICATES)

CAPTURE_EFFECTS: tuple[str, ...] = tuple(name for name, key in Simulate.model_fields.items() if key.default is None)
"""The branches of `captures.simulate` that are off unless asked for: each switches an effect of its name on."""

_FITS = _where(lambda facts: len(facts.plan.shown) < len(facts.plan.objects), "none of it found room")


def _surroundings(name: str, branch: str) -> Effect:
    """The effect of a branch of `look`."""
    further = {"clutter": (_FITS,), **dict.fromkeys(OF_COLOUR, (_tier("raster", "pathtraced"),))}.get(branch, ())
    return Effect(name, "asked", _first_of(_look(name), *further), "plan")


LOOK_EFFECTS: tuple[Effect, ...] = tuple(_surroundings(name, branch) for name, branch in BRANCHES.items())
"""Surroundings. A receipt names them where the job asks for any but `recolour`, which is named alone."""

TABLE: tuple[Effect, ...] = (
    *PHYSICS_EFFECTS,
    *(Effect(name, "asked", None, "physics") for name in ONLY_LATE),
    Effect(
        "kept_poses",
        "asked",
        _where(lambda facts: facts.plan.kept, "settle is true: objects fall from there"),
        "physics",
    ),
    *(Effect(str(role.effect), "asked", _stored(role.name), "render") for role in VIEW_ROLES.values() if role.beside),
    Effect("mirror", "asked", _stored("mirror"), "render"),
    Effect("projection", "asked", _PROJECTION, "projection"),
    Effect("splat", "asked", _first_of(_PROJECTION, _SPLAT), "projection"),
    Effect("hidden_point_removal", "asked", _first_of(_PROJECTION, _HIDDEN_POINTS), "projection"),
    Effect("rgb", "asked", _stored("rgb"), "render", _always),
    Effect(
        "shadows",
        "asked",
        _first_of(_stored("rgb"), _UNSHADED, _NOT_TRACED, _tier("raster")),
        "render",
        _of_tier("raster"),
    ),
    Effect("ambient_occlusion", "asked", _first_of(_UNSHADED, _tier("raster")), "render", _of_tier("raster")),
    Effect("antialiasing", "asked", _first_of(_stored("rgb"), _NOT_TRACED, _tier("raster")), "render"),
    Effect("samples", "asked", _first_of(_tier("raster"), _CLEAR, _SAMPLES), "render"),
    Effect("global_illumination", "asked", _tier("pathtraced"), "render", _of_tier("pathtraced")),
    Effect("glass", "asked", _first_of(_tier("pathtraced"), _GLASS), "render", _of_tier("pathtraced")),
    *(Effect(name, "asked", _target(name), "targets") for name in get_args(ViewTarget)),
    *(Effect(f"sensor_{name}", "asked", _sensor(name), "sensor") for name in SensorEffects.model_fields),
    Effect("raycast_check", "asked", _RAYCAST, "raycast"),
    Effect("release_again", "asked", _in_motion("nothing rests", _RAYCAST), "recheck"),
    Effect("further_views", "asked", _where(lambda facts: facts.job.cameras.more, "cameras.more is empty"), "render"),
    Effect("alpha", "asked", _ALPHA, "targets"),
    *LOOK_EFFECTS,
    Effect("floor", "no_op", _on_ground("there is no floor", _floor), "render", _always),
    Effect("table", "no_op", _on_ground("there is no table", _table), "render", _always),
    Effect("textures", "no_op", _first_of(_stored("rgb"), _TEXTURES), "render", _always),
    # Tier flat has no such pass that could be forced, and the path tracer has it in its materials.
    Effect("transparency", "no_op", _first_of(_tier("raster", "pathtraced"), _HOLES), "render", _always),
    Effect("light_maps", "no_op", _first_of(_UNSHADED, _tier("raster")), "render", _of_tier("raster")),
    Effect("exact_agreement", "no_op", _first_of(_stored("mirror"), _NOISY_DEPTH), "check"),
    *(Effect(name, "asked", None, "simulate", _simulated(name)) for name in CAPTURE_EFFECTS),
)
"""Every effect there is. A receipt names them in this order."""

EFFECTS: tuple[Effect, ...] = tuple(effect for effect in TABLE if effect.skipped_because is not None)
"""Those of scenes."""
