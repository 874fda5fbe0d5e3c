"""Which of the passes that not every scene calls for are drawn."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Passes:
    """Names of a scene's effects: those `left_out` are not drawn at all, those `forced` also where nothing calls for them.

    The others are drawn where a view or a thing calls for them.
    """

    left_out: frozenset[str] = frozenset()
    forced: frozenset[str] = frozenset()

    def draw(self, name: str, called_for: bool = True) -> bool:
        """Whether an effect is drawn, given whether what is being drawn calls for it."""
        return name in self.forced or (called_for and name not in self.left_out)


AS_CALLED_FOR = Passes()
"""Every pass wherever it is called for."""
