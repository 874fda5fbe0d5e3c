"""Keys that a job sets and that cannot act, because another key switches off what they shape: told, never ignored in silence."""

from collections.abc import Callable
from functools import partial, reduce

from schemas.dataset.layout import SWITCHES, is_stored
from schemas.job.job import Job

Acts = Callable[[Job], bool]

_COLOUR, _MIRROR, _DEPTH, _PROJECTION = (
    (f"{SWITCHES[part]} is false", partial(is_stored, part)) for part in ("rgb", "mirror", "aligned", "projected")
)
_SEVERAL: tuple[str, Acts] = ("objects_per_scene is 1", lambda job: job.objects_per_scene.high > 1)
_PILE: tuple[str, Acts] = ("start.arrange is spread", lambda job: job.start.arrange == "pile")
_RASTER: tuple[str, Acts] = ("render.tier is not raster", lambda job: job.render.tier == "raster")
_TRACED: tuple[str, Acts] = ("render.tier is not pathtraced", lambda job: job.render.tier == "pathtraced")
_PERCENTILE: tuple[str, Acts] = (
    "cameras.mirror.pivot_depth is not percentile",
    lambda job: job.cameras.mirror.pivot_depth == "percentile",
)
_PARTS: tuple[str, Acts] = (
    "physics.collision makes no convex parts",
    lambda job: job.physics.collision in ("planned", "parts"),
)

NEEDS: dict[str, tuple[tuple[str, Acts], ...]] = {
    "render.tier": (_COLOUR,),
    "render.samples": (_COLOUR, _RASTER),
    "render.path_samples": (_COLOUR, _TRACED),
    "render.path_bounces": (_COLOUR, _TRACED),
    "cameras.mirror.T_z_m": (_MIRROR,),
    "cameras.mirror.pivot_depth": (_MIRROR,),
    "cameras.mirror.percentile": (_MIRROR, _PERCENTILE),
    "cameras.depth.offset_m": (_DEPTH,),
    "images.projection.splat": (_PROJECTION,),
    "images.projection.hidden_point_removal": (_PROJECTION,),
    "start.arrange": (_SEVERAL,),
    "start.pile_offset_m": (_SEVERAL, _PILE),
    "physics.concavity": (_PARTS,),
}
"""Keys of scenes by what must hold for them to act: a phrase for where it does not, and whether it does."""


def describe_idle(job: Job) -> list[str]:
    """A line for each key that has another value than its default and cannot act."""
    if job.captures is not None:
        return []
    told = []
    for key, needs in NEEDS.items():
        branch, _, name = key.rpartition(".")
        model = reduce(getattr, branch.split("."), job)
        value, usual = getattr(model, name), type(model).model_fields[name].default
        why = next((phrase for phrase, acts in needs if not acts(job)), None)
        if value != usual and why is not None:
            told.append(f"{key} is {value} and has no effect: {why}")
    return told
