"""Scenes settled by production and judged: `python -m tests.judge.piles --job deploy/jobs/pile.yaml --scenes 200`.

Nothing is rendered. Prints one table, and with --json every scene. Ends with 1 where an accepted scene is over a bound, or
where one crashed. docs/rest.md says what the figures mean.
"""

import argparse
import functools
import json
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

import yaml

from schemas.errors import SceneError
from schemas.job.job import Job
from tests.judge.scenes import CRASHED, Asked, Outcome, try_scene
from tests.judge.table import describe, is_within, summary, tabulate
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import plan_scene, pouring_of


@functools.cache
def catalogue_of(job_json: str) -> Catalogue:
    """Opened once in each process."""
    job = Job.model_validate_json(job_json)
    return open_catalogue(job.assets, Path(), tuple(job.categories))


def try_pile(job: Job, asked: Asked, scene_id: int) -> Outcome:
    """A scene as its job draws it."""
    chance = SceneChance(job.seed, scene_id)
    try:
        plan = plan_scene(job, catalogue_of(job.model_dump_json()), chance)
    except SceneError as error:
        return Outcome(scene_id, 0, 0.0, {}, error.reason, error.detail)
    return try_scene(scene_id, plan, job.physics, asked, pouring_of(job.start, chance, plan))


def _try_hollow(job: Job, asked: Asked, scene_id: int) -> Outcome:
    from tests.judge.hollows import draw_hollow  # what reads files is loaded for them alone

    return try_scene(scene_id, draw_hollow(job, scene_id), job.physics, asked)


def main() -> int:
    """Make the scenes, tell of each that is refused or over a bound, and print the table."""
    given = _arguments()
    document = yaml.safe_load(Path(given.job).read_text())
    document.pop("verso", None)
    job = Job.model_validate(document)
    changes = {"objects_per_scene": given.objects, "seed": given.seed}
    if given.table:
        document = {
            **document,
            "assets": {**document["assets"], "tables": [{"source": "procedural", "kind": given.table}]},
        }
    job = Job.model_validate(document | {key: value for key, value in changes.items() if value is not None})
    asked = Asked(given.recheck, given.mujoco)
    make: Callable[[int], Outcome] = functools.partial(_try_hollow if given.hollows else try_pile, job, asked)
    outcomes = []
    with ProcessPoolExecutor(given.processes) as pool:
        for one in pool.map(make, range(given.first, given.first + given.scenes)):
            outcomes.append(one)
            if one.refused or not is_within(one):
                print(describe(one), flush=True)
    if given.json:
        report = {"command": sys.argv, "summary": summary(outcomes), "scenes": [asdict(one) for one in outcomes]}
        Path(given.json).write_text(json.dumps(report, indent=1))
    name = "hollows" if given.hollows else f"{job.name}, {job.objects_per_scene[1]} objects"
    print(tabulate(name, outcomes))
    crashed = any(one.refused == CRASHED for one in outcomes)
    return int(crashed or not all(is_within(one) for one in outcomes if not one.refused))


def _arguments() -> argparse.Namespace:
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--job", default="deploy/jobs/pile.yaml")
    ask.add_argument("--scenes", type=int, default=200)
    ask.add_argument("--first", type=int, default=0, help="number of the first scene")
    ask.add_argument("--objects", type=int, help="objects in each scene, instead of the job's")
    ask.add_argument("--table", choices=("table", "tray", "bin"), help="what objects fall onto or into")
    ask.add_argument("--seed", type=int, help="instead of the job's")
    ask.add_argument("--processes", type=int, default=1)
    ask.add_argument("--hollows", action="store_true", help="objects from files dropped into hollows from files")
    ask.add_argument("--recheck", action="store_true", help="let every scene go again for 1 s")
    ask.add_argument("--mujoco", action="store_true", help="hold every scene in MuJoCo for 1 s")
    ask.add_argument("--json", help="file for every figure of every scene")
    return ask.parse_args()


if __name__ == "__main__":
    sys.exit(main())
