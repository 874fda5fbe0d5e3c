"""The `physics` branch of a job."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Frozen, NonNegative, Positive, Share

Collision = Literal["planned", "box", "hull", "parts"]


class Rest(Frozen):
    """When an object counts as resting: it drifts and turns more slowly than this for the whole window."""

    speed_mm_s: Positive = 1.0
    """Bound on the drift of the object's farthest point."""
    spin_rad_s: Positive = 0.01
    """Bound on the rate at which it turns."""
    window_s: Positive = 0.25
    """How long both must hold."""


class Physics(Frozen):
    """PyBullet's settings."""

    step_hz: Annotated[int, Field(ge=30, le=20_000)] = 960
    """Steps a second where all moves slowly; up to 16 times as many where it does not."""
    max_step_travel_mm: Positive = 0.05
    """How far the fastest point may go in a step; more in falls from above 35 mm, less for what is thinner than 1 mm."""
    solver_iterations: Annotated[int, Field(ge=1, le=10_000)] = 100
    """Iterations of the contact solver in each step."""
    max_settle_s: Positive = 20.0
    """Simulated time after which an object that still moves is a failure."""
    rest: Rest = Rest()
    """When an object counts as resting."""
    margin_mm: Annotated[float, Field(ge=0.02)] = 0.1
    """Collision margin of an object, which its collision shape is smaller by; less where it is thinner than four margins."""
    friction: NonNegative = 0.7
    """Of each body; contact friction is the product of the two."""
    rolling_friction: NonNegative = 0.0005
    """Of each body, metres: Bullet's torque against rolling is twice this, times `friction`, times the contact force."""
    spinning_friction: NonNegative = 0.0005
    """The same against spinning about the contact's normal."""
    restitution: Share = 0.0
    """Of each body; the restitution of a contact is the product of the two."""
    collision: Collision = "planned"
    """What stands for an object in the simulator. planned: its hull while it moves over the table's flat top alone, else
    its convex parts; hull, parts: always that; box: the box about it along its own axes."""
    concavity: Annotated[float, Field(ge=0.01, le=1)] = 0.05
    """How deep a hollow may be that convex parts fill, of a mesh that is 2 across; parts of built-in shapes are exact."""
    correction: bool = True
    """Whether what came to rest is turned onto its face and moved along z until the meshes touch."""
    snap_rad: NonNegative = 0.02
    """The final correction turns the object by at most this angle onto the face that it stands on."""
