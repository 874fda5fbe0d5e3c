"""What an effect is, and what its predicate looks at. Pure."""

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


Reason = Callable[[Facts], str | None]
"""Why a scene does not call for an effect; None where it does."""


@dataclass(frozen=True, eq=False)
class Effect:
    """An entry of the table of effects: its predicate, its cost in a few words, and the stage its time is counted in."""

    name: str
    kind: EffectKind
    skipped_because: Reason
    cost: str
    stage: str
