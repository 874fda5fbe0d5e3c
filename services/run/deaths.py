"""How often workers died, and which scene is blamed for it. Pure."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from schemas.dataset.commit import Span
from schemas.dataset.shard import Blame, Reason
from schemas.errors import RunError

NODE_PATIENCE = 5
"""A node that is lost is seldom the scene's fault: so many times more of them than of other deaths are borne."""

EXPLANATIONS: dict[Reason, str] = {
    "time": "the scene took longer than run.scene_timeout_s each time: raise it, then run with --retry-failed",
    "memory": "the worker ran out of memory each time: use fewer workers, then run with --retry-failed",
    "killed": "the worker was killed or crashed in this scene each time: see OUT/_logs, then run with --retry-failed",
}
"""The stored detail of an environmental failure."""


@dataclass(frozen=True)
class Death:
    """A worker that died with the range from `start`: in which scene, if it had begun one, and of what."""

    start: int
    scene: int | None
    reason: Reason
    message: str
    with_node: bool = False
    """Whether its whole node was lost."""


class Deaths:
    """The deaths of a run's workers, by the scene that they died in, or by the range where they had begun none."""

    def __init__(self, attempts: int) -> None:
        self._attempts = attempts
        self._counts: Counter[tuple[bool, str, int]] = Counter()
        self._blamed: dict[int, Blame] = {}

    def count(self, death: Death) -> None:
        """Counts a death, and blames its scene after too many. Raises RunError where workers die before they begin one."""
        place = ("range", death.start) if death.scene is None else ("scene", death.scene)
        self._counts[death.with_node, *place] += 1
        deaths = self._counts[death.with_node, *place]
        if deaths < self._attempts * (NODE_PATIENCE if death.with_node else 1):
            return
        if death.scene is None:
            raise RunError(
                f"the worker for the scenes from {death.start} died {deaths} times before it began one or while it committed "
                f"({death.reason}: {death.message}): see `verso doctor`"
            )
        detail = EXPLANATIONS[death.reason]
        self._blamed[death.scene] = Blame(scene_id=death.scene, reason=death.reason, detail=detail, attempts=deaths)

    def blamed_in(self, spans: Iterable[Span]) -> tuple[Blame, ...]:
        """Scenes of these ranges that are not to be tried again."""
        return tuple(self._blamed[scene] for span in spans for scene in span.scene_ids if scene in self._blamed)
