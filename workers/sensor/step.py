"""Sensing of one view: what the sensors store of exact images. Masks and labels stay exact."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.job.images import Images
from schemas.job.sensor import SensorEffects
from schemas.scene.effects import EffectPlan
from schemas.scene.view import View
from workers.geometry.pixels import dequantise_depth, quantise_depth
from workers.sensor.depth import sense_depth
from workers.sensor.rgb import sense_rgb


@dataclass(frozen=True, eq=False)
class SensorChance:
    """One generator for each random effect of one view, so that no other view or effect changes its numbers."""

    depth: np.random.Generator
    rgb: np.random.Generator
    exposure: np.random.Generator


def planned_effects(sensor: SensorEffects, effects: EffectPlan) -> SensorEffects:
    """The job's numbers of those sensor effects that the plan runs."""
    withdrawn = [name for name in SensorEffects.model_fields if not effects.runs(f"sensor_{name}")]
    return sensor.model_copy(update=dict.fromkeys(withdrawn))


def sense_view(sensor: SensorEffects, images: Images, view: View, chance: SensorChance, effects: EffectPlan) -> View:
    """An exact view as its sensors store it; the same view where the plan runs no sensor effect."""
    assert view.region is not None
    rgb, depth, sensor = view.rgb, view.depth, planned_effects(sensor, effects)
    if rgb is not None:
        rgb = sense_rgb(rgb, view.camera.intrinsics, sensor, chance.exposure, chance.rgb)
    if sensor.depth_noise is not None:
        exact_m = dequantise_depth(depth, images)
        depth = quantise_depth(sense_depth(exact_m, view.region, view.camera, sensor.depth_noise, chance.depth), images)
    return view if rgb is view.rgb and depth is view.depth else replace(view, rgb=rgb, depth=depth)
