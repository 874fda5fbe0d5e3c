"""The rigid bodies that the simulator is given: convex parts about a centre of mass. Pure."""

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.job.physics import Physics
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart
from schemas.scene.shape import MassProperties
from workers.geometry.frames import invert, pose, transform
from workers.geometry.hull import convex_hull
from workers.geometry.hull_offset import offset_hull
from workers.geometry.lathe_decomposition import COARSE, TOLERANCE
from workers.physics.convex_parts.step import parts_of
from workers.physics.effects import is_convex

SLOP_M = 1e-5
"""Depth of overlap that Bullet leaves between bodies at rest."""

COARSE_MARGIN_M = 2e-5
"""Collision margin of coarse parts, by which they hover: the least at which what rests is still found without overlap of the
parts themselves, which takes Bullet longer."""

DIRECTIONS = 128
"""Directions, evenly over a sphere, in which coarse parts keep their farthest vertex: a third of the time of a pile's step
goes where Bullet looks for it."""

BodyPose = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position, metres, and quaternion (x, y, z, w) of a body frame, whose origin is the centre of mass."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body in its centre of mass and principal axes, which `T_obj_body` [4, 4] takes to the object's frame.

    moments [3] kg m^2; parts: the vertices [N, 3], metres, of convex parts, each with a margin of `margin_m` about it. One
    part may be a single point, which makes a ball of the margin. reach_m: from the centre of mass to the farthest vertex of
    the object.
    """

    mass_kg: float
    moments: Array
    parts: tuple[Array, ...]
    margin_m: float
    T_obj_body: Pose = field(default_factory=lambda: np.eye(4))
    reach_m: float = 0.0


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


def build_body(start: ObjectStart, physics: Physics, effects: EffectPlan, coarse: bool = False) -> Body:
    """The object as its convex parts where the effect `decomposition` runs and it has several, else as its hull.

    coarse: several parts are fewer and have fewer vertices, and are as large as the object and a margin about it.
    """
    parts: tuple[Array, ...] = ()
    if effects.runs("decomposition") and not is_convex(start):
        parts = parts_of(start.asset, physics.concavity, COARSE if coarse else TOLERANCE)
    if not coarse or len(parts) < 2:
        return make_body(start, physics, parts if len(parts) > 1 else ())
    T_obj_body, moments = body_frame(start.asset.mass)
    points = transform(invert(T_obj_body), start.hull.vertices)
    reach_m = float(np.linalg.norm(points, axis=1).max())
    vertices = tuple(_outermost(transform(invert(T_obj_body), part)) for part in parts)
    return Body(start.asset.mass.mass_kg, moments, vertices, COARSE_MARGIN_M, T_obj_body, reach_m)


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


def make_body(start: ObjectStart, physics: Physics, parts: tuple[Array, ...] = ()) -> Body:
    """The object as its hull, or as convex `parts` (vertices [N, 3], object frame) where there are any.

    Bullet adds a margin around a collision shape. The shape is inset by the margin less `SLOP_M`, so that at rest its faces
    coincide with the object's.
    """
    T_obj_body, moments = body_frame(start.asset.mass)
    hulls = [convex_hull(part) for part in parts] or [start.hull]
    insets = [offset_hull(hull, physics.margin_mm / 1e3 - SLOP_M) for hull in hulls]
    offset_m = min(each.offset_m for each in insets)
    insets = [
        each if each.offset_m == offset_m else offset_hull(hull, offset_m)
        for each, hull in zip(insets, hulls, strict=True)
    ]
    margin_m = min(each.offset_m for each in insets) + SLOP_M
    T_body_obj = invert(T_obj_body)
    reach_m = float(np.linalg.norm(transform(T_body_obj, start.hull.vertices), axis=1).max())
    vertices = tuple(transform(T_body_obj, each.vertices) for each in insets)
    return Body(start.asset.mass.mass_kg, moments, vertices, margin_m, T_obj_body, reach_m)


def body_frame(mass: MassProperties) -> tuple[Pose, Array]:
    """Centre of mass and principal axes: `T_obj_body` [4, 4], and the principal moments [3] kg m^2."""
    moments, axes = np.linalg.eigh(mass.inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return pose(axes, mass.com), moments
