"""How several objects are let go, and what becomes of those that leave the table. Pure.

A pile of many falls in waves, each above what lies by then: from the height of one column of all they would scatter.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import count

from schemas.base import Array, Pose, frozen_array
from schemas.errors import SettleError
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import REGION_FIRST_CLUTTER, REGION_FIRST_OBJECT
from workers.geometry.frames import transform, translation
from workers.physics.support import support_height

AT_ONCE, WAVE = 8, 5
"""Objects that fall as one column, and of how many a wave is where there are more."""

Draw = Callable[[ObjectStart, int, Sequence[Array]], ObjectStart]
"""A new start of an object, drawn for the n-th time, from 1, where others have these points [N, 3], world."""


@dataclass(frozen=True)
class Pouring:
    """What a scene does beside letting all go: whether in `waves`, and what becomes of an object that leaves the table.

    It is drawn again by `draw`, `most` times at most; or removed; or the scene fails.
    """

    waves: bool = False
    draw: Draw | None = None
    most: int = 0
    remove: bool = False

    @property
    def goes_on(self) -> bool:
        """Whether the others go on without an object that leaves the table."""
        return self.draw is not None or self.remove


NOTHING_MORE = Pouring()
"""All are let go at once, and the scene fails where one leaves the table."""


class LostError(SettleError):
    """Objects, by their numbers, left the table's top or found no balance; all are at `poses` [4, 4], others have `fallen`."""

    def __init__(
        self, reason: str, detail: str, numbers: Sequence[int], poses: Sequence[Pose], fallen: Iterable[int]
    ) -> None:
        super().__init__(reason, detail)
        self.numbers, self.poses, self.fallen = tuple(numbers), tuple(poses), frozenset(fallen) - frozenset(numbers)


def points_of(start: ObjectStart) -> Array:
    """[N, 3] world: the corners of an object's hull where it begins."""
    return transform(start.T_world_obj, start.hull.vertices)


def moved_to(starts: Sequence[ObjectStart], poses: Sequence[Pose]) -> tuple[ObjectStart, ...]:
    """The objects, let go at these poses."""
    return tuple(dataclasses.replace(one, T_world_obj=frozen_array(T)) for one, T in zip(starts, poses, strict=True))


def next_wave(count: int, lying: frozenset[int]) -> list[int]:
    """The numbers of the objects that fall next, of so many, in their order."""
    left = [number for number in range(count) if number not in lying]
    return left if len(left) <= (WAVE if lying else AT_ONCE) else left[:WAVE]


def clearances_m(starts: Sequence[ObjectStart], table: Table) -> tuple[float, ...]:
    """How far each object begins above the table and all objects before it."""
    return tuple(float(points_of(one)[:, 2].min()) - _top_m(one, starts[:n], table) for n, one in enumerate(starts))


def lift(start: ObjectStart, others: Sequence[ObjectStart], table: Table, clearance_m: float) -> ObjectStart:
    """The object, moved along z until it is so far above the table and these others."""
    up_m = _top_m(start, others, table) + clearance_m - float(points_of(start)[:, 2].min())
    return moved_to([start], [translation(0.0, 0.0, up_m) @ start.T_world_obj])[0]


def _top_m(start: ObjectStart, others: Sequence[ObjectStart], table: Table) -> float:
    below_m = support_height(points_of(start)[:, :2], table.mesh)
    return max([below_m, *(float(points_of(one)[:, 2].max()) for one in others)])


def renumbered(starts: Sequence[ObjectStart]) -> tuple[ObjectStart, ...]:
    """The objects with region ids one after another, and likewise the clutter."""
    next_id = {False: count(REGION_FIRST_OBJECT), True: count(REGION_FIRST_CLUTTER)}
    return tuple(dataclasses.replace(one, region_id=next(next_id[one.is_clutter])) for one in starts)
