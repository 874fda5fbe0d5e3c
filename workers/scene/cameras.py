"""Every camera of a scene: the orbit of the input cameras, those beside and opposite, and those that a job names.

How the further cameras of `cameras.more` stand follows from its entry and a stream of random numbers by its name.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from zlib import crc32

import numpy as np

from schemas.base import Array, Pose, Range, frozen_array
from schemas.dataset.layout import is_stored
from schemas.errors import ViewError
from schemas.job.cameras import SPHERE_SHARE, VIEW_PRESETS, Cameras, Mirror, More, Ring, Sphere, share_of
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, Placed, ScenePlan
from schemas.scene.shape import REGION_FLOOR, REGION_TABLE
from schemas.scene.view import VIEW_ROLES, Camera, Intrinsics, NamedCamera, Role
from workers.assets.poses import PoseFile, poses_of
from workers.assets.winding import winding_numbers
from workers.geometry.camera import NEAR_M, is_cut, look_at, orbit_pose, project, yaw
from workers.geometry.frames import UP, half_turn, invert, pose, rotation_about, transform, translation
from workers.geometry.zbuffer import count_covered
from workers.scene.chance import SceneChance, Stream


def draw_camera(rng: np.random.Generator, further: np.random.Generator, cameras: Cameras, centre: Array) -> Camera:
    """An input camera on the job's orbit about the centre of the table top; `further` draws what has a range by choice."""
    inclination = rng.uniform(cameras.orbit.inclination_rad.low, cameras.orbit.inclination_rad.high)
    yaw = rng.uniform(cameras.orbit.yaw_rad.low, cameras.orbit.yaw_rad.high)
    orbit, sensor = cameras.orbit, cameras.sensor
    radius_m = _draw_distance(further, orbit.radius_m, 1.0)
    aim = np.array([_draw(further, orbit.aim_m) for _ in range(3)])
    T = orbit_pose(centre + aim, inclination, yaw, radius_m)
    if roll := _draw(further, orbit.roll_deg):
        T = T @ pose(rotation_about(UP, math.radians(roll)), np.zeros(3))
    if sensor.has_ranges:
        sensor = sensor.fixed(tuple(further.random(3).tolist()))
    return Camera(Intrinsics.of(sensor), frozen_array(T))


def place_beside(camera: Camera, job: Job) -> dict[Role, Camera]:
    """The cameras that the job has beside the input camera, of which the article has one, the depth camera.

    T_world_beside = T_world_input Trans(t), t along the input camera's optical axes, same rotation [D].
    """
    offsets = {
        role.name: attrgetter(f"{role.branch}.offset_m")(job)
        for role in VIEW_ROLES.values()
        if role.beside and is_stored(role.name, job)
    }
    return {
        name: Camera(camera.intrinsics, frozen_array(camera.T_world_cam @ translation(*offset_m)))
        for name, offset_m in offsets.items()
    }


def place_mirror_camera(camera: Camera, d_z_m: float, mirror: Mirror, share: float = 0.5) -> Camera:
    """The camera on the other side of the object; of a range of T_z this share of the way."""
    T = mirror_pose(camera.T_world_cam, d_z_m, mirror.distance_m(d_z_m, share))
    return Camera(camera.intrinsics, frozen_array(T))


def draw_mirror_share(chance: SceneChance, mirror: Mirror, pair: int) -> float:
    """Where in its range of T_z the mirror camera of a pair stands."""
    return float(chance.stream(Stream.MIRROR, pair).random()) if isinstance(mirror.T_z_m, tuple) else 0.5


def mirror_pose(T_world_cam: Pose, d_z_m: float, T_z_m: float = 1.3, up: Array = UP) -> Pose:
    """Camera on the other side: half a turn about `up` through the pivot d_z_m ahead, and T_z_m away from it.

    [4, 4] float64, camera to world, optical frame, any roll. The pivot is the point of the optical axis in the plane
    of the object's front surface. Equals the product of transforms of Staszak and Belter 2024 at zero roll.
    """
    pivot = T_world_cam[:3, 3] + d_z_m * T_world_cam[:3, 2]
    R = half_turn(up) @ T_world_cam[:3, :3]
    return pose(R, pivot - T_z_m * R[:, 2])


