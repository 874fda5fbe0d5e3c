"""The tiers of rendering: whether their packages are installed, and one view drawn.

Labels are the label pass's in all tiers; colour is drawn by the same pass or by the path tracer. Importing this module loads
neither.
"""

import ctypes
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from schemas.errors import InputError
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import Appearance
from schemas.scene.view import Camera, GBuffer

if TYPE_CHECKING:
    from workers.render.raster.gbuffer import Renderer

SYSTEM_LIBRARY = "libatomic.so.1"
"""A library of the compiler's run time: Mitsuba's wheel does not bring it, and small images of Debian lack it."""

REMEDY = "`./verso extra pathtraced` installs it (mitsuba==3.9.1), or set render.tier to raster or flat"


def require_mitsuba() -> None:
    """Raises InputError, with the remedy, where Mitsuba or the system library that it loads is missing."""
    if importlib.util.find_spec("mitsuba") is None:
        raise InputError(f"render.tier is pathtraced, and Mitsuba is not installed: {REMEDY}")
    try:
        ctypes.CDLL(SYSTEM_LIBRARY)
    except OSError as error:
        remedy = "on Debian or Ubuntu: apt-get install -y libatomic1"
        raise InputError(
            f"render.tier is pathtraced, and Mitsuba needs {SYSTEM_LIBRARY} ({error}): {remedy}"
        ) from error


def require_tier(render: Render) -> None:
    """Raises InputError, with the remedy, where the tier's packages are not installed."""
    if render.tier == "pathtraced" and render.rgb:
        require_mitsuba()


SEEDS = 2**32
"""Number of seeds that Mitsuba's samplers tell apart."""


def draw_view(
    renderer: "Renderer",
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
    from workers.render.pathtraced import encode_light, shared_tracer

    seed = int(rng().integers(SEEDS))
    rgb = encode_light(shared_tracer().radiance(things, appearance, camera, render, effects, seed))
    rgb.setflags(write=False)
    return replace(drawn, rgb=rgb)
