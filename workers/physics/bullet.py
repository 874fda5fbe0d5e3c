"""Rigid bodies falling onto a ground, in PyBullet. The one file that imports PyBullet, so that it can be replaced."""

import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from schemas.base import Array, Pose
from schemas.errors import SettleError
from schemas.job.physics import Physics
from schemas.scene.shape import Mesh
from workers.geometry.frames import quaternion_from_rotation
from workers.physics.bullet_buffers import Numbers
from workers.physics.silence_stderr import silence_c_stderr
from workers.physics.stop_conditions import SAME_PLANE_M, Motion

with silence_c_stderr():
    import pybullet

GRAVITY_M_S2 = 9.81

SLAB_HALF_M = (2.0, 2.0, 0.25)
"""Half the sides of the box that stands for level ground: larger and thicker than any table, so that nothing sinks
through it. Bullet's plane is twice as fast and worse: it gives one contact a step, so that a box which lands on an edge
turns about the vertical by ten times as much as on the box."""

MOST_GROUND_VERTICES, MOST_GROUND_INDICES = 131_072, 524_288
"""PyBullet's limits on one collision mesh; it fails beyond them without a word why."""

SLOP_M = 1e-5
"""How deep bodies overlap at rest: Bullet leaves as much where it is."""

REPAIR = 0.05
"""Share of what overlaps further that is pushed apart in a step. What is pushed keeps the speed, which is that share of the
depth over the step: with 0.2 things that roll over edges gain energy, with 0.4 boxes are thrown up."""

REPAIR_S = 1.0 / 48.0
"""Of one body on level ground, no more is pushed apart than its depth over this time: with one share for all steps the
shortest throw it up sixteen times as fast as the longest, and what rolls from one lowest corner to the next gains energy all
the way. In a pile, where bodies press on one another, and on a mesh that is too little."""

BOUNCE_REPAIR_S = 10.0 * REPAIR_S
"""The same while things bounce, which they do from where they overlap by a step's way: it throws them up by so much less."""

ROUND_TO = 8
"""Decimals of a collision shape's vertices, metres. Where more than three lie in a plane but for the last bits, Bullet's own
hull leaves out some that are in it."""

REACH_SHARE = 0.02
"""Bullet's own: contacts are looked for and kept at up to this share of the smaller body's size."""

NO_THRESHOLD = 1e18
"""Bullet's own: contacts count as soon as they are foreseen."""

FASTEST = 1e4
"""m/s and rad/s: what moves faster is held to it. Bullet's own is 100, and what is small spins faster where it lands."""

WORLDS_BEFORE_RESET = 32
"""What is removed from a simulation leaves some kilobytes behind, which only a reset frees; a reset costs as much as
fifty milliseconds of simulated time."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body about its centre of mass and along its principal axes.

    moments [3] kg m^2; parts: the vertices [N, 3], metres, of convex bodies, each with a margin of `margin_m` about it. One
    part may be a single point, which makes a ball of the margin. `rolls` is False where friction against rolling and
    spinning is left out. `damping` is Bullet's, of speed and spin: nothing is damped that falls.
    """

    mass_kg: float
    moments: Array
    parts: tuple[Array, ...]
    margin_m: float
    rolls: bool = True
    damping: float = 0.0


