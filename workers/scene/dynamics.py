"""The effects of physics: which of them the scene calls for, from its shapes and scales alone. Pure."""

from collections.abc import Callable, Sequence

import numpy as np

from schemas.job import Physics
from schemas.scene import ObjectStart, Table
from schemas.shape import Hull
from workers.geometry.frames import transform
from workers.scene.effect import Effect, Facts
from workers.scene.support import inside_margin

ROUND_FACES = 20
"""A hull with this many planes or more may roll over them; a box has 6."""

SAME_PLANE = 1e-6
"""Normals whose coordinates differ by less are of one plane."""

AT_REST = "placed in a statically stable pose"

Predicate = Callable[[Sequence[ObjectStart], Table, Physics], str | None]


def is_round(hull: Hull) -> bool:
    """Whether so many planes bound the hull that it may roll from one to the next."""
    return len(np.unique(np.round(hull.normals / SAME_PLANE).astype(np.int64), axis=0)) >= ROUND_FACES


def starts_over_top(start: ObjectStart, table: Table) -> bool:
    """Whether every point of the object is over the table's flat top, which is convex, when it is let go."""
    if not table.top.convex:
        return False
    points = transform(start.T_world_obj, start.hull.vertices)[:, :2]
    return bool(inside_margin(points, table.top.outline).min() > 0.0)


def _dynamics(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    return AT_REST if all(start.placed for start in starts) else None


def _table_mesh(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    if all(start.placed for start in starts):
        return AT_REST
    over = all(starts_over_top(start, table) for start in starts)
    return "all starts over the table's convex flat top, and nothing left it" if over else None


def _fine_step(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    return AT_REST if all(start.placed for start in starts) else None


def _rolling(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    if all(start.placed for start in starts):
        return AT_REST
    return None if any(is_round(start.hull) for start in starts) else "nothing here is round"


def _restitution(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    return "physics.restitution is 0" if physics.restitution == 0.0 else None


PREDICATES: dict[str, Predicate] = {
    "dynamics": _dynamics,
    "table_mesh": _table_mesh,
    "fine_step": _fine_step,
    "rolling_friction": _rolling,
    "restitution": _restitution,
}

_COSTS = {
    "dynamics": "milliseconds a scene",
    "table_mesh": "the simulation takes several times as long",
    "fine_step": "up to 16 times as many steps while things move fast",
    "rolling_friction": "three rows more for each pair in contact",
    "restitution": "the fall is simulated for longer",
}


def _effect(name: str, predicate: Predicate) -> Effect:
    def skipped_because(facts: Facts) -> str | None:
        return predicate(facts.plan.objects, facts.plan.table, facts.job.physics)

    kind = "asked" if name == "restitution" else "approximation"
    return Effect(name, kind, skipped_because, _COSTS[name], "physics")  # type: ignore[arg-type]


PHYSICS_EFFECTS: tuple[Effect, ...] = tuple(_effect(name, predicate) for name, predicate in PREDICATES.items())


def called_for(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> frozenset[str]:
    """Names of the effects of physics that these objects call for."""
    return frozenset(name for name, skipped in PREDICATES.items() if skipped(starts, table, physics) is None)
