"""Rigid bodies on a ground, simulated by PyBullet. The only module that imports PyBullet, so that it can be replaced.

Here too is what works around its flaws: it leaks the shapes that it is given, it prints when it is imported, and it takes
convex parts only as the text of an OBJ file.
"""

import math
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.errors import SettleError
from schemas.job.assets import TABLE
from schemas.job.physics import Physics
from schemas.scene.shape import Mesh
from workers.geometry.frames import quaternion_from_rotation
from workers.geometry.mesh import bounds_of
from workers.physics.rigid_body import Body, BodyPose
from workers.physics.support import stands_on_face

STDERR = 2


@dataclass(frozen=True)
class BulletBuffers:
    """Python objects with new contents for every call.

    PyBullet 3.2.7 takes a reference to each list of vertices or indices and to each item, and never releases it (190
    bytes a vertex).
    """

    points: list[list[float]] = field(default_factory=list)
    integers: list[int] = field(default_factory=list)
    vertex_list: list[list[float]] = field(default_factory=list)
    index_list: list[int] = field(default_factory=list)

    def vertices(self, points: Array) -> list[list[float]]:
        """[N, 3] as lists, valid until the next call."""
        self.points.extend([0.0, 0.0, 0.0] for _ in range(len(points) - len(self.points)))
        for mine, point in zip(self.points, points.tolist(), strict=False):
            mine[:] = point
        self.vertex_list[:] = self.points[: len(points)]
        return self.vertex_list

    def indices(self, values: NDArray[np.integer]) -> list[int]:
        """[N] non-negative integers as a list, valid until the next call."""
        self.integers.extend(range(len(self.integers), int(values.max()) + 1))
        self.index_list[:] = [self.integers[value] for value in values.tolist()]
        return self.index_list


@contextmanager
def silence_stderr() -> Iterator[None]:
    """Discard what C code prints to standard error; an exception is reported after the block, as usual.

    PyBullet prints its build time on import, at the head of every command's messages.
    """
    sys.stderr.flush()
    with open(os.devnull, "wb") as devnull:
        kept = os.dup(STDERR)
        os.dup2(devnull.fileno(), STDERR)
    try:
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)


DECIMALS = 8
"""Decimals that coordinates are rounded to, metres."""


def obj_of(parts: Sequence[Array]) -> bytes:
    """An object `part0`, `part1` ... for each part [N, 3], of which a reader wants the vertices: its faces are a fan over all.

    Coordinates are rounded to `DECIMALS` already. They have nine significant digits, those that float32 keeps.
    """
    texts = []
    for number, part in enumerate(parts):
        vertices = "v %.9g %.9g %.9g\n" * len(part) % tuple(part.ravel().tolist())
        texts.append(f"o part{number}\n{vertices}{_fan_over(len(part))}")
    return "".join(texts).encode("ascii")


@lru_cache(1024)
def _fan_over(count: int) -> str:
    """The faces over so many vertices, counted from the last vertex back, as OBJ allows, in any part alike."""
    return "".join(f"f {-count} {k - count} {k - count + 1}\n" for k in range(1, count - 1))


with silence_stderr():
    import pybullet

GRAVITY_M_S2 = 9.81

MOST_FRICTION = 10.0
"""Bullet's bound on the coefficient of a contact."""

SLAB_HALF_M = (2.0, 2.0, 0.25)
"""Half extents of the box for level ground, larger and thicker than any table. Bullet's plane is twice as fast but has one
contact per step: a box that lands on an edge turns about the vertical by ten times as much."""

MOST_GROUND_VERTICES, MOST_GROUND_INDICES = 131_072, 524_288
"""PyBullet's limits on one collision mesh; beyond them it fails without a reason."""

RESIDUAL_SHARE = 0.003
"""Change of velocity at which the solver stops to iterate, as a share of what gravity adds in a step. Bullet's default is a
thirtieth at 960 steps a second and half at 15,360: a cube of 2 mm at rest turns by half a degree a second then."""

SLOP_M, SLOP_SHARE = 1e-5, 0.5
"""Overlap that Bullet leaves, metres, or as a share of the smallest margin where that is less."""

REACH_SHARE = 0.02
"""Bullet's default: contacts are found and kept within this share of the smaller body's size."""

MOST_KEPT = 64
"""Drops of one body onto level ground after which Bullet is reset: the shapes of each stay until then, 75 kB."""

NO_THRESHOLD = 1e18
"""Bullet's default: contacts are solved as soon as they are predicted."""

