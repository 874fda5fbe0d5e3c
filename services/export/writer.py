"""What every format is: a writer that takes scenes in order and says which pairs it leaves out, and why."""

from dataclasses import dataclass
from typing import Any, Protocol

from services.export.source import ExportScene


@dataclass(frozen=True)
class LeftOut:
    """A pair that a format cannot hold."""

    scene_id: int
    pose_id: int
    reason: str
    """The same words for every pair of a kind."""


@dataclass(frozen=True)
class Added:
    """What became of a scene."""

    pairs: int
    """How many of its pairs were written."""
    left_out: tuple[LeftOut, ...] = ()


class Writer(Protocol):
    """Writes one format into an `ExportFolder`."""

    def add(self, scene: ExportScene) -> Added:
        """Takes the next scene."""

    def state(self) -> dict[str, Any] | None:
        """What a new writer must know to go on from here; None while something that it took is not whole in the folder."""

    def finish(self) -> None:
        """Writes what is still waiting. Afterwards `state` is not None."""

    def describe(self) -> dict[str, Any]:
        """What the manifest says of this format: units, frames, counts."""

    def close(self) -> None:
        """Lets go of what is open; what is not in the last state may be lost."""
