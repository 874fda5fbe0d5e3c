"""What an effect is, and what a scene's plan says of all of them. Pure."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from schemas.job import Job
from schemas.scene import ScenePlan

Kind = Literal["asked", "no_op", "approximation"]
"""asked: a switch of the job. no_op: where the scene does not call for it, leaving it out changes no byte. approximation:
leaving it out changes less than a stated tolerance."""


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
    kind: Kind
    skipped_because: Callable[[Facts], str | None]
    cost: str
    stage: str


@dataclass(frozen=True, eq=False)
class EffectPlan:
    """The effects that are to run, and why each of the others is not, in the table's order.

    `forced` are those that run everywhere, also in views and on things that do not call for them.
    """

    ran: tuple[str, ...]
    skipped: Mapping[str, str]
    forced: frozenset[str] = frozenset()

    def runs(self, name: str) -> bool:
        """Whether the effect is to run."""
        return name in self.ran
