"""The table of hard cases for cameras: what must hold of a view, or why there can be none.

A table 1.4 m square with a box 100 mm deep, 80 mm wide and 200 mm high on it; and a wall on the table in some.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from schemas.base import Array, Pose, Range, frozen_array
from schemas.job.job import Job
from schemas.scene.scene import Placed, PosedScene
from schemas.scene.view import Camera, Intrinsics
from tests.hard_cases.case import refuse
from tests.kit.shapes import box, shape_of, table
from tests.workers.render.random_scenes import APPEARANCE, VGA, floor
from workers.geometry.camera import look_at, orbit_pose, yaw
from workers.geometry.frames import UP, pose, rotation_about, translation
from workers.geometry.pixels import quantise_depth
from workers.geometry.raycast import cast_view, edge_distance_px
from workers.render.raster.gbuffer import Renderer
from workers.scene.cameras import place_mirror_camera
from workers.scene.pairs import object_distance
from workers.scene.ray_check import EDGE_PX, check_against_rays

JOB = Job(name="t")
HOLD = "must hold"
TOP_M, DEEP_M = 0.7, 0.1
CENTRE = np.array([0.0, 0.0, TOP_M])
MIDDLE = np.array([0.0, 0.0, TOP_M + 0.1])
QUANTUM_MM = 0.1
"""Half a stored unit of depth."""

Figure = Callable[[Renderer], float]


@dataclass(frozen=True, eq=False)
class CameraCase:
    """One row: `figure` draws, measures and raises what the program raises; it must be at most the bound."""

    name: str
    outcome: str
    what: str
    bound: float
    figure: Figure


def things(*more: trimesh.Trimesh) -> tuple[Placed, ...]:
    """Floor, table with whatever stands on it for good, and the box."""
    on_top = [mesh.copy().apply_translation((0, 0, TOP_M / 2)) for mesh in more]
    parts = shape_of(*on_top).parts if on_top else ()
    shape = dataclasses.replace(table().shape, parts=table().shape.parts + parts)
    thing = shape_of(box(DEEP_M, 0.08, 0.2))
    return (floor(), Placed(2, shape, translation(0, 0, TOP_M / 2)), Placed(3, thing, translation(*MIDDLE)))


def at(T: Pose, intrinsics: Intrinsics = VGA) -> Camera:
    return Camera(intrinsics, frozen_array(T))


def looking(position: Array | list[float], target: Array = MIDDLE) -> Pose:
    return look_at(np.asarray(position, np.float64), target)


def labels_px(T: Pose) -> Figure:
    """Pixels from an edge to the farthest pixel whose region is another than the ray caster's; and depth is held too."""

    def figure(renderer: Renderer) -> float:
        scene, camera = PosedScene(things(), APPEARANCE), at(T)
        first, again = (renderer.draw(scene.things, APPEARANCE, camera) for _ in range(2))
        assert first.region.tobytes() == again.region.tobytes() and first.depth_m.tobytes() == again.depth_m.tobytes()
        check_against_rays(scene, camera, first, Range(0.05, 20.0))
        differ = np.argwhere(first.region != cast_view(scene.things, camera)[1])
        assert (first.region >= 2).any(), "it sees neither the table nor the box"
        return float(edge_distance_px(scene.things, camera, differ, outline_only=True).max(initial=0.0))

    return figure


def labels(name: str, T: Pose) -> CameraCase:
    return CameraCase(name, HOLD, "farthest wrong pixel from an edge, px", EDGE_PX, labels_px(T))


def d_z_m(renderer: Renderer, camera: Camera, *more: trimesh.Trimesh) -> float:
    """d_z as a scene has it, from stored depth. Raises ViewError."""
    seen = renderer.draw(things(*more), APPEARANCE, camera)
    return object_distance(quantise_depth(seen.depth_m, JOB.images), seen.region, JOB.images, JOB.cameras.mirror)


def front(name: str, width: int, height: int) -> CameraCase:
    """d_z of a face across the optical axis, 2 m away, by a camera with so many pixels that all see it."""
    k = Intrinsics(width=width, height=height, fx=525.0, fy=525.0, cx=width / 2, cy=height / 2)
    camera = at(looking(MIDDLE + np.array([2.0 + DEEP_M / 2, 0.0, 0.0])), k)
    return CameraCase(
        name, HOLD, "d_z off 2 m, mm", QUANTUM_MM + 1e-6, lambda renderer: abs(d_z_m(renderer, camera) - 2.0) * 1e3
    )


