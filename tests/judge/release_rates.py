"""Whether a quarter of the finest steps shows what the finest show: `python -m tests.judge.release_rates --scenes 60`.

Single objects are let go for a second, in both, from where they rest; turned by 0.003 to 1 degree about a level axis at random,
so that an edge or a point is left on the table; and lifted by 0.005 to 0.15 mm. Prints how many of each kind move by more than
0.1 mm or 0.1 degrees, and the time of both. Ends with 1 where the quarter lets pass what the finest steps refuse.
"""

import argparse
import dataclasses
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.base import Pose
from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.scene.scene import ScenePlan
from services.job.job_file import validate_job
from tests.judge.table import STILL_DEG, STILL_MM
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.geometry.frames import pose, rotation_about, transform, translation
from workers.physics.fall import FINEST
from workers.physics.hold import RELEASE_RATE, moved_by, release_again
from workers.physics.settle import RECHECK_S, settle_scene
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import plan_scene
from workers.scene.effects import Facts, plan_effects

TILTS_DEG = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 0.005, 0.02)
LIFTS_MM = (0.005, 0.05, 0.09, 0.15)


@dataclass(frozen=True)
class Compared:
    """One object let go in both: its kind, and of the finest steps and the quarter (mm, degrees, seconds of processor)."""

    kind: str
    finest: tuple[float, float, float]
    quarter: tuple[float, float, float]

    @property
    def refused(self) -> tuple[bool, bool]:
        """Whether the finest steps refuse it, and the quarter."""
        finest, quarter = (mm > STILL_MM or deg > STILL_DEG for mm, deg, _ in (self.finest, self.quarter))
        return finest, quarter


def compare(job: Job, catalogue: Catalogue, scene_id: int) -> Iterator[Compared]:
    """A scene's object at rest, turned twice and lifted. Raises SceneError where the scene cannot be settled."""
    chance = SceneChance(job.seed, scene_id)
    plan = plan_scene(job, catalogue, chance)
    effects = plan_effects(Facts(job, plan, True))
    (rest,) = settle_scene(plan, job.physics, effects).settled
    generator = np.random.default_rng(scene_id)
    places = [("at rest", rest.T_world_obj)]
    for number in (scene_id, scene_id + len(TILTS_DEG) // 2):
        places.append(("turned", _turned(plan, rest.T_world_obj, TILTS_DEG[number % len(TILTS_DEG)], generator)))
    lift_mm = LIFTS_MM[scene_id % len(LIFTS_MM)]
    places.append(("lifted", translation(0.0, 0.0, lift_mm / 1e3) @ rest.T_world_obj))
    for kind, T in places:
        found = []
        for rate in (FINEST, RELEASE_RATE):
            begun = time.process_time()
            placed = [dataclasses.replace(rest, T_world_obj=T)]
            (after,) = release_again(plan, placed, job.physics, effects, RECHECK_S, rate)
            moved = moved_by(plan.objects[0], T, after)
            found.append((*moved, time.process_time() - begun))
        yield Compared(kind, *found)


def _turned(plan: ScenePlan, T: Pose, degrees: float, generator: np.random.Generator) -> Pose:
    """The pose turned about a level axis at random, with its lowest point as high as before."""
    about = generator.uniform(0.0, 2.0 * np.pi)
    R = rotation_about(np.array([np.cos(about), np.sin(about), 0.0]), np.radians(degrees)) @ T[:3, :3]
    turned, points = pose(R, T[:3, 3]), plan.objects[0].hull.vertices
    low_m, was_m = (transform(each, points)[:, 2].min() for each in (turned, T))
    return translation(0.0, 0.0, was_m - low_m) @ turned


def main() -> int:
    """Compare scenes of both ways to fall, and print the table."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--scenes", type=int, default=60, help="of each, upright and tumbled")
    ask.add_argument("--first", type=int, default=5000, help="number of the first scene")
    given = ask.parse_args()
    compared: list[Compared] = []
    for start in ("upright", "tumbled"):
        job = validate_job({"name": "rates", "seed": 2024, "start": {"pose": start}}, "rates")
        catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
        for scene_id in range(given.first, given.first + given.scenes):
            try:
                compared += compare(job, catalogue, scene_id)
            except SceneError as error:
                print(f"scene {scene_id}, {start}: {error}")
    print(
        "| kind | let go | refused by the finest steps | by the quarter alone | by the finest alone | most, finest | quarter |"
    )
    for kind in dict.fromkeys(one.kind for one in compared):
        own = [one for one in compared if one.kind == kind]
        counts = Counter(one.refused for one in own)
        finest = counts[True, True] + counts[True, False]
        most = [max(each.finest[0] for each in own), max(each.quarter[0] for each in own)]
        print(
            f"| {kind} | {len(own)} | {finest} | {counts[False, True]} | {counts[True, False]} | {most[0]:.4f} | {most[1]:.4f} |"
        )
    times = [sum(one.finest[2] for one in compared), sum(one.quarter[2] for one in compared)]
    print(f"processor time {times[0]:.0f} s and {times[1]:.0f} s, {times[1] / times[0]:.2f} of it")
    return int(any(one.refused == (True, False) for one in compared))


if __name__ == "__main__":
    sys.exit(main())