INSIDE = 0.95
"""Share of the picture's width and height, about its middle, that framed objects lie in, and their least distance times the
least depth that is stored."""

SEARCHED, STEPS = 40, 4
"""Doublings, and then halvings, of a distance; corrections of one by the pixels that objects cover."""


def frame_cameras(job: Job, plan: ScenePlan, poses: Sequence[Pose]) -> ScenePlan:
    """The plan with input cameras that frame its objects, where the orbit says so, in the directions that were drawn.

    poses: `T_world_obj` [4, 4] of each object.
    Raises ViewError `not_framed` where a camera at a given distance stands nearer to an object than the object is large, or where
    the objects do not fit into the picture and the range of depth.
    """
    placed, cameras = list(zip(plan.objects, poses, strict=True)), plan.input_cameras
    if (share := job.cameras.orbit.share) is not None:
        return replace(plan, input_cameras=tuple(_frame(job, plan, camera, placed, share) for camera in cameras))
    for start, T in placed:
        box = start.asset.shape.bounds
        size, middle = float(np.linalg.norm(box[1] - box[0])), transform(T, box.mean(axis=0)[None, :])[0]
        if (near := min(float(np.linalg.norm(camera.position - middle)) for camera in cameras)) < size:
            raise ViewError(
                "not_framed",
                f"{start.asset.instance_id} is {size:.3g} m across, and the input camera stands {near:.3g} m from its middle: "
                "set cameras.orbit.radius_m: fit, or make the object smaller",
            )
    return plan


def _centre_of(plan: ScenePlan) -> Array:
    """The point [3] that orbits are about: the middle of the table's top, or of a studio scene."""
    return np.array([0.0, 0.0, 0.0 if plan.ground is None else plan.table.top.height_m])


def _frame(
    job: Job, plan: ScenePlan, camera: Camera, placed: Sequence[tuple[ObjectStart, Pose]], share: float
) -> Camera:
    """The camera as near to the middle of the objects as `share`, the picture's edges and the range of depth allow."""
    points = points_of(plan, [T for _, T in placed])
    lower, upper = points.min(axis=0), points.max(axis=0)
    middle, size, k = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower)), camera.intrinsics
    if any(job.cameras.orbit.aim_m):  # what was drawn stands one metre from the point that it looks at
        middle = middle + camera.position + camera.T_world_cam[:3, 2] - _centre_of(plan)
    nearest_m, farthest_m = max(NEAR_M, job.images.depth_range_m.low) / INSIDE, job.images.depth_range_m.high
    edges = 0.5 * np.array([k.width, k.height])

    def at(radius_m: float) -> Camera:
        T = camera.T_world_cam.copy()
        T[:3, 3] = middle - radius_m * T[:3, 2]
        return replace(camera, T_world_cam=frozen_array(T))

    def is_inside(radius_m: float) -> bool:
        for view in (at(radius_m), *place_beside(at(radius_m), job).values()):
            seen = transform(invert(view.T_world_cam), points)
            if (
                seen[:, 2].min() <= nearest_m
                or (np.abs(np.stack(project(seen, k), axis=1) - edges) > INSIDE * edges).any()
            ):
                return False
        return True

    least_m = next((size * 2.0**n for n in range(SEARCHED) if is_inside(size * 2.0**n)), math.inf)
    step_m = 0.5 * least_m
    for _ in range(SEARCHED if least_m < math.inf else 0):
        least_m -= step_m if is_inside(least_m - step_m) else 0.0
        step_m *= 0.5
    radius_m = max(least_m, 0.5 * size * math.sqrt(k.fx * k.fy * math.pi / (share * k.width * k.height)))
    for _ in range(STEPS if radius_m < math.inf else 0):
        T_cam_world = invert(at(radius_m).T_world_cam)
        counts = [count_covered(start.asset.shape, T_cam_world @ T, k) for start, T in placed]
        covered = sum(4 * k.width * k.height if count is None else count for count in counts) / (k.width * k.height)
        radius_m = max(least_m, radius_m * math.sqrt(covered / share))
    if not radius_m + 0.5 * size <= farthest_m:
        raise ViewError(
            "not_framed",
            f"the objects are {size:.3g} m across together: the camera that frames them does not see them within "
            f"images.depth_range_m, {nearest_m * INSIDE:g} to {farthest_m:g} m: use smaller ones, or widen that",
        )
    return at(radius_m)


