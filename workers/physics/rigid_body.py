"""The rigid bodies that the simulator is given: convex parts about a centre of mass. Pure."""

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart
from schemas.scene.shape import MassProperties
from workers.geometry.frames import invert, pose, rotation_from_quaternion, transform
from workers.geometry.hull import convex_hull, depth_m
from workers.geometry.lathe_decomposition import COARSE, TOLERANCE
from workers.physics.convex_parts import parts_of
from workers.physics.effects import is_convex

MARGIN_M = 2e-5
"""Collision margin, by which shapes hover: the least at which what rests is still found without overlap of the shapes
themselves, which takes Bullet longer."""

MARGIN_SHARE = 2e-4
"""Upper bound on the margin as a share of the reach: what is a few millimetres small would lean by it."""

DIRECTIONS = 96
"""Directions, evenly over a sphere, in which coarse parts keep their farthest vertex: a third of the time of a pile's step
goes where Bullet looks for it."""

CORE_SHARE = 0.5
"""Radius of the core of octants, as a share of the depth of the centre of mass in the hull. It gives a volume to a part with
a single vertex."""

BodyPose = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position, metres, and quaternion (x, y, z, w) of a body frame, whose origin is the centre of mass."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body in its centre of mass and principal axes, which `T_obj_body` [4, 4] takes to the object's frame.

    moments [3] kg m^2; parts: the vertices [N, 3], metres, of convex parts, each with a margin of `margin_m` about it. One
    part may be a single point, which makes a ball of the margin. reach_m: from the centre of mass to the farthest vertex of
    the object. category: of the object, by which its friction is known.
    """

    mass_kg: float
    moments: Array
    parts: tuple[Array, ...]
    margin_m: float = MARGIN_M
    T_obj_body: Pose = field(default_factory=lambda: np.eye(4))
    reach_m: float = 0.0
    category: str = ""


def choose_collision_shape(start: ObjectStart, physics: Physics) -> ObjectStart:
    """The object with its bounding box, along its own axes, as its hull where `physics.collision` is box.

    Its lowest point keeps its height.
    """
    if physics.collision != "box":
        return start
    lower, upper = start.hull.vertices.min(axis=0), start.hull.vertices.max(axis=0)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (upper - lower) + lower
    low = [float(transform(start.T_world_obj, points)[:, 2].min()) for points in (start.hull.vertices, corners)]
    T = start.T_world_obj.copy()
    T[2, 3] += low[0] - low[1]
    return dataclasses.replace(start, hull=convex_hull(corners), T_world_obj=frozen_array(T))


def build_body(
    start: ObjectStart, physics: Physics, effects: EffectPlan, coarse: bool = False, level: bool = False
) -> Body:
    """The object as its convex parts where the effect `decomposition` runs and it has several, else as its hull.

    coarse: several parts are fewer and have fewer vertices. level: it meets nothing but level ground, so that a hull may be cut
    into `octants`.
    """
    if not effects.runs("decomposition") or is_convex(start):
        body = make_body(start)
        deep_m = depth_m(start.hull.vertices - start.asset.mass.com, start.hull.normals) if level else 0.0
        return dataclasses.replace(body, parts=octants(body.parts[0], deep_m)) if level else body
    parts = parts_of(start.asset, physics.concavity, COARSE if coarse else TOLERANCE)
    return make_body(start, parts if len(parts) > 1 else (), coarse)


def octants(points: Array, deep_m: float) -> tuple[Array, ...]:
    """The vertices [N, 3] of a hull about the origin by the signs of their coordinates, each part with a core about the origin.

    deep_m: the depth of the origin in the hull.

    A hull meets level ground with its vertices alone, and these are the parts'. Bullet looks only at parts near the ground, and
    finds a contact of each in a step, where it finds one of a hull: what lands flat would be turned and pushed aside.
    """
    core = CORE_SHARE * deep_m * np.concatenate([np.eye(3), -np.eye(3)])
    octant = (points > 0.0) @ np.array([1, 2, 4])
    return tuple(np.concatenate([points[octant == number], core]) for number in np.unique(octant))


def _outermost(points: Array) -> Array:
    """Those of points [N, 3] that are the farthest in one of `DIRECTIONS` directions, where there are more than half of that.

    Of a ball the hull loses a three-hundredth of the radius. Of a rim that ends a cylinder nearly all points stay.
    """
    if len(points) <= DIRECTIONS // 2:
        return points
    k = np.arange(DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * k / DIRECTIONS, math.pi * (1.0 + math.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z])
    return points[np.unique((points @ directions).argmax(axis=0))]


def make_body(start: ObjectStart, parts: tuple[Array, ...] = (), coarse: bool = False) -> Body:
    """The object as its hull, or as convex `parts` (vertices [N, 3], object frame) where there are any.

    coarse: parts have fewer vertices.
    """
    T_obj_body, moments = body_frame(start.asset.mass)
    T_body_obj = invert(T_obj_body)
    reach_m = float(np.linalg.norm(transform(T_body_obj, start.hull.vertices), axis=1).max())
    vertices = tuple(transform(T_body_obj, each) for each in parts or (start.hull.vertices,))
    if coarse and parts:
        vertices = tuple(map(_outermost, vertices))
    margin_m = min(MARGIN_M, MARGIN_SHARE * reach_m)
    return Body(start.asset.mass.mass_kg, moments, vertices, margin_m, T_obj_body, reach_m, start.asset.category)


def body_frame(mass: MassProperties) -> tuple[Pose, Array]:
    """Centre of mass and principal axes: `T_obj_body` [4, 4], and the principal moments [3] kg m^2."""
    moments, axes = np.linalg.eigh(mass.inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return pose(axes, mass.com), moments


def as_pose(at: BodyPose) -> Pose:
    """[4, 4] of a position and a quaternion."""
    position, quaternion = at
    return pose(rotation_from_quaternion(np.array(quaternion)), np.array(position))
