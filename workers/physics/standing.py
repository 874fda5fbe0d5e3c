"""Whether an object that is calm on level ground stays as it stands, so that nothing is left to simulate. Pure."""

import math
from collections.abc import Callable

from schemas.scene.plan import ObjectStart
from workers.geometry.frames import invert
from workers.physics.energy import LIFT_M, Velocity, energy_height_m
from workers.physics.rest_pose import find_face
from workers.physics.rigid_body import Body, BodyPose, as_pose

SLIDE_M = 1e-7
"""Distance that an object may still slide. Bullet's own steps at rest move it by as much."""

StandingCondition = Callable[[BodyPose, Velocity], bool]
"""Whether a body at this pose and velocity stays on the face below it."""


def stays_standing(start: ObjectStart, body: Body, top_m: float, friction: float) -> StandingCondition:
    """The condition of an object over a flat top at the height `top_m`, with this coefficient of friction.

    It has less energy than it takes to tip over the nearest edge of a steady face, and than friction takes up in `SLIDE_M`:
    m g h <= friction m g s. Energy may rise in the simulation, but not by more than `LIFT_M`.
    """
    radii2 = [float(moment) / body.mass_kg for moment in body.moments]
    T_body_obj = invert(body.T_obj_body)

    def stands(at: BodyPose, moving: Velocity) -> bool:
        energy_m = energy_height_m(radii2, at, moving)
        moving_m = energy_m - at[0][2]
        if moving_m > friction * SLIDE_M:
            return False
        face = find_face(as_pose(at) @ T_body_obj, start.hull, start.asset.mass.com)
        if face is None:
            return False
        over_m = max(0.0, energy_m - top_m - face.height_m)
        return over_m + LIFT_M <= math.hypot(face.height_m, face.margin_m) - face.height_m

    return stands