MOST_DRAWS = 1000
"""Of a camera whose height is not in its bounds."""

GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
"""The golden angle, radians: no two of a Fibonacci spiral's points have one direction."""


def place_more(
    job: Job, chance: SceneChance, plan: ScenePlan, poses: Sequence[Pose], tables: Mapping[str, PoseFile]
) -> Iterator[NamedCamera]:
    """The cameras of `cameras.more` that stand by themselves, entry after entry; poses: `T_world_obj` of each object.

    tables: of entries that a file has, by name.

    Raises ViewError where one stands below the floor, or inside of an object or of the table, or as `require_depth`.
    """
    points, things = points_of(plan, poses), things_of(plan, poses)
    for entry in job.cameras.more:
        named: Iterator[NamedCamera] = place_orbits(job, entry, chance, plan, points)
        if entry.poses is not None:
            others = intrinsics_of(entry, Intrinsics.of(job.cameras.sensor))
            of_object, rows = poses_of(tables[entry.name], plan.scene_id)
            T_world = poses[0] if of_object else np.eye(4)
            stands = ((T_world @ T, own or others) for T, own in rows)
            named = (NamedCamera(entry.name, n, Camera(k, frozen_array(T))) for n, (T, k) in enumerate(stands))
        for each in named:
            name = f"{each.name}, number {each.number},"
            require_room(
                name, each.camera, plan, things, IN_TABLE if entry.poses else OF_PRESET if entry.preset else ON_ORBIT
            )
            if entry.poses is None:
                require_depth(job, each, points)
            yield each


def points_of(plan: ScenePlan, poses: Sequence[Pose]) -> Array:
    """[N, 3]: the vertices of the objects' hulls, world."""
    return np.concatenate([transform(T, each.hull.vertices) for each, T in zip(plan.objects, poses, strict=True)])


def place_orbits(job: Job, entry: More, chance: SceneChance, plan: ScenePlan, points: Array) -> Iterator[NamedCamera]:
    """The cameras of an entry's rings and spheres; points: `points_of` the scene."""
    rng = chance.stream(Stream.MORE, crc32(entry.name.encode()))
    k, placed = intrinsics_of(entry, Intrinsics.of(job.cameras.sensor)), _Placed.of(plan, points)
    stands = _stands(entry, rng, placed, k, plan.input_cameras[0], job.images.depth_range_m)
    for number, T in enumerate(stands):
        yield NamedCamera(entry.name, number, Camera(k, frozen_array(T)))


def require_depth(job: Job, named: NamedCamera, points: Array) -> None:
    """Raises ViewError `not_framed` where some of `points` [N, 3], world, are in the picture, and too near or far for depth."""
    local, k = transform(invert(named.camera.T_world_cam), points), named.camera.intrinsics
    near_m, far_m = max(NEAR_M, job.images.depth_range_m.low), job.images.depth_range_m.high
    ahead = local[local[:, 2] > 0.0]
    u, v = project(ahead, k)
    depths = ahead[(u > 0.0) & (u < k.width) & (v > 0.0) & (v < k.height), 2]
    if len(depths) and not near_m < depths.min() <= depths.max() < far_m:
        remedies = ["widen images.depth_range_m"] if depths.min() > NEAR_M else []
        metric = job.scene == "studio" and job.studio.scale == "metric"
        remedies.append("set studio.scale: unit_sphere" if metric else "let it stand elsewhere")
        raise ViewError(
            "not_framed",
            f"camera {named.name}, number {named.number}, has the objects {depths.min():.3g} to {depths.max():.3g} m before it, "
            f"and has depth from {near_m:g} to {far_m:g} m: {', or '.join(remedies)}",
        )


