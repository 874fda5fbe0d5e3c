"""Rendering of one view: labels by the label pass in all tiers; colour by the same pass or by the path tracer."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from schemas.job.render import Render
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera
from schemas.scene.effects import EffectPlan
from schemas.scene.scene import Placed
from schemas.scene.view import GBuffer
from workers.render.pathtraced.tracer import Tracer, encode_light
from workers.render.raster.gbuffer import Renderer

SEEDS = 2**32
"""Number of seeds that Mitsuba's samplers tell apart."""


def draw_view(
    renderer: Renderer,
    things: Sequence[Placed],
    appearance: Appearance,
    camera: Camera,
    render: Render,
    rng: Callable[[], np.random.Generator],
    effects: EffectPlan,
) -> GBuffer:
    """What one camera sees, drawn with the effects of the plan. RGB is None without `rgb`.

    `rng` makes the generator that seeds the paths: a tenth of a millisecond, which tiers without paths do without.
    """
    drawn = renderer.draw(things, appearance, camera, render, effects)
    if render.tier != "pathtraced" or not effects.runs("rgb"):
        return drawn
    seed = int(rng().integers(SEEDS))
    rgb = encode_light(shared_tracer().radiance(things, appearance, camera, render, effects, seed))
    rgb.setflags(write=False)
    return replace(drawn, rgb=rgb)


@cache
def shared_tracer() -> Tracer:
    """This process's tracer, made at the first call."""
    return Tracer()