@dataclass(frozen=True)
class World:
    """A ground and bodies on it, `steps` steps of the simulation at a time; bodies are told by their number.

    What overlaps is pushed apart at no more than its depth over `repair_s`.
    """

    client: int
    ground: int
    bodies: tuple[int, ...]
    steps: int
    repair_s: float = 0.0

    def advance(self) -> None:
        """The steps that the world was opened for."""
        pybullet.stepSimulation(physicsClientId=self.client)

    def pace(self, step_hz: float, bounces: bool = False) -> None:
        """Go on at so many steps a second."""
        repair_s = max(BOUNCE_REPAIR_S if bounces else self.repair_s, 1.0 / (REPAIR * step_hz))
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.steps / step_hz,
            numSubSteps=self.steps,
            contactERP=1.0 / (step_hz * repair_s),
            physicsClientId=self.client,
        )

    def pose(self, body: int = 0) -> Motion:
        """Where a body is."""
        position, quaternion = pybullet.getBasePositionAndOrientation(self.bodies[body], physicsClientId=self.client)
        return position, quaternion

    def velocity(self, body: int = 0) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Velocity, m/s, of the centre of mass, and angular velocity, rad/s."""
        v, w = pybullet.getBaseVelocity(self.bodies[body], physicsClientId=self.client)
        return v, w

    def push(self, velocity: Sequence[float], spin: Sequence[float] = (0.0, 0.0, 0.0), body: int = 0) -> None:
        """Give a centre of mass a velocity, m/s, and the body an angular velocity, rad/s, in world coordinates."""
        pybullet.resetBaseVelocity(self.bodies[body], list(velocity), list(spin), physicsClientId=self.client)

    def pull(self, gravity: Sequence[float]) -> None:
        """Another gravity, m/s^2, in this world alone: a level ground in it is a slope."""
        pybullet.setGravity(*gravity, physicsClientId=self.client)

    def bounce(self, restitution: float) -> None:
        """Give ground and bodies this restitution from now on; a contact's is the product of its two.

        Bullet solves contacts before they close, and takes speed away in portions that are too slow to bounce: with steps
        shorter than its contact distance over the speed nothing bounces. So what bounces waits until it overlaps.
        """
        for thing in (self.ground, *self.bodies):
            pybullet.changeDynamics(
                thing,
                -1,
                restitution=restitution,
                contactProcessingThreshold=0.0 if restitution > 0.0 else NO_THRESHOLD,
                physicsClientId=self.client,
            )


@contextmanager
def open_world(
    placed: Sequence[tuple[Body, Pose]], ground: float | Mesh, physics: Physics, steps: int, reach_m: float = math.inf
) -> Iterator[World]:
    """A world with nothing but the bodies, each at its `T_world_body`, and the ground.

    Which is level at a height in metres, or a mesh, which then has no margin. `reach_m` is how far from a mesh things may have
    contacts, if it is less than Bullet's own. Of two contacts that a vertex has with triangles of a mesh Bullet keeps the one
    that it finds last: beside an edge a corner sinks in as long as the next triangle is in reach. On level ground less reach
    would keep more of what rolls from gaining energy, but bowls then spin for ever.

    Bit-identical runs need deterministicOverlappingPairs. One connection serves the whole process: a new one costs as
    much as a simulation. What was simulated before leaves no trace in the bits: two bodies are one pair, so that no
    order of pairs, contacts or islands can differ, and for more bodies all is reset first. Blocks do not nest.
    """
    client = _connection()
    if len(placed) > 1:
        _reset(client)
    reach = reach_m if isinstance(ground, Mesh) else math.inf
    pybullet.setPhysicsEngineParameter(
        numSolverIterations=physics.solver_iterations,
        deterministicOverlappingPairs=1,
        contactBreakingThreshold=min(REACH_SHARE, reach / min(_size_m(body) for body, _ in placed)),
        physicsClientId=client,
    )
    pybullet.setGravity(0.0, 0.0, -GRAVITY_M_S2, physicsClientId=client)
    things: list[int] = []
    try:
        things.append(_add_mesh(client, ground) if isinstance(ground, Mesh) else _add_slab(client, ground))
        _set_surface(client, things[0], physics, Body(0.0, np.zeros(3), (), 0.0, rolls=False))
        for body, T_world_body in placed:
            level = len(placed) == 1 and _lies_flat(body, T_world_body)
            things.append(_add_body(client, body, T_world_body[:3, :3] if level else None))
            _set_surface(client, things[-1], physics, body)
            _place(client, things[-1], T_world_body)
        repair_s = REPAIR_S if len(placed) == 1 and not isinstance(ground, Mesh) else 0.0
        world = World(client, things[0], tuple(things[1:]), steps, repair_s)
        world.pace(physics.step_hz)
        if physics.restitution > 0.0:
            world.bounce(physics.restitution)
            world.pace(physics.step_hz, bounces=True)
        yield world
    finally:
        _clear(client, things, 1 + len(placed))


def drop(
    body: Body, T_world_body: Pose, ground: float | Mesh, physics: Physics, steps: int
) -> AbstractContextManager[World]:
    """A world with one body."""
    return open_world([(body, T_world_body)], ground, physics, steps)


@dataclass
class _Use:
    """How many worlds a connection has seen since it was reset."""

    worlds: int = 0


_NUMBERS = Numbers()
_USE = _Use()


@cache
def _connection() -> int:
    client: int = pybullet.connect(pybullet.DIRECT)
    return client


def _reset(client: int) -> None:
    pybullet.resetSimulation(physicsClientId=client)
    _USE.worlds = 0


def _clear(client: int, things: list[int], whole: int) -> None:
    _USE.worlds += 1
    if _USE.worlds >= WORLDS_BEFORE_RESET or len(things) < whole:
        _reset(client)
        return
    for thing in reversed(things):
        pybullet.removeBody(thing, physicsClientId=client)


def _add_slab(client: int, height_m: float) -> int:
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=SLAB_HALF_M, physicsClientId=client)
    return pybullet.createMultiBody(0, shape, basePosition=[0, 0, height_m - SLAB_HALF_M[2]], physicsClientId=client)


def _add_mesh(client: int, mesh: Mesh) -> int:
    if len(mesh.vertices) > MOST_GROUND_VERTICES or 3 * len(mesh.faces) > MOST_GROUND_INDICES:
        raise SettleError(
            "table_too_fine",
            f"the table has {len(mesh.vertices)} vertices and {len(mesh.faces)} faces, and PyBullet takes "
            f"{MOST_GROUND_VERTICES} and {MOST_GROUND_INDICES // 3}: use a coarser table, or lower assets.limits",
        )
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH,
        vertices=_NUMBERS.vertices(mesh.vertices),
        indices=_NUMBERS.indices(mesh.faces.ravel()),
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        physicsClientId=client,
    )
    return pybullet.createMultiBody(0, shape, physicsClientId=client)


def _lies_flat(body: Body, T_world_body: Pose) -> bool:
    """Whether at least three vertices of the body are its lowest."""
    height = np.concatenate(body.parts) @ T_world_body[2, :3]
    return bool(np.count_nonzero(height <= height.min() + SAME_PLANE_M) >= 3)


def _add_body(client: int, body: Body, R_world_body: Array | None) -> int:
    """The body, its shape given to Bullet in the world's axes where `R_world_body` [3, 3] says how these lie.

    Bullet's hulls are made on a grid of a ten-thousandth of their size along each axis, some 20 micrometres, on which only
    the outermost vertices are where they belong. Those are, in the world's axes, the ones that the body stands on. But a
    shape with axes of its own is a compound to Bullet, and compounds do not stay as well on one another.
    """
    parts = [np.round(part if R_world_body is None else part @ R_world_body.T, ROUND_TO) for part in body.parts]
    orientation = [0.0, 0.0, 0.0, 1.0] if R_world_body is None else quaternion_from_rotation(R_world_body.T).tolist()
    if len(parts) > 1:
        shape = _compound(client, parts, orientation)
    elif R_world_body is None:
        vertices = _NUMBERS.vertices(parts[0])
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=vertices, physicsClientId=client)
    else:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=_NUMBERS.vertices(parts[0]),
            collisionFrameOrientation=orientation,
            physicsClientId=client,
        )
    thing: int = pybullet.createMultiBody(body.mass_kg, shape, physicsClientId=client)
    pybullet.changeDynamics(thing, -1, localInertiaDiagonal=body.moments.tolist(), physicsClientId=client)
    return thing


def _compound(client: int, parts: Sequence[Array], orientation: list[float]) -> int:
    """One collision shape of many convex parts, which PyBullet takes from a file alone: the objects of an OBJ."""
    lines, first = [], 1
    for number, vertices in enumerate(parts):
        lines.append(f"o part{number}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
        lines += [f"f {first} {first + k} {first + k + 1}" for k in range(1, len(vertices) - 1)]
        first += len(vertices)
    with tempfile.TemporaryDirectory(prefix="verso-parts-") as folder:
        path = Path(folder, "parts.obj")
        path.write_text("\n".join(lines), encoding="ascii")
        shape: int = pybullet.createCollisionShape(
            pybullet.GEOM_MESH, fileName=str(path), collisionFrameOrientation=orientation, physicsClientId=client
        )
    return shape


def _set_surface(client: int, thing: int, physics: Physics, body: Body) -> None:
    # The arm of a contact is the sum over both of one's rolling friction times the other's friction: the ground's part is
    # given to the bodies, so that it is gone where a body has none.
    pybullet.changeDynamics(
        thing,
        -1,
        lateralFriction=physics.friction,
        rollingFriction=2.0 * physics.rolling_friction if body.rolls else 0.0,
        spinningFriction=2.0 * physics.spinning_friction if body.rolls else 0.0,
        restitution=0.0,
        collisionMargin=body.margin_m,
        linearDamping=body.damping,
        angularDamping=body.damping,
        maxJointVelocity=FASTEST,
        physicsClientId=client,
    )


def _size_m(body: Body) -> float:
    """What Bullet takes for a body's size: half the diagonal of its box, and how far its middle is from its centre of mass."""
    points = np.concatenate(body.parts)
    low, high = points.min(axis=0) - body.margin_m, points.max(axis=0) + body.margin_m
    return float(np.linalg.norm(high - low) + np.linalg.norm(high + low)) / 2.0


def _place(client: int, thing: int, T: Pose) -> None:
    quaternion = quaternion_from_rotation(T[:3, :3])
    pybullet.resetBasePositionAndOrientation(thing, T[:3, 3].tolist(), quaternion.tolist(), physicsClientId=client)
