"""Where a view's colour comes from: the label pass itself, or paths traced beside it. Labels are the same in all tiers."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from schemas.job.render import Render
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera
from schemas.scene.scene import Placed
from schemas.scene.view import GBuffer
from workers.render.overrides import AS_CALLED_FOR, Passes
from workers.render.pathtraced.tracer import Tracer, require_mitsuba
from workers.render.raster.gbuffer import FLAT, Renderer

SEEDS = 2**32
"""As many as Mitsuba's samplers tell apart."""


def require_tier(render: Render) -> None:
    """Raises InputError, with the remedy, where what the tier needs is not installed."""
    if render.tier == "pathtraced" and render.rgb:
        require_mitsuba()


def draw_view(
    renderer: Renderer,
    things: Sequence[Placed],
    appearance: Appearance,
    camera: Camera,
    render: Render,
    rng: np.random.Generator,
    passes: Passes = AS_CALLED_FOR,
) -> GBuffer:
    """What one camera sees, in the tier that the job asks for; `rng` seeds the paths, `passes` are of the label pass.

    Without RGB, colour means nothing.
    """
    if not render.rgb:
        return renderer.draw(things, appearance, camera, FLAT, passes)
    if render.tier != "pathtraced":
        return renderer.draw(things, appearance, camera, render, passes)
    labels = renderer.draw(things, appearance, camera, FLAT, passes)
    rgb = shared_tracer().trace(things, appearance, camera, render, int(rng.integers(SEEDS)))
    rgb.setflags(write=False)
    return GBuffer(rgb, labels.depth_m, labels.region)


@cache
def shared_tracer() -> Tracer:
    """This process's tracer, made at the first call."""
    return Tracer()
