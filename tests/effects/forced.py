"""Drops by the plan beside drops with every effect of physics forced, and in MuJoCo, from the same starts, by kind of scene.

`python -m tests.effects.forced --kind tumbled --scenes 1000 --mujoco 300` prints the figures of docs/measured.md. Nothing is
rendered. A drop is chaotic, so that single ends differ. What must not is how far things go, on which side they lie, and how high.
"""

import argparse
import functools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import ks_2samp
from scipy.stats import t as student_t

from schemas.base import Array, Pose
from schemas.errors import SceneError
from tests.effects.physics_scenes import settled
from tests.effects.scenes import Setting, facts_of
from tests.judge.referee import simulate
from workers.geometry.frames import transform
from workers.scene.effects import Facts, names_of_kind, plan_effects

CATEGORIES = ["bottle", "camera", "can", "jar", "laptop", "mug", "bowl", "box"]
EDGE, FIVE = {"offset_m": [-0.6, 0.6]}, {"objects_per_scene": 5}

KINDS: dict[str, dict[str, Any]] = {
    "upright": {},
    "upright near the edge": {"start": EDGE},
    "upright, five spread": FIVE,
    "tumbled": {"start": {"pose": "tumbled"}},
    "tumbled near the edge": {"start": {"pose": "tumbled", **EDGE}},
    "tumbled, five spread": {"start": {"pose": "tumbled"}, **FIVE},
}
"""What differs from a job's defaults, in all eight categories; nothing is drawn again."""

FALL_S, STEP_S = 2.5, 1e-3
"""What MuJoCo has to bring a scene to rest, and its step."""

SIDE = 0.87
"""Least z component of its own z axis of what stands upright: within 30 degrees."""


def facts_like(kind: str, scene_id: int) -> Facts:
    """A scene of a kind as it is drawn. Raises SceneError."""
    return facts_of(Setting({"categories": CATEGORIES, **KINDS[kind]}, scene_id=scene_id))


def ends(facts: Facts, forced: Iterable[str] = ()) -> list[Pose]:
    """`T_world_obj` of every object at rest, by the plan with these effects forced. Raises SettleError."""
    return [rest.T_world_obj for rest in settled(facts, plan_effects(facts, frozenset(forced))).settled]


def left_out(facts: Facts) -> list[str]:
    """The effects of physics that the plan leaves out although a scene may be made with them."""
    return sorted(names_of_kind("approximation") & plan_effects(facts).skipped.keys())


MEASURES = ("way, %", "height, %", "upright, %", "upside down, %")
"""Of an object: how far it went across the table, and the height of its centre of mass, both of its diagonal; how it lies."""


def lying(facts: Facts, poses: Sequence[Pose]) -> Array:
    """[objects, MEASURES] of a scene with these ends, `T_world_obj`."""
    rows = []
    for start, T in zip(facts.plan.objects, poses, strict=True):
        begun, ended = (transform(each, start.asset.mass.com[None, :])[0] for each in (start.T_world_obj, T))
        way_m, height_m = float(np.linalg.norm((ended - begun)[:2])), ended[2] - facts.plan.table.top.height_m
        size_m = float(np.linalg.norm(start.asset.extents_m))
        rows.append((way_m / size_m, height_m / size_m, T[2, 2] > SIDE, T[2, 2] < -SIDE))
    return 100.0 * np.array(rows, dtype=float)


@dataclass(frozen=True)
class Difference:
    """Of scenes that both ways made: the mean of each, the mean change and half its interval of 95 %, scene by scene; and
    the probability of a distance so large between the distributions, by Kolmogorov and Smirnov."""

    planned: float
    other: float
    change: float
    half: float
    probability: float


def difference(planned: Array, other: Array) -> Difference:
    """Between figures [scenes, objects] of the same scenes."""
    change = (other - planned).mean(axis=1)
    half = float(student_t.ppf(0.975, len(change) - 1)) * change.std(ddof=1) / np.sqrt(len(change))
    alike = ks_2samp(planned.ravel(), other.ravel(), method="asymp").pvalue
    return Difference(planned.mean(), other.mean(), change.mean(), half, alike)


def drop_both(draw: Callable[[int], Facts], other: Callable[[Facts], list[Pose]], scene_id: int) -> Array | str | None:
    """[2, objects, MEASURES] by the plan and the other way; who alone refused it, '' for both; None where none is drawn."""
    try:
        facts = draw(scene_id)
    except SceneError:
        return None
    made, refused = [], []
    for name, way in (("planned", ends), ("other", other)):
        try:
            made.append(lying(facts, way(facts)))
        except SceneError:
            refused.append(name)
    return np.stack(made) if not refused else refused[0] if len(refused) == 1 else ""


def all_forced(facts: Facts) -> list[Pose]:
    """The ends with everything that the plan left out. Raises SettleError."""
    return ends(facts, left_out(facts))


def in_mujoco(facts: Facts) -> list[Pose]:
    """The ends in MuJoCo, without rebounds as here."""
    starts = [start.T_world_obj for start in facts.plan.objects]
    return simulate(facts.plan, starts, facts.job.physics, FALL_S, STEP_S, rebound=False)


def differences(outcomes: Sequence[Array | str | None]) -> dict[str, Difference]:
    """By measure, of the scenes that both made."""
    made = np.stack([one for one in outcomes if isinstance(one, np.ndarray)])
    return {name: difference(made[:, 0, :, k], made[:, 1, :, k]) for k, name in enumerate(MEASURES)}


def tabulate(name: str, outcomes: Sequence[Array | str | None]) -> str:
    """Rows of a Markdown table."""
    refused = [sum(isinstance(one, str) and one == who for one in outcomes) for who in ("planned", "other")]
    made = sum(isinstance(one, np.ndarray) for one in outcomes)
    lines = [f"{name}: {made} scenes; refused by the plan alone {refused[0]}, by the other alone {refused[1]}"]
    for measure, d in differences(outcomes).items():
        change = f"{d.change:+.2f} ± {d.half:.2f}"
        lines.append(f"| {measure} | {d.planned:.2f} | {d.other:.2f} | {change} | {d.probability:.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Drop scenes of a kind in each way, and print the tables."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--kind", choices=KINDS, default="tumbled")
    ask.add_argument("--scenes", type=int, default=1000)
    ask.add_argument("--mujoco", type=int, default=0, help="so many scenes in MuJoCo too")
    ask.add_argument("--processes", type=int, default=2)
    given = ask.parse_args()
    draw = functools.partial(facts_like, given.kind)
    with ProcessPoolExecutor(given.processes) as pool:
        for name, other, count in (("forced", all_forced, given.scenes), ("MuJoCo", in_mujoco, given.mujoco)):
            if count:
                work = functools.partial(drop_both, draw, other)
                print(tabulate(f"{given.kind}, {name}", list(pool.map(work, range(count), chunksize=4))), flush=True)


if __name__ == "__main__":
    main()
