"""Scenes to try effects on: a job's changes, and what is done to the scene that is drawn."""

import json
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import workers.scene.make_scene
from schemas.job.job import Job, settings_digest
from schemas.scene.scene import Ground, ScenePlan
from schemas.scene.shape import Part, Shape
from services.job.job_file import validate_job
from workers.assets.catalogue import Catalogue
from workers.assets.scene_tables import open_scenes
from workers.capture.results import open_sources
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.chance import SceneChance
from workers.scene.context import WorkerContext
from workers.scene.draw.plan import plan_scene
from workers.scene.draw.surround import surround
from workers.scene.effects import Facts, is_raycast_scene
from workers.scene.make_scene import Scene, make_scene
from workers.scene.rows import record_scene
from workers.stopwatch import Stopwatch

SMALL: dict[str, Any] = {
    "name": "effects",
    "seed": 11,
    "categories": ["can"],
    "cameras": {"sensor": {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 80.0, "cy": 60.0}},
    "images": {"patch": {"width": 32, "height": 24}},
    "check": {"raycast_share": 0.0, "mirror_agreement_mm": 5.0},
}

ABOVE_THE_HORIZON: dict[str, Any] = {
    "categories": ["bottle"],
    "cameras": {"orbit": {"inclination_rad": [0.04, 0.04]}, "sensor": {"fx": 400.0, "fy": 400.0, "cy": 140.0}},
    "images": {"depth_range_m": [0.2, 3.0]},
}
"""A camera 10 cm above the table's top whose picture begins above the horizon: it sees bottles, neither table nor floor."""

RECEIPT = {"effects", "skipped", "settings_digest"}

Edit = Callable[[ScenePlan], ScenePlan]


@dataclass(frozen=True, eq=False)
class Setting:
    """A scene: what differs from `SMALL`, and what is done to what was drawn."""

    changes: Mapping[str, Any]
    edit: Edit = lambda plan: plan
    scene_id: int = 0

    @property
    def job(self) -> Job:
        return validate_job(merged(SMALL, self.changes), "a test")


@dataclass(frozen=True, eq=False)
class Made:
    """What came of it: SHA-256 by path, rows without the receipt, and the scene."""

    files: dict[str, str]
    rows: dict[str, list[dict[str, object]]]
    scene: Scene
    stopwatch: Stopwatch


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The branches of a job, with those of the changes laid over."""
    both = {**base, **changes}
    return {
        key: merged(base[key], changes[key])
        if isinstance(base.get(key), dict) and isinstance(changes.get(key), dict)
        else value
        for key, value in both.items()
    }


@cache
def _catalogue(categories: tuple[str, ...], look: str) -> Catalogue:
    job = validate_job({"name": "c", "categories": list(categories), "look": json.loads(look)}, "a test")
    return open_sources(job, Path())


TABLES = tempfile.TemporaryDirectory(prefix="verso-tests-scenes-")


def above_the_table(settle: bool) -> str:
    """A table of scenes with a can that hovers above the middle of the table, or falls from there."""
    path, T = Path(TABLES.name) / f"{settle}.json", np.eye(4)
    T[2, 3] = 1.2
    path.write_text(json.dumps([{"instance_id": "can-0-000003", "T_world_obj": T.tolist(), "settle": settle}]))
    return str(path)


def context_of(job: Job, forced: Iterable[str] = (), withdrawn: Iterable[str] = ()) -> WorkerContext:
    catalogue = _catalogue(tuple(job.categories), job.drawn_look.model_dump_json())
    catalogue = replace(catalogue, scenes=open_scenes(job, Path()))
    digest = settings_digest(job, catalogue.digest)
    return WorkerContext(job, catalogue, shared_renderer(), digest, frozenset(forced), frozenset(withdrawn))


def facts_of(setting: Setting) -> Facts:
    """What the plan of effects is made from."""
    job, chance = setting.job, SceneChance(setting.job.seed, setting.scene_id)
    catalogue = context_of(job).catalogue
    plan = surround(job, job.drawn_look, catalogue, chance, setting.edit(plan_scene(job, catalogue, chance)))
    return Facts(job, plan, is_raycast_scene(job.check, chance))


def make(setting: Setting, forced: Iterable[str] = (), withdrawn: Iterable[str] = ()) -> Made:
    """The scene made, with effects forced, or taken out of its plan although it calls for them. Raises SceneError."""
    context, stopwatch = context_of(setting.job, forced, withdrawn), Stopwatch()

    def draw(job: Job, catalogue: Catalogue, chance: SceneChance) -> ScenePlan:
        return setting.edit(plan_scene(job, catalogue, chance))

    with mock.patch.object(workers.scene.make_scene, "plan_scene", draw):
        scene = make_scene(context, setting.scene_id, stopwatch)
    output = record_scene(context, scene, stopwatch)
    rows = {
        table: [{key: value for key, value in row.items() if key not in RECEIPT} for row in some]
        for table, some in output.rows.items()
    }
    return Made({file.path: file.sha256 for file in output.files}, rows, scene, stopwatch)


def without_textures(plan: ScenePlan) -> ScenePlan:
    """Every surface in its own colour."""
    return _each_part(plan, lambda part: replace(part, material=replace(part.material, texture=None)))


def with_holes(plan: ScenePlan) -> ScenePlan:
    """The upper half of each of the objects' textures is clear."""

    def pierce(part: Part) -> Part:
        texture = part.material.texture
        if texture is None:
            return part
        alpha = np.full((*texture.shape[:2], 1), 255, np.uint8)
        alpha[: len(alpha) // 2] = 0
        return replace(part, material=replace(part.material, texture=np.dstack([texture[..., :3], alpha])))

    start = plan.objects[0]
    pierced = replace(start, asset=replace(start.asset, shape=_of_parts(start.asset.shape, pierce)))
    return replace(plan, objects=(pierced, *plan.objects[1:]))


def _of_parts(shape: Shape, change: Callable[[Part], Part]) -> Shape:
    return replace(shape, parts=tuple(change(part) for part in shape.parts))


def _each_part(plan: ScenePlan, change: Callable[[Part], Part]) -> ScenePlan:
    table = replace(plan.table, asset=replace(plan.table.asset, shape=_of_parts(plan.table.asset.shape, change)))
    objects = tuple(
        replace(start, asset=replace(start.asset, shape=_of_parts(start.asset.shape, change))) for start in plan.objects
    )
    return replace(plan, ground=Ground(table, _of_parts(plan.floor, change)), objects=objects)
