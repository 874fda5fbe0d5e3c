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


def _always(_: Facts) -> None:
    return None


def _dynamics(facts: Facts) -> str | None:
    return "placed in a statically stable pose" if facts.settled[0].support == "placed" else None


def _table_mesh(facts: Facts) -> str | None:
    reasons = {
        "placed": "placed in a statically stable pose",
        "flat_top": "the whole motion stayed over the table's convex flat top",
    }
    return reasons.get(facts.settled[0].support)


def _splat(facts: Facts) -> str | None:
    return "images.projection.splat is 1" if facts.job.images.projection.splat == 1 else None


def _hidden_points(facts: Facts) -> str | None:
    asked = facts.job.images.projection.hidden_point_removal
    return None if asked else "images.projection.hidden_point_removal is off"


def _raycast(facts: Facts) -> str | None:
    return None if facts.raycast_checked else "not in the share check.raycast_share"


def _sensor(name: str) -> Callable[[Facts], str | None]:
    """A sensor effect runs in every scene where the job asks for it."""
    return lambda facts: f"sensor.{name} is off" if getattr(facts.job.sensor, name) is None else None


def _tier(*tiers: Tier) -> Callable[[Facts], str | None]:
    """An effect of colour that belongs to these tiers."""
    return lambda facts: None if facts.job.render.tier in tiers else f"render.tier is {facts.job.render.tier}"


EFFECTS: tuple[Effect, ...] = (
    Effect("dynamics", _dynamics),
    Effect("table_mesh_collision", _table_mesh),
    Effect("depth_camera", _always),
    Effect("mirror", _always),
    Effect("projection", _always),
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