def place_fixed(job: Job, seen_from: Mapping[Role, Camera]) -> Iterator[NamedCamera]:
    """The cameras of `cameras.more` that are fixed to those of a pair, by the roles of these: T_world_beside = T_world_cam T."""
    for entry in job.cameras.more:
        if entry.beside is not None:
            turn = np.eye(3)
            for axis, angle_deg in zip(np.eye(3), entry.rotation_deg, strict=True):
                turn = rotation_about(axis, math.radians(angle_deg)) @ turn
            first = seen_from[entry.beside]
            T = first.T_world_cam @ pose(turn, np.array(entry.offset_m))
            yield NamedCamera(entry.name, 0, Camera(intrinsics_of(entry, first.intrinsics), frozen_array(T)))


def intrinsics_of(entry: More, others: Intrinsics) -> Intrinsics:
    """The pinhole camera of an entry, which has that of others unless it says otherwise."""
    k = others if entry.sensor is None else Intrinsics.of(entry.sensor)
    if (fov_deg := entry.pinhole_fov_deg) is None:
        return k
    focal = 0.5 * k.width / math.tan(math.radians(0.5 * fov_deg))
    return k.model_copy(update={"fx": focal, "fy": focal})


@dataclass(frozen=True)
class _Placed:
    """What further cameras are placed about: the middle, bounding sphere and longest side of the objects at rest; the table."""

    middle: Array
    radius_m: float
    side_m: float
    top: Array

    @classmethod
    def of(cls, plan: ScenePlan, points: Array) -> "_Placed":
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius_m = float(np.linalg.norm(points - middle, axis=1).max())
        side_m = float(np.ptp(points, axis=0).max())  # as it lies: published methods measure it after they placed it
        return cls(middle, radius_m, side_m, _centre_of(plan))

    def point(self, about: str | tuple[float, float, float]) -> Array:
        """The point that cameras look at, world."""
        if not isinstance(about, str):
            return np.array(about)
        return {"object": self.middle, "table": self.top, "world": np.zeros(3)}[about]

    def fit_m(self, share: float, k: Intrinsics, depth_range_m: Range) -> float:
        """Distance from which the bounding sphere covers this share of the picture, or so much farther as edges and depth ask.

        A sphere of radius R at distance d is drawn about the principal point as an ellipse of the half axes fx t and fy t,
        with t = R / sqrt(d^2 - R^2). Raises ViewError `not_framed` where there is no such distance.
        """
        edge = min(min(k.cx, k.width - k.cx) / k.fx, min(k.cy, k.height - k.cy) / k.fy)
        if edge <= 0.0:
            raise ViewError(
                "not_framed",
                f"the principal point ({k.cx:g}, {k.cy:g}) is not within the {k.width} x {k.height} pixels, so that radius_m fit "
                "frames nothing: give radius_m in metres, or set cx and cy",
            )
        half = min(math.sqrt(share * k.width * k.height / (math.pi * k.fx * k.fy)), INSIDE * edge)
        nearest_m = self.radius_m + max(NEAR_M, depth_range_m.low) / INSIDE
        fit_m = max(self.radius_m * math.hypot(1.0, 1.0 / half), nearest_m)
        if fit_m + self.radius_m > depth_range_m.high:
            raise ViewError(
                "not_framed",
                f"the objects are {2.0 * self.radius_m:.3g} m across together: a camera that frames them does not see them "
                f"within images.depth_range_m, up to {depth_range_m.high:g} m: use smaller ones, or widen that",
            )
        return fit_m


