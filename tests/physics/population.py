"""How scenes of a job come to rest, without an image: `python -m tests.physics.population --scenes 2000 --pose tumbled`.

Counts what fell through or failed, and measures what rests from its mesh, its pose and the table's mesh: penetration,
gap, what it does when it is let go again, and how far its mechanical energy rose on the way.
"""

import argparse
import itertools
import json
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import Array
from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.scene.scene import ScenePlan, Table
from schemas.scene.shape import Mesh
from tests.physics.energy import watched, worst_of
from tests.physics.room import G
from tests.physics.settling import recheck, settle_single
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.geometry.frames import transform
from workers.physics.support import sample_elevation
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import choose_category, plan_scene

GAP_MM, MOVE_MM, TURN_DEG = 0.1, 0.1, 0.1


@dataclass(frozen=True)
class Outcome:
    """How one scene ended; `reason` is why it failed or empty, lengths in mm, angles in degrees."""

    scene_id: int
    category: str
    reason: str = ""
    fell_through: bool = False
    overlap_mm: float = 0.0
    gap_mm: float = 0.0
    rise: float = 0.0
    """Largest rise of energy over its bound."""
    moved_mm: float | None = None
    turned_deg: float | None = None


def draw(job: Job, catalogue: Catalogue, scene_id: int) -> ScenePlan:
    """The scene as the job draws it."""
    return plan_scene(job, catalogue, SceneChance(job.seed, scene_id))


def fell_through(points: Array, table: Table) -> bool:
    """Whether an object's vertices [N, 3] are lower than the top by more than a millimetre where the top is above them."""
    ground = sample_elevation(points[:, :2], table.mesh)
    over_top = ground >= table.top.height_m - 1e-3  # nan compares false
    return bool((over_top & (points[:, 2] < ground - 1e-3)).any())


def above(mesh: Mesh, table: Mesh) -> float:
    """Metres from the table up to the mesh: from each of its vertices straight down, which is exact over a level top."""
    found = mesh.vertices[:, 2] - sample_elevation(mesh.vertices[:, :2], table)
    return float(np.nanmin(found))


def try_scene(job: Job, catalogue: Catalogue, scene_id: int, again: bool) -> Outcome:
    """Settle one scene and measure it; released again where `again`."""
    category = choose_category(job, SceneChance(job.seed, scene_id))
    try:
        plan = draw(job, catalogue, scene_id)
        start = plan.objects[0]
        with watched([start.asset]) as falls:
            rest = settle_single(start, plan.table, job.physics)
    except SceneError as error:
        through = error.reason == "not_at_rest" and "-" in error.detail
        return Outcome(scene_id, category, f"{error.reason}: {error.detail}", through)
    points = transform(rest.T_world_obj, start.asset.shape.vertices)
    height = above(Mesh(points, start.asset.shape.faces), plan.table.mesh) * 1e3
    moved = recheck(start, rest, plan.table, job.physics) if again else (None, None)
    rise = worst_of(falls(), start.asset.mass.mass_kg * G).over_bound
    through = fell_through(points, plan.table)
    return Outcome(scene_id, category, "", through, max(0.0, -height), max(0.0, height), rise, *moved)


def try_scenes(job: Job, first: int, stop: int, every: int) -> list[Outcome]:
    """Scenes in a range; one of `every` is released again."""
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    return [try_scene(job, catalogue, k, k % every == 0) for k in range(first, stop)]


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """The figures that count."""
    rested = [one for one in outcomes if not one.reason]
    again = [one for one in rested if one.moved_mm is not None and one.turned_deg is not None]
    moved = np.array([one.moved_mm for one in again], dtype=float)
    turned = np.array([one.turned_deg for one in again], dtype=float)
    rises = np.array([one.rise for one in rested])
    return {
        "scenes": len(outcomes),
        "failed": dict(Counter(one.reason.split(":")[0] for one in outcomes if one.reason)),
        "fell_through": sum(one.fell_through for one in outcomes),
        "overlap_mm_max": max(one.overlap_mm for one in rested),
        "gap_mm_max": max(one.gap_mm for one in rested),
        "released_again": len(again),
        "moved_mm": {"median": float(np.median(moved)), "p99": float(np.percentile(moved, 99)), "max": moved.max()},
        "moved_too_far": int(((moved > MOVE_MM) | (turned > TURN_DEG)).sum()),
        "turned_deg_max": turned.max(),
        "energy_rise_over_bound": {"p99": float(np.percentile(rises, 99)), "max": rises.max()},
        "energy_over_bound": int((rises > 1.0).sum()),
    }


def main() -> None:
    """Print the summary as JSON, and every scene that failed or is over a bound."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--scenes", type=int, default=2000)
    ask.add_argument("--pose", choices=["upright", "tumbled"], default="upright")
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--every", type=int, default=10, help="one scene of so many is released again")
    ask.add_argument("--processes", type=int, default=2)
    ask.add_argument("--only", type=int, nargs="+", help="nothing but these scenes, by number, each printed")
    given = ask.parse_args()
    job = Job.model_validate({"name": "population", "seed": given.seed, "start": {"pose": given.pose}})
    if given.only:
        catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
        for scene_id in given.only:
            print(json.dumps(asdict(try_scene(job, catalogue, scene_id, again=True))))
        return
    edges = np.linspace(0, given.scenes, 8 * given.processes + 1).astype(int).tolist()
    with ProcessPoolExecutor(given.processes) as pool:
        parts = [pool.submit(try_scenes, job, a, b, given.every) for a, b in itertools.pairwise(edges)]
        outcomes = [one for part in parts for one in part.result()]
    for one in outcomes:
        over = one.moved_mm is not None and (one.moved_mm > MOVE_MM or (one.turned_deg or 0.0) > TURN_DEG)
        if one.reason or one.fell_through or one.rise > 1.0 or over or max(one.overlap_mm, one.gap_mm) > GAP_MM:
            print(json.dumps(asdict(one)))
    print(json.dumps(summary(outcomes), default=float))


if __name__ == "__main__":
    main()
