"""All randomness of a scene, drawn before anything moves."""

import math

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.camera import Camera, Intrinsics
from schemas.errors import StartError
from schemas.job import Cameras, Job
from schemas.scene import REGION_FIRST_OBJECT, ObjectStart, ScenePlan, Table
from schemas.shape import Asset, Hull, Mesh
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import (
    UP,
    pose,
    rotation_about,
    transform,
    translation,
    uniform_rotation,
)
from workers.geometry.heights import heights_at
from workers.geometry.hull import convex_hull
from workers.scene.appearance import draw_look
from workers.scene.contact import support_margin, touching
from workers.scene.randomness import Stream, stream
from workers.scene.support import place_table, support_height

RECESS_M = 0.05
"""Table this far below its top still counts as table under an object: a tray's bottom does, a lower shelf does not."""


def choose_category(job: Job, scene_id: int) -> str:
    """The scene's category, by the job's weights."""
    names = sorted(job.categories)
    weights = np.array([job.categories[name] for name in names])
    edges = np.cumsum(weights) / weights.sum()
    draw = stream(job.seed, scene_id, Stream.CATEGORY).random()
    return names[min(int(np.searchsorted(edges, draw, side="right")), len(names) - 1)]


def plan_scene(job: Job, scene_id: int, table_asset: Asset, asset: Asset) -> ScenePlan:
    """Everything about the scene that chance decides. Raises StartError where no start is valid."""
    table = place_table(table_asset)
    rng = stream(job.seed, scene_id, Stream.CAMERA)
    centre = np.array([0.0, 0.0, table.top.height_m])
    floor, appearance = draw_look(stream(job.seed, scene_id, Stream.APPEARANCE), job.render.tier)
    return ScenePlan(
        scene_id=scene_id,
        category=asset.category,
        table=table,
        floor=floor,
        objects=(draw_start(job, scene_id, asset, table),),
        input_cameras=tuple(draw_camera(rng, job.cameras, centre) for _ in range(job.pairs_per_scene)),
        appearance=appearance,
    )


def draw_start(job: Job, scene_id: int, asset: Asset, table: Table) -> ObjectStart:
    """Position, rotation and clearance of one object. A position with no table under the centre of mass is redrawn."""
    spec = job.start
    rng = stream(job.seed, scene_id, Stream.START)
    xy = rng.uniform(spec.offset_m.low, spec.offset_m.high, size=2)
    yaw = rng.uniform(-math.pi, math.pi)
    clearance = rng.uniform(spec.clearance_m.low, spec.clearance_m.high)
    R = uniform_rotation(rng) if spec.pose == "tumbled" else rotation_about(UP, yaw)
    again = stream(job.seed, scene_id, Stream.REDRAW)
    hull = convex_hull(asset.shape.vertices)
    for redraws in range(spec.max_redraws + 1):
        com_xy = (R @ asset.mass.com)[:2] + xy
        if heights_at(com_xy[None, :], table.mesh)[0] >= table.top.height_m - RECESS_M:  # nan compares false
            rested = set_down(pose(R, np.array([xy[0], xy[1], 0.0])), hull, table.mesh)
            placed = spec.pose == "placed" and stands_on(rested, hull, asset.mass.com, table.mesh)
            T = rested if placed else translation(0.0, 0.0, clearance) @ rested
            return ObjectStart(asset, hull, REGION_FIRST_OBJECT, frozen_array(T), redraws, placed)
        xy = again.uniform(spec.offset_m.low, spec.offset_m.high, size=2)
    raise StartError(
        "no_table_below",
        f"none of {spec.max_redraws + 1} positions in {list(spec.offset_m)} m had table under the centre of mass: "
        "narrow start.offset_m or use larger tables",
    )


def set_down(T_world_obj: Pose, hull: Hull, table: Mesh) -> Pose:
    """The pose moved along z until its lowest point is level with the highest of what is below it."""
    points = transform(T_world_obj, hull.vertices)
    return translation(0.0, 0.0, support_height(points[:, :2], table) - points[:, 2].min()) @ T_world_obj


def stands_on(T_world_obj: Pose, hull: Hull, com: Array, table: Mesh) -> bool:
    """Whether the centre of mass [3] lies inside the hull of the points that touch the table."""
    contacts = touching(hull, T_world_obj, table)
    return support_margin(contacts, transform(T_world_obj, com[None, :])[0, :2]) > 0.0


def draw_camera(rng: np.random.Generator, cameras: Cameras, centre: Array) -> Camera:
    """An input camera on the job's orbit about the centre of the table top."""
    inclination = rng.uniform(cameras.orbit.inclination_rad.low, cameras.orbit.inclination_rad.high)
    yaw = rng.uniform(cameras.orbit.yaw_rad.low, cameras.orbit.yaw_rad.high)
    T = orbit_pose(centre, inclination, yaw, cameras.orbit.radius_m)
    return Camera(Intrinsics.of(cameras.sensor), frozen_array(T))