def _stands(
    entry: More, rng: np.random.Generator, placed: _Placed, k: Intrinsics, first: Camera, depth_range_m: Range
) -> Iterator[Pose]:
    """`T_world_cam` of each camera of an entry's rings and spheres; `first`: the scene's first input camera."""
    centre, unit_m = placed.point(entry.about), 1.0
    if entry.preset is not None:
        preset = VIEW_PRESETS[entry.preset]
        unit_m = (placed.side_m if preset.of == "side" else placed.radius_m) / preset.unit_m
    for orbit in entry.orbits:
        fit = share_of(orbit.radius_m, SPHERE_SHARE)
        fit_m = 1.0 if fit is None else placed.fit_m(fit, k, depth_range_m)
        directions = _ring(orbit, rng, first) if isinstance(orbit, Ring) else _sphere(orbit, rng)
        for draw in directions:
            for _ in range(MOST_DRAWS):
                towards, radius_m = draw(), _draw_distance(rng, orbit.radius_m, fit_m)
                heights = None if isinstance(orbit, Ring) else orbit.height_m
                if heights is None or heights.low <= radius_m * towards[2] <= heights.high:
                    break
            else:
                raise ViewError("no_height", f"camera {entry.name}: none of {MOST_DRAWS} drawn lies within height_m")
            T = look_at(centre + unit_m * radius_m * towards, centre)
            roll = _draw(rng, entry.roll_deg)
            yield T @ pose(rotation_about(UP, math.radians(roll)), np.zeros(3)) if roll else T


def _draw(rng: np.random.Generator, ends: Range) -> float:
    """A number between two ends; nothing is drawn where they are one."""
    return ends.low if ends.low == ends.high else float(rng.uniform(ends.low, ends.high))


def _draw_distance(rng: np.random.Generator, radius_m: float | tuple[float, float] | str, fit_m: float) -> float:
    """A distance, drawn where it is a range; `fit_m` where it is to fit."""
    if isinstance(radius_m, str):
        return fit_m
    return _draw(rng, Range(*radius_m)) if isinstance(radius_m, tuple) else radius_m


Draw = Callable[[], Array]
"""Draws the direction [3], unit, from the point that is looked at to a camera."""


def _ring(ring: Ring, rng: np.random.Generator, first: Camera) -> Iterator[Draw]:
    start = _draw(rng, ring.start_rad) + (yaw(first.T_world_cam) if ring.start == "input" else 0.0)
    for number in range(ring.count):
        around = start + 2.0 * math.pi * number / ring.count
        yield lambda around=around: _towards(around, math.sin(_draw(rng, ring.inclination_rad)))  # type: ignore[misc]


def _sphere(sphere: Sphere, rng: np.random.Generator) -> Iterator[Draw]:
    low, high = (math.sin(end) for end in sphere.inclination_rad)
    if sphere.pattern in ("uniform", "cube"):
        yield from [partial(_at_random, rng, low, high, sphere.pattern == "cube")] * sphere.count
        return
    shift, turn = rng.random(2)
    for number in range(sphere.count):
        share = (number + (0.5 if sphere.pattern == "fibonacci" else shift)) / sphere.count
        if sphere.pattern == "trellis":
            share = 2.0 * share if share < 0.25 else 2.0 * share / 3.0 + 1.0 / 3.0
        around = number * GOLDEN if sphere.pattern == "fibonacci" else 2.0 * math.pi * _radical_inverse(number)
        z = low + share * (high - low)
        yield partial(_towards, around + 2.0 * math.pi * turn, z)


def _at_random(rng: np.random.Generator, low: float, high: float, cube: bool) -> Array:
    """A direction whose height lies between two: uniform on the sphere, or of a uniform point of a cube."""
    for _ in range(MOST_DRAWS):
        if not cube:
            return _towards(rng.uniform(-math.pi, math.pi), rng.uniform(low, high))
        point = rng.uniform(-1.0, 1.0, size=3)
        towards = point / max(float(np.linalg.norm(point)), 1e-9)
        if low <= towards[2] <= high:
            return towards
    return _towards(rng.uniform(-math.pi, math.pi), rng.uniform(low, high))


