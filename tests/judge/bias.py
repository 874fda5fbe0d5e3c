"""How redraws and refusals bias the poses of piles, beside MuJoCo's drop of the same objects from the same starts.

`python -m tests.judge.bias --scenes 64 --objects 8` prints what docs/rest.md says. Nothing is rendered. MuJoCo's contacts throw
back nothing where the job's do not: with its own rebound, 0.14 of the speed, 8.6 ± 2.5 % of these objects leave the table, and
not 5.5.
"""

import argparse
import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from schemas.base import Array, Pose
from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart
from tests.judge.piles import catalogue_of
from tests.judge.referee import simulate
from workers.geometry.frames import transform
from workers.physics.effects import called_for
from workers.physics.pour import NOTHING_MORE
from workers.physics.settle import settle_scene
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import plan_scene, pouring_of

FALL_S, STEP_S = 2.5, 1e-3
"""What MuJoCo has to bring a scene to rest, and its step; what still rolls by then counts where it is."""

UPRIGHT_DEG = 30.0
"""Largest angle between an object's z axis and the vertical, or its opposite, of what counts as upright or upside down."""


@dataclass(frozen=True)
class Lying:
    """One object at the end: in which scene, whether it is (or was) lost, its tilt, degrees, and its height, mm."""

    scene_id: int
    lost: bool
    tilt_deg: float
    height_mm: float


@dataclass(frozen=True)
class Both:
    """The objects of one scene as it is stored, and as MuJoCo drops them; none stored where the scene is refused."""

    stored: list[Lying]
    dropped: list[Lying]


def lying(scene_id: int, start: ObjectStart, T: Pose, top_m: float, lost: bool) -> Lying:
    """How an object lies at a pose."""
    tilt = math.degrees(math.acos(float(np.clip(T[2, 2], -1.0, 1.0))))
    height_m = float(transform(T, start.asset.mass.com[None, :])[0, 2]) - top_m
    return Lying(scene_id, lost, tilt, 1e3 * height_m)


def try_both(job: Job, scene_id: int) -> Both:
    """Settle a scene as a job does, and drop its objects in MuJoCo."""
    chance = SceneChance(job.seed, scene_id)
    plan = plan_scene(job, catalogue_of(job.model_dump_json()), chance)
    top_m = plan.table.top.height_m
    begun = [one.T_world_obj for one in plan.objects]
    after = simulate(plan, begun, job.physics, FALL_S, STEP_S, rebound=job.physics.restitution > 0.0)
    dropped = [
        lying(scene_id, one, T, top_m, bool(transform(T, one.hull.vertices)[:, 2].max() < top_m))
        for one, T in zip(plan.objects, after, strict=True)
    ]
    effects = EffectPlan(tuple(sorted(called_for(plan.objects, plan.table, job.physics))), {})
    pouring = pouring_of(job.start, chance, plan) if len(plan.objects) > 1 else NOTHING_MORE
    try:
        rest = settle_scene(plan, job.physics, effects, pouring)
    except SceneError:
        return Both([], dropped)
    drawn = {one.region_id: one.redraws for one in plan.objects}
    stored = [
        lying(scene_id, one, at.T_world_obj, top_m, one.redraws > drawn[one.region_id])
        for one, at in zip(rest.starts, rest.settled, strict=True)
    ]
    return Both(stored, dropped)


MEASURES: dict[str, Callable[[Sequence[Lying]], Array]] = {
    "upright": lambda some: np.array([one.tilt_deg <= UPRIGHT_DEG for one in some], dtype=float) * 100.0,
    "upside down": lambda some: np.array([one.tilt_deg >= 180.0 - UPRIGHT_DEG for one in some], dtype=float) * 100.0,
    "on a side": lambda some: (
        np.array([UPRIGHT_DEG < one.tilt_deg < 180.0 - UPRIGHT_DEG for one in some], dtype=float) * 100.0
    ),
    "height, mm": lambda some: np.array([one.height_mm for one in some]),
}
"""Of each object: 100 or 0 of the three classes, and the height of its centre of mass above the table."""


def interval(some: Sequence[Lying], measure: Callable[[Sequence[Lying]], Array]) -> str:
    """The mean and half its interval of 95 %, scenes drawn with replacement."""
    values, scenes = measure(some), np.array([one.scene_id for one in some])
    _, where = np.unique(scenes, return_inverse=True)
    sums, counts = np.bincount(where, values), np.bincount(where)
    picks = np.random.default_rng(0).integers(len(sums), size=(2000, len(sums)))
    low, high = np.percentile(sums[picks].sum(axis=1) / counts[picks].sum(axis=1), (2.5, 97.5))
    return f"{values.mean():.1f} ± {(high - low) / 2:.1f}"


def tabulate(name: str, scenes: Sequence[Both]) -> str:
    """Rows of a Markdown table: MuJoCo's drop, what is stored, and of that what was never drawn again."""
    stored = [one for scene in scenes for one in scene.stored]
    dropped = [one for scene in scenes for one in scene.dropped]
    groups = {
        "MuJoCo's drop, what stays on the table": (dropped, [one for one in dropped if not one.lost]),
        "stored": (stored, stored),
        "of these, never drawn again": (stored, [one for one in stored if not one.lost]),
    }
    refused = sum(not scene.stored for scene in scenes)
    lines = [
        f"{name}: {len(scenes)} scenes, {refused} refused",
        "| | objects | lost, % | " + " | ".join(MEASURES) + " |",
    ]
    for what, (of, some) in groups.items():
        lost = interval(of, lambda them: 100.0 * np.array([one.lost for one in them], dtype=float))
        cells = [what, str(len(some)), lost, *(interval(some, measure) for measure in MEASURES.values())]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Make the scenes of a job with so many objects, by both, and print the table."""
    parser = argparse.ArgumentParser(description="How redraws bias piles, beside MuJoCo's drop of the same objects.")
    parser.add_argument("--job", default="deploy/jobs/pile.yaml", help="the job whose scenes are made")
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--objects", type=int, default=8)
    parser.add_argument("--seed", type=int, default=2024)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    document = yaml.safe_load(Path(given.job).read_text())
    document.pop("verso", None)
    job = Job.model_validate(document | {"objects_per_scene": given.objects, "seed": given.seed})
    with ProcessPoolExecutor(given.processes) as pool:
        scenes = list(pool.map(functools.partial(try_both, job), range(given.scenes)))
    print(tabulate(f"{job.name}, {given.objects} objects, seed {given.seed}", scenes))


if __name__ == "__main__":
    main()
