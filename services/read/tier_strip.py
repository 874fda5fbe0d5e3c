"""`python -m services.read.tier_strip FILE CATEGORY:SCENE ...`: the same scenes in the three tiers of colour, side by side."""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from schemas.job.job import Job
from schemas.scene.camera import Camera
from schemas.scene.effects import EffectPlan
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import PosedScene
from workers.assets.catalogue import open_catalogue
from workers.cameras.pivot_depth import front_distance
from workers.cameras.placement import place_mirror_camera
from workers.physics.step import settle_scene
from workers.pipeline.context import WorkerContext, settings_digest
from workers.pipeline.make_scene import plan_with_assets, pose_scene
from workers.plan.effect import Facts
from workers.plan.effects import plan_effects
from workers.render.raster.gbuffer import shared_renderer
from workers.render.step import draw_view

TIERS = ("flat", "raster", "pathtraced")
CELL, ZOOM, MARGIN, HEADING = (400, 300), 2.2, 4, 24
SEED, SAMPLES = 1, 64


def draw_strip(scenes: list[tuple[str, int]]) -> NDArray[np.uint8]:
    """[H, W, 3] uint8: a row for each (category, scene id), a column for each tier, about the object from the mirror pose."""
    rows = [
        np.concatenate([_padded(_cell(category, number, tier)) for tier in TIERS], 1) for category, number in scenes
    ]
    page = Image.fromarray(np.concatenate([np.full((HEADING, rows[0].shape[1], 3), 255, np.uint8), *rows]))
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(15)
    for column, tier in enumerate(TIERS):
        pen.text((column * (CELL[0] + MARGIN) + 4, 3), f"tier: {tier}", "black", font)
    return np.asarray(page)


def _cell(category: str, number: int, tier: str) -> NDArray[np.uint8]:
    render = {"tier": tier, "path_samples": SAMPLES, "samples": 4}
    job = Job.model_validate({"name": "strip", "seed": SEED, "categories": [category], "render": render})
    posed, camera, effects = _posed(job, number)
    rng = np.random.default_rng(np.random.SeedSequence(SEED, spawn_key=(number,)))
    drawn = draw_view(shared_renderer(), posed.things, posed.appearance, camera, job.render, rng, effects)
    assert drawn.rgb is not None
    return drawn.rgb


def _posed(job: Job, number: int) -> tuple[PosedScene, Camera, EffectPlan]:
    """A scene at rest, a camera at its mirror pose that sees the object alone, enlarged, and the plan of effects."""
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    context = WorkerContext(job, catalogue, shared_renderer(), settings_digest(job, catalogue.digest))
    plan = plan_with_assets(context, number)
    effects = plan_effects(Facts(job, plan, False))
    rest = settle_scene(plan, job.physics, effects)
    posed = pose_scene(plan, rest.settled)
    seen = shared_renderer().draw(posed.things, posed.appearance, plan.input_cameras[0])
    d_z_m = front_distance(seen.depth_m.astype(np.float64), seen.region >= REGION_FIRST_OBJECT, job.cameras.mirror)
    mirror = place_mirror_camera(plan.input_cameras[0], d_z_m, job.cameras.mirror)
    seen = shared_renderer().draw(posed.things, posed.appearance, mirror)
    v, u = np.nonzero(seen.region >= REGION_FIRST_OBJECT)
    k = mirror.intrinsics
    closer = {"fx": ZOOM * k.fx, "fy": ZOOM * k.fy, "width": CELL[0], "height": CELL[1]}
    closer["cx"] = 0.5 * CELL[0] + ZOOM * (k.cx - float(u.min() + u.max()) / 2)
    closer["cy"] = 0.5 * CELL[1] + ZOOM * (k.cy - float(v.min() + v.max()) / 2)
    return posed, Camera(k.model_copy(update=closer), mirror.T_world_cam), effects


def _padded(cell: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.pad(cell, ((0, MARGIN), (0, MARGIN), (0, 0)), constant_values=255)


if __name__ == "__main__":
    asked = [word.split(":") for word in sys.argv[2:]]
    strip = draw_strip([(category, int(number)) for category, number in asked])
    Image.fromarray(strip).save(Path(sys.argv[1]), quality=88)
