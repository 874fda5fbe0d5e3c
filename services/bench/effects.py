"""`verso bench --effects N`, time of settling by plan and with effects forced; `--targets N`, of scenes with image targets."""

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np

from schemas.base import Array
from schemas.errors import RunError, SceneError
from schemas.job.job import Job
from schemas.job.views import ViewTarget
from services.bench.figures import Spread, describe_head, describe_machine, format_spread, pinned
from workers.assets.catalogue import open_catalogue
from workers.physics.effects import called_for
from workers.physics.settle import settle_scene
from workers.scene.chance import SceneChance
from workers.scene.context import Stopwatch, open_worker
from workers.scene.effects import PHYSICS_EFFECTS, Facts, plan_effects
from workers.scene.make_scene import make_scene
from workers.scene.plan import plan_scene, pouring_of
from workers.scene.rows import record_scene

ROUNDS = 3
"""Timed rounds, after one round that fills the caches."""

EFFECTS = tuple(effect.name for effect in PHYSICS_EFFECTS if effect.kind == "approximation")

PLAN, WHOLE, EVERYTHING = "plan", "all but decomposition", "all"
"""Names of the variants: by the plan, and with every approximation forced, once as hulls and once as convex parts."""

FORCED: dict[str, frozenset[str]] = {
    PLAN: frozenset(),
    WHOLE: frozenset(EFFECTS) - {"decomposition"},
    EVERYTHING: frozenset(EFFECTS),
    **{name: frozenset({name}) for name in EFFECTS},
}
"""Forced effects by the variant's name; an effect's own name stands for the plan and that effect."""


TARGETS: dict[str, tuple[ViewTarget, ...]] = {
    "none": (),
    **{name: (name,) for name in get_args(ViewTarget)},
    "all": get_args(ViewTarget),
}
"""Image targets by the variant's name."""


def measure_effects(job: Job, job_folder: Path, count: int) -> dict[str, Any]:
    """Time settling of the job's first scenes. Raises RunError where no scene settles."""
    with pinned() as core:
        context = open_worker(job, open_catalogue(job.assets, job_folder, tuple(job.categories)))
        planned = []
        for scene_id in range(job.first_scene, job.first_scene + count):
            with contextlib.suppress(SceneError):
                plan = plan_scene(job, context.catalogue, SceneChance(job.seed, scene_id))
                planned.append(Facts(job, plan, raycast_checked=False))
        timed = time_settling(planned, ROUNDS)
        return {"machine": describe_machine(context.renderer.name), "core": core, **summarise(*timed)}


def time_settling(scenes: Sequence[Facts], rounds: int) -> tuple[dict[str, Array], dict[str, int]]:
    """Settle each scene in each variant in turn. Raises RunError where no scene settles both by plan and with all forced.

    Returns by variant the seconds of processor, [rounds, scenes], nan where the plan has the effect or settling failed; and
    how often settling failed. What goes by the plan includes the choice of effects.
    """
    seconds = {name: np.full((rounds + 1, len(scenes)), np.nan) for name in FORCED}
    failed = dict.fromkeys(FORCED, 0)
    for lap, (number, facts), name in product(range(rounds + 1), enumerate(scenes), FORCED):
        if lap and np.isnan(seconds[name][0, number]):
            continue
        if name in EFFECTS and name not in plan_effects(facts).skipped:
            continue
        plan, scene, physics = plan_effects(facts, FORCED[name]), facts.plan, facts.job.physics
        pouring = pouring_of(facts.job.start, SceneChance(facts.job.seed, scene.scene_id), scene)
        began = time.process_time()
        if name not in (WHOLE, EVERYTHING):
            called_for(scene.objects, scene.table, physics)
        try:
            settle_scene(scene, physics, plan, pouring)
            seconds[name][lap, number] = time.process_time() - began
        except SceneError:
            failed[name] += 1
    timed = {name: found[1:] for name, found in seconds.items()}
    if not _compared(timed).any():
        raise RunError(f"none of {len(scenes)} scenes comes to rest both by its plan and with every effect forced")
    return timed, failed


def _compared(seconds: Mapping[str, Array]) -> Array:
    """[scenes] bool: scenes that settle by plan and with all forced."""
    return ~np.any([np.isnan(seconds[name]).any(axis=0) for name in (PLAN, WHOLE, EVERYTHING)], axis=0)