def unseen(name: str, T: Pose, *more: trimesh.Trimesh) -> CameraCase:
    return CameraCase(name, refuse("object_not_seen"), "reason", 0.0, lambda r: d_z_m(r, at(T), *more))


def mirrored(T: Pose, d_z: float, T_z: float) -> Pose:
    """The mirror camera as a scene places it."""
    mirror = JOB.cameras.mirror.model_copy(update={"T_z_m": T_z})
    return place_mirror_camera(at(T), d_z, mirror).T_world_cam


def pivot_mm(T: Pose, d_z: float = 2.0, T_z: float = 1.3) -> Figure:
    """How far the point that the input camera sees at d_z is from the one that the mirror camera sees at T_z."""

    def figure(_: Renderer) -> float:
        M = mirrored(T, d_z, T_z)
        return float(np.linalg.norm(T[:3, 3] + d_z * T[:3, 2] - M[:3, 3] - T_z * M[:3, 2])) * 1e3

    return figure


def turned(T: Pose, degrees: float) -> Pose:
    """Rolled about the optical axis."""
    return T @ pose(rotation_about(UP, math.radians(degrees)), np.zeros(3))


def seam_mm(renderer: Renderer) -> float:
    """Depth of the view at yaw -pi against that at yaw pi, mm; the yaw that is told of each is one of the two."""
    ends = [orbit_pose(CENTRE, 0.8, sign * math.pi, 2.5) for sign in (-1.0, 1.0)]
    assert all(math.isclose(abs(yaw(T)), math.pi, abs_tol=1e-12) for T in ends)
    one, two = (renderer.draw(things(), APPEARANCE, at(T)) for T in ends)
    assert np.array_equal(one.region, two.region)
    return float(np.abs(one.depth_m.astype(np.float64) - two.depth_m).max()) * 1e3


DOWN = looking(CENTRE + np.array([0.0, 0.0, 2.5]), CENTRE)
ORBIT = orbit_pose(CENTRE, 0.8, 0.4, 2.5)
ROLLED = turned(ORBIT, 37.0)
LEVEL = looking([2.0, 0.3, MIDDLE[2]], np.array([0.0, 0.3, MIDDLE[2]]))
GRAZING = orbit_pose(CENTRE, math.radians(0.2), 0.4, 2.5)
LOW = looking([2.0, 0.0, 0.3])
IN_SLAB = looking([2.0, 0.0, TOP_M - 0.014], np.array([0.0, 0.0, TOP_M - 0.014]))
WALL = box(0.01, 0.6, 0.5, (0.3, 0.0, 0.25))
AWAY = looking([2.5, 0.0, 1.5], np.array([5.0, 0.0, 1.0]))

CAMERAS = (
    labels("camera straight down", DOWN),
    labels("camera level", LEVEL),
    labels("camera grazing the table at 0.2 degrees", GRAZING),
    labels("camera rolled by 37 degrees", ROLLED),
    labels("camera rolled by 180 degrees", turned(ORBIT, 180.0)),
    labels("camera below the top, box behind the table's edge", LOW),
    labels("mirror camera under the table's top", mirrored(LOW, 1.8, 1.3)),
    labels("mirror camera inside the table's slab", mirrored(IN_SLAB, 1.95, 0.5)),
    labels("mirror camera inside the box", mirrored(LEVEL @ translation(0.3, 0, 0), 1.95, 0.03)),
    labels("camera whose near plane cuts the box", looking(MIDDLE + np.array([0.09, 0.0, 0.0]))),
    CameraCase("mirror of a camera straight down", HOLD, "pivot apart, mm", 1e-9, pivot_mm(DOWN)),
    CameraCase("mirror of a rolled camera", HOLD, "pivot apart, mm", 1e-9, pivot_mm(ROLLED)),
    CameraCase("mirror of a level camera", HOLD, "pivot apart, mm", 1e-9, pivot_mm(LEVEL)),
    CameraCase("yaw at exactly -pi and pi", HOLD, "depth apart, mm", 0.01, seam_mm),
    front("d_z from two pixels", 2, 1),
    front("d_z from one pixel", 1, 1),
    unseen("box outside the view", AWAY),
    unseen("box hidden behind a wall", looking([2.0, 0.0, 1.0]), WALL),
    unseen("box wholly behind the table's edge", looking([0.8, 0.0, 0.1])),
    unseen("d_z from no pixel", turned(AWAY, 90.0)),
)