LEAST_BOUNCE_M_S = 0.05
"""Slower impacts do not bounce, in Bullet at four times the speed: the rebound is at most an eighth of a millimetre high."""

AWAY_M = 100.0
"""Between bodies that are put away, and from the world's middle."""

GroundShape = float | Mesh | Array | list[Array] | tuple[Mesh, ...]
"""Level ground at a height, metres, without an end; a mesh, or several; or the vertices [N, 3] of a convex body, or of all parts
of one."""


def contact_friction(one: Array | float, other: Array | float) -> Array:
    """The coefficient of contacts between bodies of these, as Bullet has it: the product, at most `MOST_FRICTION`."""
    return np.minimum(np.multiply(one, other), MOST_FRICTION)


def bullet_file() -> str:
    """The shared library that is loaded as PyBullet."""
    return str(pybullet.__file__)


@dataclass(frozen=True)
class World:
    """A ground of one shape or more, and bodies, numbered in order. `advance` takes `steps` steps; `slop_m` of overlap stays."""

    client: int
    grounds: tuple[int, ...]
    bodies: tuple[int, ...]
    steps: int
    slop_m: float

    def advance(self) -> None:
        """Take the steps that the world was opened for."""
        pybullet.stepSimulation(physicsClientId=self.client)

    def set_rate(self, step_hz: float) -> None:
        """Set the steps per second, and by it how far the solver iterates."""
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.steps / step_hz,
            numSubSteps=self.steps,
            solverResidualThreshold=(RESIDUAL_SHARE * GRAVITY_M_S2 / step_hz) ** 2,
            physicsClientId=self.client,
        )

    def pose(self, body: int = 0) -> BodyPose:
        """Position and quaternion of a body frame."""
        position, quaternion = pybullet.getBasePositionAndOrientation(self.bodies[body], physicsClientId=self.client)
        return position, quaternion

    def velocity(self, body: int = 0) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Velocity of the centre of mass, m/s, and angular velocity, rad/s, world axes."""
        v, w = pybullet.getBaseVelocity(self.bodies[body], physicsClientId=self.client)
        return v, w

    def set_velocity(self, velocity: Sequence[float], spin: Sequence[float] = (0.0, 0.0, 0.0), body: int = 0) -> None:
        """Set the velocity of a centre of mass, m/s, and the angular velocity, rad/s, world axes."""
        pybullet.resetBaseVelocity(self.bodies[body], list(velocity), list(spin), physicsClientId=self.client)

    def let_sleep(self, body: int) -> None:
        """Compute no motion of a body in the next `advance`, and no contacts among such ones, unless one that moves touches it.

        Bullet wakes it after `advance` where there are other bodies.
        """
        asleep = pybullet.ACTIVATION_STATE_SLEEP
        pybullet.changeDynamics(self.bodies[body], -1, activationState=asleep, physicsClientId=self.client)

    def keep_apart(self, body: int, other: int) -> None:
        """Look for no contacts of these two bodies."""
        pair = self.bodies[body], self.bodies[other], -1, -1
        pybullet.setCollisionFilterPair(*pair, enableCollision=0, physicsClientId=self.client)

    def put_away(self, body: int) -> None:
        """Hold a body for ever where nothing meets it, at the height that it has."""
        (_, _, z), _ = self.pose(body)
        at = [AWAY_M * (body + 1), 0.0, z]
        pybullet.changeDynamics(self.bodies[body], -1, mass=0.0, physicsClientId=self.client)
        pybullet.resetBasePositionAndOrientation(self.bodies[body], at, [0, 0, 0, 1], physicsClientId=self.client)
        self.set_velocity((0.0, 0.0, 0.0), body=body)

    def set_restitution(self, restitution: float) -> None:
        """Set the restitution of ground and bodies; a contact's is the product of the two.

        Bullet solves contacts before they close and removes speed in portions too slow to bounce: with steps shorter than
        its contact distance over the speed nothing bounces. So contacts that bounce are solved only once bodies overlap, and no
        overlap is left to them: what is left over the step's time is missing from the rebound's speed.
        """
        slop_m = 0.0 if restitution > 0.0 else self.slop_m
        pybullet.setPhysicsEngineParameter(contactSlop=slop_m, physicsClientId=self.client)
        changes = {"restitution": restitution, "contactProcessingThreshold": 0.0 if restitution > 0.0 else NO_THRESHOLD}
        for thing in (*self.grounds, *self.bodies):
            pybullet.changeDynamics(thing, -1, physicsClientId=self.client, **changes)


@contextmanager
def open_world(
    placed: Sequence[tuple[Body, Pose]],
    ground: GroundShape,
    physics: Physics,
    steps: int,
    reach_m: float = math.inf,
    kept: float = 1.0,
) -> Iterator[World]:
    """Open a world of a ground and of bodies at their `T_world_body`.

    `reach_m`: contact distance, if less than Bullet's own. Of two contacts of a vertex with triangles of a mesh
    Bullet keeps the one found last: beside an edge a corner sinks in while the next triangle is in reach. On level ground a
    shorter reach would keep more rolling bodies from gaining energy, but bowls would spin for ever. `kept`: share of a contact's
    impulse that the next step begins with, among several bodies; what rolls over its corners alone would gain energy.

    Runs are bit-identical with deterministicOverlappingPairs, whatever ran before. One connection serves the process, because a
    new one costs as much as a simulation. Blocks do not nest.
    """
    client = _empty_world(plain=len(placed) == 1 and isinstance(ground, float))
    slop_m = min(SLOP_M, SLOP_SHARE * min(body.margin_m for body, _ in placed))
    pybullet.setPhysicsEngineParameter(
        numSolverIterations=physics.solver_iterations,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,  # it would keep every object's file, 60 kB
        useSplitImpulse=1,
        splitImpulsePenetrationThreshold=0.0,
        warmStartingFactor=kept if len(placed) > 1 else 0.0,
        restitutionVelocityThreshold=LEAST_BOUNCE_M_S,
        contactSlop=slop_m,
        contactBreakingThreshold=min(REACH_SHARE, reach_m / min(_size_m(body) for body, _ in placed)),
        physicsClientId=client,
    )
    pybullet.setGravity(0.0, 0.0, -GRAVITY_M_S2, physicsClientId=client)
    grounds = tuple(_add_ground(client, each, physics) for each in (ground if isinstance(ground, tuple) else (ground,)))
    things = []
    for body, T_world_body in placed:
        level = len(placed) == 1 and stands_on_face(np.concatenate(body.parts), -T_world_body[2, :3])
        things.append(_add_body(client, body, T_world_body[:3, :3] if level else None))
        _set_surface(client, things[-1], physics, body)
        position, quaternion = T_world_body[:3, 3].tolist(), quaternion_from_rotation(T_world_body[:3, :3]).tolist()
        pybullet.resetBasePositionAndOrientation(things[-1], position, quaternion, physicsClientId=client)
    world = World(client, grounds, tuple(things), steps, slop_m)
    world.set_rate(physics.step_hz)
    if physics.restitution > 0.0:
        world.set_restitution(physics.restitution)
    yield world


_BUFFERS = BulletBuffers()


@cache
def _connect() -> tuple[int, list[int]]:
    """A world without a renderer, which would read the file of every body's parts again, and [drops until its next reset]."""
    client: int = pybullet.connect(pybullet.DIRECT)
    pybullet.unloadPlugin(pybullet.loadPlugin("tinyRendererPlugin", physicsClientId=client), physicsClientId=client)
    return client, [0]