def summarise(seconds: Mapping[str, Array], failed: Mapping[str, int]) -> dict[str, Any]:
    """Milliseconds a scene, the share of time that the plan saves, and the cost of each effect."""
    both = _compared(seconds)
    plan = seconds[PLAN][:, both]
    forced = {}
    for name in (WHOLE, EVERYTHING):
        own = seconds[name][:, both]
        saved = 1.0 - plan.sum(axis=1) / own.sum(axis=1)
        forced[name] = {**_side(own), "saved": asdict(Spread.of(saved.tolist()))}
    return {
        "scenes": int(both.sum()),
        "rounds": len(plan),
        "plan": _side(plan),
        "forced": forced,
        "effects": {name: _cost(seconds[name], seconds[PLAN]) for name in EFFECTS},
        "failed": dict(failed),
    }


def _side(seconds: Array) -> dict[str, float]:
    """Median and mean over scenes of each scene's median over rounds; seconds are [rounds, scenes]."""
    each = np.median(seconds, axis=0) * 1e3
    return {"median_ms": float(np.median(each)), "mean_ms": float(each.mean())}


def _cost(own: Array, plan: Array) -> dict[str, Any]:
    """Extra time of a forced effect in scenes whose plan leaves it out; None where there are none."""
    both = ~(np.isnan(own) | np.isnan(plan)).any(axis=0)
    more = (1e3 * (own - plan)[:, both].mean(axis=1)).tolist() if both.any() else []
    return {"scenes": int(both.sum()), "more_ms": asdict(Spread.of(more)) if more else None}


def describe(figures: dict[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    lines = [
        *describe_head(figures),
        f"measured   settling of {figures['scenes']} scenes, {figures['rounds']} times in each way in turn on core "
        f"{figures['core']}, caches warm; ms of processor a scene, median (mean)",
        "",
        f"{'by the plan':34} {_ms(figures['plan'])}",
    ]
    for name, side in figures["forced"].items():
        lines.append(f"{name + ' forced':34} {_ms(side)}   the plan saves {format_spread(side['saved'], '.1%')}")
    for name, cost in figures["effects"].items():
        told = "every scene calls for it"
        if (more := cost["more_ms"]) is not None:
            spread = f"[{more['least']:+.1f} to {more['most']:+.1f}]"
            told = f"{more['median']:+8.1f} {spread} a scene, in {cost['scenes']} scenes"
        lines.append(f"  {'plan and ' + name:32} {told}")
    failed = [f"{name} {count}" for name, count in figures["failed"].items() if count]
    return [*lines, f"did not come to rest: {', '.join(failed) or 'none'}"]


def _ms(side: Mapping[str, float]) -> str:
    return f"{side['median_ms']:8.1f} ({side['mean_ms']:.1f})"


def measure_targets(job: Job, job_folder: Path, count: int) -> dict[str, Any]:
    """Time the job's first scenes, made and encoded, without image targets, with each and with all of them, in turn.

    Raises RunError where no scene is made.
    """
    with pinned() as core:
        catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories))
        contexts = {
            name: open_worker(
                job.model_copy(update={"targets": job.targets.model_copy(update={"views": views, "shape": ()})}),
                catalogue,
            )
            for name, views in TARGETS.items()
        }
        seconds = {name: np.full((ROUNDS + 1, count), np.nan) for name in TARGETS}
        for lap, number, name in product(range(ROUNDS + 1), range(count), TARGETS):
            began, watch = time.process_time(), Stopwatch()
            with contextlib.suppress(SceneError):
                record_scene(contexts[name], make_scene(contexts[name], job.first_scene + number, watch), watch)
                seconds[name][lap, number] = time.process_time() - began
        machine = describe_machine(contexts["none"].renderer.name)
    return {"machine": machine, "core": core, **summarise_targets({name: each[1:] for name, each in seconds.items()})}


def summarise_targets(seconds: Mapping[str, Array]) -> dict[str, Any]:
    """Milliseconds a scene, and in each round the median of scenes' ratios to the same without targets; [rounds, scenes] each."""
    made = np.asarray(~np.isnan(seconds["none"]).any(axis=0))
    if not made.any():
        raise RunError(f"none of {made.size} scenes could be made")
    ratios = {name: np.median(each[:, made] / seconds["none"][:, made], axis=1) for name, each in seconds.items()}
    sides = {
        name: {**_side(each[:, made]), "ratio": asdict(Spread.of(ratios[name].tolist()))}
        for name, each in seconds.items()
    }
    return {"scenes": int(made.sum()), "rounds": len(seconds["none"]), "targets": sides}


def describe_targets(figures: dict[str, Any]) -> list[str]:
    """The figures of `measure_targets` as text, line by line."""
    return [
        *describe_head(figures),
        f"measured   {figures['scenes']} scenes, made and encoded, {figures['rounds']} times with each in turn on core "
        f"{figures['core']}, caches warm; ms of processor a scene, median (mean)",
        "",
        *(
            f"{name:12} {_ms(side)}   {format_spread(side['ratio'])} times a scene without"
            for name, side in figures["targets"].items()
        ),
    ]
