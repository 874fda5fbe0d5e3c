"""From what a camera ought to see to what its sensor stores: masks and labels stay exact."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.job.job import Images
from schemas.job.sensor import SensorEffects
from schemas.scene.scene import View
from workers.geometry.stored_depth import dequantise_depth, quantise_depth
from workers.sensor.depth import sense_depth
from workers.sensor.rgb import sense_rgb


@dataclass(frozen=True, eq=False)
class SensorChance:
    """One generator for each effect of one view, so that another view or another effect moves no noise."""

    depth: np.random.Generator
    rgb: np.random.Generator
    exposure: np.random.Generator


def sense_view(sensor: SensorEffects, images: Images, view: View, chance: SensorChance) -> View:
    """An exact view as its sensors store it; the same view where no effect is asked for."""
    assert view.region is not None
    rgb, depth = view.rgb, view.depth
    if rgb is not None and sensor.changes_rgb:
        rgb = sense_rgb(rgb, view.camera.intrinsics, sensor, chance.exposure, chance.rgb)
    if sensor.depth_noise is not None:
        exact_m = dequantise_depth(depth, images)
        depth = quantise_depth(sense_depth(exact_m, view.region, view.camera, sensor.depth_noise, chance.depth), images)
    return view if rgb is view.rgb and depth is view.depth else replace(view, rgb=rgb, depth=depth)
