"""Which effects a simulated capture runs: one table of effects, and the plan that follows from its settings. Pure.

The plan is of the same kind as that of scenes (schemas/scene/scene.py). Effects of the rendering are no-ops where a
capture does not call for them; every other one is asked for by name in `captures.simulate`.
"""

from schemas.job.captures import Simulate
from schemas.scene.scene import EffectPlan

ASKED = (
    "hidden_markers",
    "print_scale",
    "motion_blur",
    "distortion",
    "exposure",
    "rgb_noise",
    "depth_noise",
    "registration_error",
)
"""Effects that run where `captures.simulate` has a branch of this name. A receipt names them in this order."""

RASTER = ("shadows", "ambient_occlusion", "light_maps")
TRACED = ("global_illumination", "glass")
DRAWN = ("rgb", "floor", "table", "textures", "transparency")
"""What the renderers draw of every capture; antialiasing is not theirs, because photographs are averaged (sampling.py)."""


def plan_effects(simulate: Simulate) -> EffectPlan:
    """The effects that a capture runs, and why each of the others does not."""
    of_tier = RASTER if simulate.tier == "raster" else TRACED
    ran = [*DRAWN, *of_tier, *(name for name in ASKED if getattr(simulate, name) is not None)]
    skipped = {name: f"tier is {simulate.tier}" for name in (*RASTER, *TRACED) if name not in of_tier}
    skipped |= {name: f"captures.simulate.{name} is off" for name in ASKED if name not in ran}
    return EffectPlan(tuple(ran), skipped)


def planned_settings(simulate: Simulate, plan: EffectPlan) -> Simulate:
    """The settings of those effects that the plan runs: every other one is off."""
    return simulate.model_copy(update=dict.fromkeys(name for name in ASKED if not plan.runs(name)))