def _empty_world(plain: bool) -> int:
    """The connection, with nothing in its world. plain: one body on level ground comes next.

    A reset allots and fills megabytes, a sixth of the time of a default drop. It is done where there are several pairs of bodies,
    or triangles, of which Bullet keeps orders and counters; one pair has none. What a step of time leaves over would change last
    bits of what comes next: a step without substeps clears it.
    """
    client, left = _connect()
    if plain and left[0]:
        left[0] -= 1
        for number in reversed(range(pybullet.getNumBodies(physicsClientId=client))):
            pybullet.removeBody(pybullet.getBodyUniqueId(number, physicsClientId=client), physicsClientId=client)
        pybullet.setPhysicsEngineParameter(numSubSteps=0, physicsClientId=client)
        pybullet.stepSimulation(physicsClientId=client)
    else:
        left[0] = MOST_KEPT if plain else 0
        pybullet.resetSimulation(physicsClientId=client)
    return client


def _add_ground(client: int, ground: float | Mesh | Array | list[Array], physics: Physics) -> int:
    place = {}
    if isinstance(ground, Mesh):
        shape = _shape_of_mesh(client, ground)
    elif isinstance(ground, float):
        place = {"basePosition": [0, 0, ground - SLAB_HALF_M[2]]}
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=SLAB_HALF_M, physicsClientId=client)
    else:
        shape = _shape_of(client, ground if isinstance(ground, list) else [ground], {})
    thing: int = pybullet.createMultiBody(0, shape, useMaximalCoordinates=1, physicsClientId=client, **place)
    _set_surface(client, thing, physics)
    return thing