def _towards(around: float, z: float) -> Array:
    """The unit direction [3] of this height at an angle from the x axis."""
    z = max(-1.0, min(1.0, z))
    level = math.sqrt(1.0 - z * z)
    return np.array([level * math.cos(around), level * math.sin(around), z])


def _radical_inverse(number: int) -> float:
    """The binary digits of a number behind the point, in reverse order (van der Corput)."""
    share, step = 0.0, 0.5
    while number:
        share += step * (number & 1)
        number, step = number >> 1, 0.5 * step
    return share


Moves = tuple[str, str]
"""What moves a camera up, and away from what it is in."""

ON_ORBIT: Moves = ("raise its inclination, or its about", "take a larger radius_m, or fit")
OF_PRESET: Moves = (
    "set scene: studio, where there is no table and no floor",
    "set scene: studio, and studio.scale: unit_sphere",
)
INPUT: Moves = ("raise cameras.orbit.inclination_rad", "take a larger cameras.orbit.radius_m, or fit")
IN_TABLE: Moves = ("move it in its table",) * 2
BESIDE: Moves = ("change its offset_m",) * 2
OPPOSITE: Moves = ("raise the input camera", "take a larger cameras.mirror.T_z_m, or fit")


def things_of(plan: ScenePlan, poses: Sequence[Pose]) -> tuple[Placed, ...]:
    """The table and the objects of a plan; poses: `T_world_obj` of each object."""
    table = () if plan.ground is None else (Placed(REGION_TABLE, plan.table.asset.shape, plan.table.T_world_table),)
    placed = zip(plan.objects, poses, strict=True)
    return (*table, *(Placed(each.region_id, each.asset.shape, T) for each, T in placed))


def require_inputs(plan: ScenePlan, poses: Sequence[Pose]) -> None:
    """Raises ViewError where there is no room for an input camera, as `require_room`; poses: `T_world_obj` of each object."""
    things, moves = things_of(plan, poses), IN_TABLE if plan.aimed else INPUT
    for number, camera in enumerate(plan.input_cameras):
        require_room(f"input, number {number},", camera, plan, things, moves)


def require_room(name: str, camera: Camera, plan: ScenePlan, things: Sequence[Placed], moves: Moves) -> None:
    """Raises ViewError where a camera stands below the floor, in a thing, or so near before one that the near plane cuts it."""
    where = f"camera {name} at ({', '.join(f'{x:.3f}' for x in camera.position)}) m"
    if plan.ground is not None and camera.position[2] <= 0.0:
        raise ViewError("camera_in_scene", f"{where} is below the floor: {moves[0]}")
    names = {each.region_id: each.asset.instance_id for each in plan.objects} | {REGION_TABLE: "the table"}
    for thing in things:
        if thing.region_id == REGION_FLOOR:
            continue
        T, (low, high) = invert(camera.T_world_cam) @ thing.T_world_shape, thing.shape.bounds
        nearest_m = T[2, 3] + np.minimum(T[2, :3] * low, T[2, :3] * high).sum()
        if nearest_m > NEAR_M:  # its whole box is beyond the near plane
            continue
        what, point = names[thing.region_id], transform(invert(T), np.zeros((1, 3)))
        if ((point > low) & (point < high)).all() and abs(winding_numbers(point, thing.shape.mesh)[0]) > 0.5:
            raise ViewError("camera_in_scene", f"{where} is inside of {what}: {moves[1]}")
        if is_cut(transform(T, thing.shape.vertices)[thing.shape.faces], camera.intrinsics):
            raise ViewError(
                "camera_in_scene",
                f"{where} has {what} nearer than {NEAR_M} m before it, where nothing is seen: {moves[1]}",
            )
