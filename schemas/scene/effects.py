"""Which effects a scene runs: what the plan decides, and what every step asks."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

EffectKind = Literal["asked", "no_op", "approximation"]
"""asked: a switch of the job. no_op: where the scene does not call for it, leaving it out changes no byte. approximation:
leaving it out changes less than a stated tolerance."""


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

    def without(self, *names: str) -> "EffectPlan":
        """The plan with these effects taken out, whether the scene calls for them or not; for tests and the audit."""
        return replace(
            self,
            ran=tuple(name for name in self.ran if name not in names),
            skipped={**self.skipped, **{name: "withdrawn" for name in self.ran if name in names}},
            forced=self.forced.difference(names),
        )