def _shape_of_mesh(client: int, mesh: Mesh) -> int:
    if len(mesh.vertices) > MOST_GROUND_VERTICES or 3 * len(mesh.faces) > MOST_GROUND_INDICES:
        raise SettleError(
            "table_too_fine",
            f"the table has {len(mesh.vertices)} vertices and {len(mesh.faces)} faces, and PyBullet takes "
            f"{MOST_GROUND_VERTICES} and {MOST_GROUND_INDICES // 3}: use a coarser table, or lower assets.limits",
        )
    flags = pybullet.GEOM_FORCE_CONCAVE_TRIMESH
    triangles = {"vertices": _BUFFERS.vertices(mesh.vertices), "indices": _BUFFERS.indices(mesh.faces.ravel())}
    return int(pybullet.createCollisionShape(pybullet.GEOM_MESH, flags=flags, physicsClientId=client, **triangles))


def _add_body(client: int, body: Body, R_world_body: Array | None) -> int:
    """Add the body, with its shape in the world's axes where `R_world_body` [3, 3] is given.

    Bullet builds hulls on a grid of a ten-thousandth of their size along each axis, some 20 micrometres, which keeps only
    the outermost vertices exact. In the world's axes these are the ones that the body stands on. But a shape with axes of its
    own is a compound to Bullet, and compounds are less stable on one another.
    """
    # Of four vertices and more that lie in one plane but for the last bits, Bullet's hull drops some
    parts = [np.round(part if R_world_body is None else part @ R_world_body.T, DECIMALS) for part in body.parts]
    turned = {}
    if R_world_body is not None:
        turned["collisionFrameOrientation"] = quaternion_from_rotation(R_world_body.T).tolist()
    shape = _shape_of(client, parts, turned)
    # The margin of a compound's parts can be set through a body in reduced coordinates alone, which shares the shape.
    brief = pybullet.createMultiBody(body.mass_kg, shape, physicsClientId=client)
    pybullet.changeDynamics(brief, -1, collisionMargin=body.margin_m, physicsClientId=client)
    pybullet.removeBody(brief, physicsClientId=client)
    thing: int = pybullet.createMultiBody(body.mass_kg, shape, useMaximalCoordinates=1, physicsClientId=client)
    moments = body.moments.tolist()
    pybullet.changeDynamics(thing, -1, mass=body.mass_kg, localInertiaDiagonal=moments, physicsClientId=client)
    return thing


def _shape_of(client: int, parts: Sequence[Array], turned: Mapping[str, list[float]]) -> int:
    """A collision shape of convex parts. PyBullet reads several from a file alone: the objects of an OBJ."""
    given = {"physicsClientId": client, **turned}
    if len(parts) == 1:
        return int(pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=_BUFFERS.vertices(parts[0]), **given))
    path = Path(tempfile.gettempdir(), f"verso-parts-{uuid4().hex}.obj")  # `NamedTemporaryFile` takes twice as long
    try:
        path.write_bytes(obj_of(parts))
        return int(pybullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path), **given))
    finally:
        path.unlink(missing_ok=True)


LEAST_ROLLING_M = 1e-12
"""Rolling friction that changes nothing but that spinning friction acts."""


def _set_surface(client: int, thing: int, physics: Physics, body: Body | None = None) -> None:
    """Set friction and margin of a body, or of the ground, and no damping."""
    # Bullet has spinning friction only where there is rolling friction (bullet3 #4188)
    least = LEAST_ROLLING_M if physics.spinning_friction else 0.0
    pybullet.changeDynamics(
        thing,
        -1,
        lateralFriction=physics.friction_of(TABLE if body is None else body.category),
        rollingFriction=max(physics.rolling_friction, least),
        spinningFriction=physics.spinning_friction,
        restitution=0.0,
        collisionMargin=0.0 if body is None else body.margin_m,
        linearDamping=0.0,
        angularDamping=0.0,
        physicsClientId=client,
    )


def _size_m(body: Body) -> float:
    """Bullet's measure of a body: half the diagonal of its box, plus the distance of its middle from the centre of mass."""
    low, high = np.add(bounds_of(np.concatenate(body.parts)), [[-body.margin_m], [body.margin_m]])
    return float(np.linalg.norm(high - low) + np.linalg.norm(high + low)) / 2.0
