"""Motion of a settled scene that is released again with every effect of physics on, and the mask pixels that it changes."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from schemas.base import Pose
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.shape import Shape
from schemas.scene.view import Camera, View
from workers.geometry.camera import project
from workers.geometry.frames import invert, motion_between, transform
from workers.geometry.raycast import NEAR_M, edge_distance_px
from workers.physics.settle import release_again
from workers.render.raster.gbuffer import Renderer
from workers.scene.context import WorkerContext
from workers.scene.effects import Facts, names_of_kind, plan_effects
from workers.scene.make_scene import Scene

RELEASE_S = 1.0

MOST_MM = 0.05
MOST_DEG = 0.01
"""Largest motion of an object: a few pixels of a mask at most."""

EDGE_PX = 1.0 / 128.0
"""Rounding of vertices by the rasteriser: 1/256 px in each of two images."""


@dataclass(frozen=True)
class Motion:
    """Largest motion of an object, changed mask pixels, and those too far from a silhouette to be explained by the motion."""

    moved_mm: float = 0.0
    turned_deg: float = 0.0
    pixels_changed: int = 0
    pixels_outside: int = 0

    def join(self, other: "Motion") -> "Motion":
        """The larger motion and the sum of pixels of two."""
        return Motion(
            max(self.moved_mm, other.moved_mm),
            max(self.turned_deg, other.turned_deg),
            self.pixels_changed + other.pixels_changed,
            self.pixels_outside + other.pixels_outside,
        )

    def describe_excess(self) -> list[str]:
        """Values beyond their bounds, a phrase each."""
        found = []
        if not self.moved_mm <= MOST_MM:
            found.append(f"it moved {self.moved_mm:.4f} mm, the bound is {MOST_MM} mm")
        if not self.turned_deg <= MOST_DEG:
            found.append(f"it turned {self.turned_deg:.5f} degrees, the bound is {MOST_DEG}")
        if self.pixels_outside:
            found.append(f"{self.pixels_outside} mask pixels changed away from any silhouette")
        return found


def measure_motion(context: WorkerContext, scene: Scene) -> Motion:
    """Release the scene for `RELEASE_S` and draw its masks again."""
    facts = Facts(context.job, scene.plan, scene.raycast_checked)
    effects = plan_effects(facts, names_of_kind("approximation"))
    poses = release_again(scene.plan, scene.settled, context.job.physics, effects, RELEASE_S)
    found = Motion()
    for start, rest, pose in zip(scene.plan.objects, scene.settled, poses, strict=True):
        found = found.join(move_between(start.asset.shape, rest.T_world_obj, pose))
    at = {start.region_id: pose for start, pose in zip(scene.plan.objects, poses, strict=True)}
    things = (
        dataclasses.replace(thing, T_world_shape=at[thing.region_id]) if thing.region_id in at else thing
        for thing in scene.posed.things
    )
    after = dataclasses.replace(scene.posed, things=tuple(things))
    for view in (view for pair in scene.pairs for view in pair.views if view.region is not None):
        changed, outside = compare_masks(context.renderer, scene.posed, after, view)
        found = found.join(Motion(pixels_changed=changed, pixels_outside=outside))
    return found


def move_between(shape: Shape, before: Pose, after: Pose) -> Motion:
    """Largest motion of a shape's points, and its turn, between two poses [4, 4]."""
    moved_m, turned_rad = motion_between(shape.vertices, before, after)
    return Motion(moved_m * 1e3, math.degrees(turned_rad))


def compare_masks(renderer: Renderer, before: PosedScene, after: PosedScene, view: View) -> tuple[int, int]:
    """(changed mask pixels, those farther from a silhouette than the motion in the image plus `EDGE_PX`)."""
    region = renderer.draw(after.things, after.appearance, view.camera).region
    changed = np.argwhere(region != view.region)
    if not len(changed):
        return 0, 0
    reach = EDGE_PX + max(shift_px(a, b, view.camera) for a, b in zip(before.things, after.things, strict=True))
    away = edge_distance_px(before.things, view.camera, changed, outline_only=True)
    return len(changed), int((away > reach).sum())


def shift_px(before: Placed, after: Placed, camera: Camera) -> float:
    """Largest motion in the image, pixels, of a vertex in front of the camera."""
    if before is after:
        return 0.0
    ends = [transform(invert(camera.T_world_cam) @ one.T_world_shape, one.shape.vertices) for one in (before, after)]
    seen = (ends[0][:, 2] > NEAR_M) & (ends[1][:, 2] > NEAR_M)
    (u0, v0), (u1, v1) = (project(points[seen], camera.intrinsics) for points in ends)
    return float(np.hypot(u1 - u0, v1 - v0).max(initial=0.0))
