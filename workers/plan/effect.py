"""What an effect is, and what a scene's plan says of all of them. Pure."""

from collections.abc import Callable
from dataclasses import dataclass

from schemas.job.job import Job
from schemas.scene.effects import EffectKind
from schemas.scene.plan import ScenePlan


@dataclass(frozen=True, eq=False)
class Facts:
    """What an effect's predicate may look at: the scene as it is drawn, before anything moves or is rendered."""

    job: Job
    plan: ScenePlan
    raycast_checked: bool


@dataclass(frozen=True, eq=False)
class Effect:
    """`skipped_because(facts)` is None where the scene calls for the effect, else the reason why it does not.

    `cost` says in a few words what it costs where it runs, and `stage` names the stopwatch entry its time is counted in.
    """

    name: str
    kind: EffectKind
    skipped_because: Callable[[Facts], str | None]
    cost: str
    stage: str
