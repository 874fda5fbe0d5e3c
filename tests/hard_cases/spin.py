"""What spins when it is let go: production lets everything go at rest."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from workers.physics import bullet
from workers.physics.bullet import World


@contextmanager
def spinning(spin: Sequence[float]) -> Iterator[None]:
    """A body that is let go within the block has this angular velocity, rad/s, world coordinates.

    As often as it is let go as it was first; not where a settling goes on from where it stopped.
    """
    began = list[Any]()

    class Spun(World):
        def set_velocity(self, velocity: Sequence[float], _: Any = None, body: int = 0) -> None:
            began.append(self.pose(body)[1])
            super().set_velocity(velocity, spin if began[-1] == began[0] else (0.0, 0.0, 0.0), body)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bullet, "World", Spun)
        yield
