"""What a scene calls for: which effects ran, which did not, and why. Data in one table, one entry an effect."""

from collections.abc import Callable
from dataclasses import dataclass

from schemas.job import Job, Tier
from schemas.scene import ScenePlan, Settled
from schemas.sensor import SensorEffects


@dataclass(frozen=True, eq=False)
class Facts:
    """What an effect's predicate may look at."""

    job: Job
    plan: ScenePlan
    settled: tuple[Settled, ...]
    raycast_checked: bool


@dataclass(frozen=True)
class Effect:
    """`skipped_because(facts)` is None where the effect ran, else the reason why the scene did not call for it."""

    name: str
    skipped_because: Callable[[Facts], str | None]


def _asked(key: str, switch: Callable[[Job], bool]) -> Callable[[Facts], str | None]:
    """An effect that runs unless its switch is off."""
    return lambda facts: None if switch(facts.job) else f"{key} is false"


_projection = _asked("images.projection.enabled", lambda job: job.images.projection.enabled)


def _dynamics(facts: Facts) -> str | None:
    all_placed = all(rest.support == "placed" for rest in facts.settled)
    return "placed in a statically stable pose" if all_placed else None


def _table_mesh(facts: Facts) -> str | None:
    reasons = {
        "placed": "placed in a statically stable pose",
        "flat_top": "the whole motion stayed over the table's convex flat top",
    }
    supports = {rest.support for rest in facts.settled}
    return None if "mesh" in supports else reasons["flat_top" if "flat_top" in supports else "placed"]


def _splat(facts: Facts) -> str | None:
    if (why := _projection(facts)) is not None:
        return why
    return "images.projection.splat is 1" if facts.job.images.projection.splat == 1 else None


def _hidden_points(facts: Facts) -> str | None:
    if (why := _projection(facts)) is not None:
        return why
    asked = facts.job.images.projection.hidden_point_removal
    return None if asked else "images.projection.hidden_point_removal is off"


def _raycast(facts: Facts) -> str | None:
    return None if facts.raycast_checked else "not in the share check.raycast_share"


def _sensor(name: str) -> Callable[[Facts], str | None]:
    """A sensor effect runs in every scene where the job asks for it."""
    return lambda facts: f"sensor.{name} is off" if getattr(facts.job.sensor, name) is None else None


def _tier(*tiers: Tier) -> Callable[[Facts], str | None]:
    """An effect of colour that belongs to these tiers."""

    def skipped_because(facts: Facts) -> str | None:
        if not facts.job.render.rgb:
            return "render.rgb is false"
        return None if facts.job.render.tier in tiers else f"render.tier is {facts.job.render.tier}"

    return skipped_because


EFFECTS: tuple[Effect, ...] = (
    Effect("dynamics", _dynamics),
    Effect("table_mesh_collision", _table_mesh),
    Effect("depth_camera", _asked("cameras.depth.enabled", lambda job: job.cameras.depth.enabled)),
    Effect("mirror", _asked("cameras.mirror.enabled", lambda job: job.cameras.mirror.enabled)),
    Effect("projection", _projection),
    Effect("rgb", _asked("render.rgb", lambda job: job.render.rgb)),
    Effect("splat", _splat),
    Effect("hidden_point_removal", _hidden_points),
    Effect("raycast_check", _raycast),
    Effect("release_again", _raycast),
    Effect("shadows", _tier("raster", "pathtraced")),
    Effect("ambient_occlusion", _tier("raster")),
    Effect("antialiasing", _tier("raster", "pathtraced")),
    Effect("global_illumination", _tier("pathtraced")),
    Effect("glass", _tier("pathtraced")),
    *(Effect(f"sensor_{name}", _sensor(name)) for name in SensorEffects.model_fields),
)


def write_receipt(facts: Facts) -> tuple[list[str], list[dict[str, str]]]:
    """(names of the effects that ran, [{effect, why}] of those that did not), in the table's order."""
    reasons = [(effect.name, effect.skipped_because(facts)) for effect in EFFECTS]
    ran = [name for name, why in reasons if why is None]
    return ran, [{"effect": name, "why": why} for name, why in reasons if why is not None]
