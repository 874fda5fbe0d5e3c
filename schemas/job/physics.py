"""The `start` and `physics` branches of a job: how objects begin, and how they come to rest."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, PlainSerializer, Tag, model_validator

from schemas.base import (
    Counts,
    Frozen,
    Interval,
    NonNegative,
    Positive,
    Range,
    Share,
    among_kinds,
    read_counts,
    write_counts,
)
from schemas.job.assets import SurfaceName, value_of

MOST_OBJECTS = 50
"""Largest number of objects in a scene."""

ONE_OBJECT = Counts(1, 1)


ObjectCount = Annotated[
    Counts,
    BeforeValidator(lambda value: read_counts(value, MOST_OBJECTS)),
    PlainSerializer(write_counts),
]
"""A range of counts, written as one number where both ends are equal."""


class Start(Frozen):
    """How an object begins."""

    pose: Literal["upright", "tumbled", "placed", "as_given"] = "upright"
    """upright: uniform yaw; tumbled: uniform rotation; placed: set down at rest, no drop unless it would tip; as_given: as its
    file has it, for `scene: studio`."""
    offset_m: Interval = Range(-0.25, 0.25)
    """Offset from the centre of the table top, along x and y."""
    arrange: Literal["spread", "pile"] = "spread"
    """Arrangement of several objects: each in its own place, or falling onto one another."""
    pile_offset_m: Interval = Range(-0.03, 0.03)
    """Offset of each further object of a pile from the first, along x and y."""
    clearance_m: Interval = Range(0.005, 0.05)
    """Height of the lowest point above what is below it when a drop starts."""
    if_lost: Literal["redraw", "remove", "fail"] = "redraw"
    """An object that leaves the table or finds no balance is dropped again from a new start, removed, or a failure."""


Collision = Literal["planned", "box", "hull", "parts"]


SPIN_PER_SPEED = 0.01
"""rad/s for each mm/s: what turns so slowly moves so slowly 100 mm from its middle."""


class Rest(Frozen):
    """When an object counts as resting: it drifts and turns more slowly than this for the whole window."""

    speed_mm_s: Annotated[float, Field(ge=0.01)] = 1.0
    """Bound on the drift of the object's farthest point; it turns at most at 0.01 rad/s for each mm/s of it."""
    window_s: Positive = 0.25
    """Time for which both must hold; a fifth of it for a single object on a flat top."""

    @property
    def spin_rad_s(self) -> float:
        """Bound on the rate at which an object turns."""
        return SPIN_PER_SPEED * self.speed_mm_s


USUAL_FRICTION = 0.7

Coefficient = Annotated[float, Field(ge=0, le=5)]

Friction = Annotated[
    Annotated[Coefficient, Tag("[number]")]
    | Annotated[dict[SurfaceName, Coefficient], Field(min_length=1), Tag("[map]")],
    among_kinds("[number]", "[map]"),
]


class Physics(Frozen):
    """PyBullet's settings."""

    step_hz: Annotated[int, Field(ge=30, le=20_000)] = 960
    """Steps a second while all objects move slowly; up to 16 times as many otherwise (docs/rest.md)."""
    max_step_travel_mm: Positive = 0.05
    """Largest travel of the fastest point in a step; six times as much for a single object's first fall, forty times among
    several, eighty among many concave ones."""
    solver_iterations: Annotated[int, Field(ge=1, le=10_000)] = 100
    """Iterations of the contact solver in each step."""
    max_settle_s: Positive = 20.0
    """Simulated time after which an object that still moves is a failure."""
    rest: Rest = Rest()
    """When an object counts as resting."""
    friction: Friction = USUAL_FRICTION
    """Of each body; a contact's is the product of the two, at most 10. Or by category, `{mug: 0.3, table: 1.2}`, where
    others have the default."""
    rolling_friction: Annotated[float, Field(ge=0, le=0.01)] = 0.0005
    """Of each body, metres: Bullet's torque is this, times the sum of the two bodies' `friction`, times the contact force."""
    spinning_friction: NonNegative = 0.0005
    """Of each body, metres: the same torque about the contact's normal."""
    restitution: Share = 0.0
    """Of each body; a contact's is the product of the two."""
    collision: Collision = "planned"
    """Shape of an object in the simulator. planned: its hull where it moves over a flat table top alone, else its convex parts;
    box: its bounding box."""
    concavity: Annotated[float, Field(ge=0.01, le=1)] = 0.05
    """Largest depth of a hollow that convex parts fill, for a mesh scaled to size 2."""
    exact_rest: bool = True
    """Whether objects are brought to exact rest, and refused beyond the gate of docs/rest.md."""

    def friction_of(self, category: str) -> float:
        """The coefficient of a body of this category, or of the `table`."""
        return value_of(self.friction, category, USUAL_FRICTION)

    @property
    def varies(self) -> bool:
        """Whether friction is by category."""
        return isinstance(self.friction, dict)

    @model_validator(mode="after")
    def _rests_in_time(self) -> "Physics":
        """Raises ValueError where nothing could rest before the simulation ends."""
        if self.rest.window_s >= self.max_settle_s:
            raise ValueError(
                f"rest.window_s is {self.rest.window_s:g} s and max_settle_s {self.max_settle_s:g} s: nothing can have "
                "rested for so long by then"
            )
        return self
