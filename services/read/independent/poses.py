"""`verso verify --independent N`: labels derived a second time, from the definitions of Staszak and Belter 2024.

`verso verify` derives them by the producer's own functions, which finds damage and never a wrong formula. This package
imports nothing else of the project: rows come as dictionaries, files as bytes. Conventions are those of derive.py.
"""

import math
import urllib.parse
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from services.read.independent import derive
from services.read.independent.cameras import Subject, beside_transform, check_stands, orbits_of
from services.read.independent.derive import (
    FIRST_CLUTTER,
    FIRST_OBJECT,
    ROUNDING,
    TABLE,
    Array,
    Row,
    StoredPair,
    distance,
    matrix,
    name_of,
    of_objects,
    things_of,
    unproject,
)
from services.read.independent.targets import check_targets

FIT, FIT_SLACK, MIRROR_FIT = 0.06, 1.05, 1.5
"""What `fit` stands for: the share of the picture that objects cover, at most but for the last step of the search; T_z by d_z."""

BOARD_M = 0.05
"""Largest median height of a captured board's pixels over its plane: depth or a pose in another convention is further off."""


def check_orbit(pair: StoredPair) -> Iterator[str]:
    """The input camera of a scene on its orbit."""
    orbit, T_in = pair.job["cameras"]["orbit"], matrix(pair.views["input"], "T_world_cam")
    axis = T_in[:3, 2]
    (low, high), off = np.sin(orbit["inclination_rad"]), 0.0
    if isinstance(radius := orbit["radius_m"], str):
        share = FIT if radius == "fit" else float(radius.rstrip("% ")) / 100.0
        seen = np.count_nonzero(of_objects(pair.images["input", "region"])) / pair.images["input", "region"].size
        off = 0.0 if seen <= FIT_SLACK * share else math.inf
    else:
        # Distances from which the point looked at lies in the box of `aim_m`, axis by axis: one of them is in the radius's range.
        # The table's top has some height above the world's origin, a studio's object has its middle there.
        nearest, farthest = np.broadcast_to(radius, 2)
        for at, ahead in list(zip(T_in[:3, 3], axis, strict=True))[: 3 if pair.is_studio else 2]:
            steps = np.array(orbit["aim_m"]) - at
            if abs(ahead) < ROUNDING:
                off = max(off, steps[0], -steps[1])
            else:
                nearest, farthest = max(nearest, min(steps / ahead)), min(farthest, max(steps / ahead))
        off = max(off, nearest - farthest)
    rolled = abs(math.degrees(math.atan2(-T_in[2, 0], -T_in[2, 1])))
    if off > ROUNDING or rolled > max(map(abs, orbit["roll_deg"])) + 1e-9:
        yield "the input camera does not look at the table's centre, or beside it, from cameras.orbit.radius_m, with its roll"
    if not low - ROUNDING <= -axis[2] <= high + ROUNDING:
        yield "the input camera's inclination is outside cameras.orbit.inclination_rad"


def check_given(pair: StoredPair) -> Iterator[str]:
    """Kept objects and the input camera are those of the table of scenes, as far as it is at hand."""
    if pair.given is None:
        return
    view, (objects, cameras), wanted = pair.views["input"], pair.given, list[tuple[str, Array, Array]]()
    if pair.is_studio:  # the world's origin is where the table has the first object
        (name, T), *_ = objects
        if T is None:
            objects, cameras = [(name, T)], []
        else:
            shift = _transform(np.eye(3), (-T[:3, 3]).tolist())
            objects, cameras = [(name, shift @ T)], [shift @ each for each in cameras]
    if KEPT in pair.scene["effects"]:
        if [name or body["instance_id"] for body, (name, _) in zip(pair.bodies, objects, strict=False)] != [
            body["instance_id"] for body in pair.bodies
        ]:
            yield "objects are not those of scenes_from"
        there = [(f"T_world_obj of region {body['region_id']}", matrix(body, "T_world_obj")) for body in pair.bodies]
        wanted = [(*each, T) for each, (_, T) in zip(there, objects, strict=False) if T is not None]
    if pair.has_given_cameras and cameras:
        number = view["parent_id"] // 2 % pair.job["pairs_per_scene"]
        wanted.append(("T_world_cam of the input view", matrix(view, "T_world_cam"), cameras[number]))
    yield from (
        f"{what} is not what scenes_from has" for what, T, other in wanted if not distance(T, other) <= ROUNDING
    )


def check_board(pair: StoredPair) -> Iterator[str]:
    """The board of a capture is the plane z = 0 of its world, in the photograph's depth and in the mirror view's."""
    for role in ("input", "mirror"):
        if (role, "region") not in pair.images:
            continue
        depth, region = pair.images[role, "depth"], pair.images[role, "region"]
        points, _ = unproject(pair.views[role], np.where(region == TABLE, depth, 0))
        height_m = np.abs(matrix(pair.views[role], "T_world_cam")[2] @ points)
        if len(height_m) and (off := float(np.median(height_m))) > BOARD_M:
            yield f"board pixels of {role} lie {off * 1e3:.1f} mm off the board's plane in the median"


def check_poses(pair: StoredPair) -> Iterator[str]:
    """d_z, and from it and the input camera the aligned and the mirror camera, and those that a job fixes to either."""
    cameras, T_in = pair.job["cameras"], matrix(pair.views["input"], "T_world_cam")
    d_z = _derive_d_z(pair)
    for role, view in pair.views.items():
        if not abs(view["d_z_m"] - d_z) <= ROUNDING:
            yield f"d_z_m of {role} is {view['d_z_m']}, the object's input depth gives {d_z}"
    expected = {
        role: T_in @ _transform(np.eye(3), beside["offset_m"]) for role, beside in derive.beside(pair.job).items()
    }
    if "mirror" in pair.views:
        T_z = cameras["mirror"]["T_z_m"]
        if isinstance(T_z, list):  # drawn: what there is, as far as it is in the range
            there = matrix(pair.views["mirror"], "T_world_cam")
            T_z = float(np.clip((T_in[:3, 3] + d_z * T_in[:3, 2] - there[:3, 3]) @ there[:3, 2], *T_z))
        rolls = pair.is_captured or any(cameras["orbit"]["roll_deg"])
        other_side = _derive_rolled_mirror if rolls else _derive_mirror
        expected["mirror"] = expected["projected"] = other_side(T_in, d_z, MIRROR_FIT * d_z if T_z == "fit" else T_z)
    fixed = {f"{name}_000": entry for name, entry in pair.named.items() if entry["beside"]}
    expected |= {key: expected.get(entry["beside"], T_in) @ beside_transform(entry) for key, entry in fixed.items()}
    for role, T in expected.items():
        if role in pair.views and not (off := distance(matrix(pair.views[role], "T_world_cam"), T)) <= ROUNDING:
            yield f"T_world_cam of {role} is off by {off:.3g} from its definition"


def check_named(pair: StoredPair) -> Iterator[str]:
    """The cameras that a job names: how many a scene's first pair has, and where they stand; of a table where it is at hand."""
    is_first = pair.views["input"]["pose_id"] == 2 * pair.job["pairs_per_scene"] * pair.scene["scene_id"]
    subject = None
    for name, entry in pair.named.items():
        views = sorted((view for view in pair.views.values() if view["role"] == name), key=lambda view: view["number"])
        standing = is_first and not entry["beside"]
        count = sum(orbit["count"] for orbit in orbits_of(entry)) if standing else int(bool(entry["beside"]))
        if standing and entry["poses"]:
            count = len(pair.stands.get(name, views))
        if [view["number"] for view in views] != list(range(count)) or bool(views) != (standing or count == 1):
            yield f"has {len(views)} views of camera {name}, and must have {count}, numbered from 0"
        elif standing and entry["poses"]:
            T_world_obj = matrix(pair.bodies[0], "T_world_obj")
            for view, stand in zip(views, pair.stands.get(name, ()), strict=False):
                T = T_world_obj @ stand.T if stand.of_object else stand.T
                if not (off := distance(matrix(view, "T_world_cam"), T)) <= ROUNDING:
                    yield f"T_world_cam of {name_of(view)} is off by {off:.3g} from its row in {entry['poses']}"
        elif standing:
            try:
                subject = subject or _subject(pair)
            except FileNotFoundError as error:
                pair.absent.append(error.filename or str(error))
                return
            T = np.array([matrix(view, "T_world_cam") for view in views])
            T_first = matrix(pair.views["input"], "T_world_cam")
            yield from (f"camera {name} {fault}" for fault in check_stands(entry, T, subject, views[0], T_first))


def _subject(pair: StoredPair) -> Subject:
    """What named cameras are placed about. Raises FileNotFoundError without a shape's file."""
    world = {region: (shape.points.reshape(-1, 3), T) for region, shape, T in things_of(pair)}
    at = {region: points @ T[:3, :3].T + T[:3, 3] for region, (points, T) in world.items()}
    objects = [region for region in world if FIRST_OBJECT <= region < FIRST_CLUTTER]
    top_m = float(at[TABLE][:, 2].max()) if TABLE in at else 0.0
    nearest_m = pair.job["images"]["depth_range_m"][0]
    return Subject(np.concatenate([at[region] for region in objects]), top_m, nearest_m)


def _derive_d_z(pair: StoredPair) -> float:
    """Metres: a percentile (interpolated linearly) of the object's stored input depth."""
    mirror, depth = pair.job["cameras"]["mirror"], pair.images["input", "depth"]
    z = np.sort(depth[of_objects(pair.images["input", "region"]) & (depth > 0)])
    if not len(z):
        return math.nan
    units = np.interp(mirror["percentile"] / 100.0 * (len(z) - 1), np.arange(len(z)), z)
    return float(units / pair.job["images"]["depth_units_per_m"])


def _derive_mirror(T_in: Array, d_z: float, T_z: float) -> Array:
    """T_in Trans_z(d_z) Rot_x(phi) Rot_y(pi) Rot_x(-phi) Trans_z(-T_z), phi the angle of the axis below the horizontal."""
    phi = math.atan2(-T_in[2, 2], math.hypot(T_in[0, 2], T_in[1, 2]))
    c, s = math.cos(phi), math.sin(phi)
    rotation_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    turn = rotation_x @ np.diag([-1.0, 1.0, -1.0]) @ rotation_x.T
    return T_in @ _transform(turn, (0.0, 0.0, d_z)) @ _transform(np.eye(3), (0.0, 0.0, -T_z))


def _derive_rolled_mirror(T_in: Array, d_z: float, T_z: float) -> Array:
    """T_in Trans_z(d_z) (2 n n' - I) Trans_z(-T_z), n the up direction in the camera's frame: at any roll, unlike above."""
    n = T_in[2, :3]
    turn = 2.0 * np.outer(n, n) - np.eye(3)
    return T_in @ _transform(turn, (0.0, 0.0, d_z)) @ _transform(np.eye(3), (0.0, 0.0, -T_z))


def _transform(R: Array, t: Sequence[float]) -> Array:
    return np.vstack([np.column_stack([R, t]), [0.0, 0.0, 0.0, 1.0]])


_ELEMENTS = [f"T{i}{j}" for i in range(4) for j in range(4)]
_CAMERA_COLUMNS = (
    *("pose_id", "parent_id", "role", "width", "height", "fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv"),
    "depth_units_per_m",
)


def list_underived(job: Mapping[str, Any], at_hand: Collection[str]) -> list[str]:
    """Stored values that have no second derivation for this job, a sentence each; at_hand: cameras whose tables are."""
    lines = ["visible_fraction, mirror_agreement and projected_hidden_share are not derived"]
    sensor, projection = job["sensor"], job["images"]["projection"]
    if job.get("captures") is not None:
        lines.append(
            "poses of input cameras, and depth and colour of mirror views, follow from photographs: not derived"
        )
    if projection["enabled"] and not _has_plain_points(job):
        lines.append("projected images are not derived: images.projection.splat or hidden_point_removal is on")
    elif projection["enabled"] and sensor["distortion"]:
        lines.append("colours of projected images are not derived: sensor.distortion is on")
    lines += [
        f"poses of {entry['name']} are not derived: {entry['poses']} is not here, or not what it was when the job was run"
        for entry in job["cameras"]["more"]
        if entry["poses"] and entry["name"] not in at_hand
    ]
    if sensor["depth_noise"]:
        lines.append("depth is not compared with the floor's plane: sensor.depth_noise is on")
    look = job.get("look", {})
    if look.get("room"):
        lines.append("walls are compared with the size of their room alone: their shape is in no file")
    if views := job.get("targets", {}).get("views"):
        lines += ["albedo of the floor is not derived: its look is in no file"] if "albedo" in views else []
        lines += (
            ["albedo of tables is not derived: look.table covers them"]
            if "albedo" in views and look.get("table")
            else []
        )
        lines += ["covisible is derived at some of its pixels: 2,000 of a view at most"] if "covisible" in views else []
    return lines


def _has_plain_points(job: Mapping[str, Any]) -> bool:
    """Whether every projected point fills one pixel and none is removed."""
    projection = job["images"]["projection"]
    return projection["splat"] == 1 and not projection["hidden_point_removal"]


def check_pair(pair: StoredPair) -> list[str]:
    """Stored values of one pair that differ from their definitions, a sentence each."""
    cameras, projection = pair.job["cameras"], pair.job["images"]["projection"]
    switches = {**derive.beside(pair.job), "mirror": cameras["mirror"], "projected": projection}
    expected = {"input", *(role for role, branch in switches.items() if branch["enabled"])}
    if (there := {name for name, view in pair.views.items() if view["role"] not in pair.named}) != expected:
        return [f"scene {pair.scene['scene_id']}: has views {sorted(there)}, and must have {sorted(expected)}"]
    faults = [fault for view in pair.views.values() for fault in derive.check_images(pair, view)]
    if faults:
        return faults
    for role, view in pair.views.items():
        own = [*derive.check_camera(pair, view), *derive.check_patches(pair, view)]
        if role != "projected":
            own += [*derive.check_depth(pair, view), *derive.check_labels(pair, view)]
            own += check_targets(pair, view)
        elif _has_plain_points(pair.job):
            own += derive.check_projection(pair)
        faults += [f"pose {view['pose_id']} ({role}): {fault}" for fault in own]
    own = [*check_poses(pair), *check_given(pair), *check_named(pair)]
    if not pair.has_given_cameras:
        own += (check_board if pair.is_captured else check_orbit)(pair)
    return faults + [f"pair {pair.views['input']['pose_id']}: {fault}" for fault in own]


def check_merged(read: Callable[[str], bytes], views: Sequence[Row], objects: Sequence[Row]) -> Iterator[str]:
    """camPoses.csv and objects.dat (input and mirror cameras) and cameras.csv, line by line against rows of the tables."""
    poses, seen = ([row for row in rows if row["role"] in ("input", "mirror")] for rows in (views, objects))
    views = [{**row, "role": name_of(row)} for row in views]
    labels = ("pose_id", "category", "instance_id", "region_id", "u", "v")
    for path, header, columns, key, rows in (
        ("camPoses.csv", ["id", "parent_id", *_ELEMENTS], ("pose_id", "parent_id"), ("pose_id",), poses),
        ("cameras.csv", [*_CAMERA_COLUMNS, *_ELEMENTS], _CAMERA_COLUMNS, ("pose_id", "role"), views),
        ("objects.dat", None, labels, ("pose_id", "region_id"), seen),
    ):
        try:
            lines = [line.split(",") if header else line.split(" ") for line in read(path).decode().splitlines()]
            if header and (first := lines.pop(0)) != header:
                yield f"{path}: the header is {','.join(first)}"
            yield from (f"{path}: {fault}" for fault in _check_lines(lines, columns, key, rows))
        except (FileNotFoundError, ValueError, KeyError, IndexError) as error:
            yield f"{path}: cannot be read: {error}"


def _rank(name: str) -> tuple[int, str, int]:
    """Where lines of views of this name come among those of one pose: cameras that the article does not have come last."""
    order = ("input", "aligned", "mirror", "projected")
    role, _, number = name.partition("_")
    return (order.index(name), "", 0) if name in order else (len(order), role, int(number))


def _check_lines(
    lines: Sequence[Sequence[str]], columns: Sequence[str], key: Sequence[str], rows: Sequence[Row]
) -> Iterator[str]:
    """Lines in the order of their keys, each with the values of its row and its matrix; names are written as in a URL."""
    table = {}
    for line in lines:
        named = dict(zip([*columns, *_ELEMENTS], map(urllib.parse.unquote, line), strict=True))
        table[tuple(_rank(named[name]) if name == "role" else int(named[name]) for name in key)] = named
    if len(table) != len(lines) or list(table) != sorted(table):
        yield f"lines are not sorted by {' and '.join(key)}, or a key stands twice"
    for row in rows:
        values = [*(row[name] for name in columns), *row["T_cam_obj" if "T_cam_obj" in row else "T_world_cam"]]
        named = table.get(tuple(_rank(row[name]) if name == "role" else row[name] for name in key), {})
        pairs = zip([*columns, *_ELEMENTS], values, strict=True)
        if wrong := [name for name, value in pairs if name not in named or type(value)(named[name]) != value]:
            at = ", ".join(f"{name} {row[name]}" for name in key)
            yield f"{', '.join(wrong)} in the line of {at} are not what the tables say"


KEPT = "kept_poses"
"""The effect of scenes that need not rest."""

GRAVITY_M_S2 = 9.81

FRICTION, MOST_FRICTION = 0.7, 10.0
"""Of what a map of coefficients does not name; and that of a contact at most."""

SHARE = 0.01
"""Of a weight, or of a weight at the lever of the farthest contact: what may be without balance."""


def check_forces(job: Mapping[str, Any], scene: Row, fallen: Collection[int] = ()) -> Iterator[str]:
    """What the forces of contacts do not explain, a sentence each. fallen: the regions that fell where others are kept."""
    bodies, falls = scene["bodies"], job.get("captures") is None and job.get("scene") != "studio"
    if not bodies or not falls or not job["physics"]["exact_rest"]:
        return
    kept = KEPT in scene.get("effects", ())
    where, frictions = f"scene {scene['scene_id']}", {TABLE: _friction_of(job, "table")}
    for body in (scene.get("surroundings") or {}).get("clutter") or ():
        frictions[body["region_id"]] = _friction_of(job, body["category"])
    for body in bodies:
        expected, stored = _friction_of(job, body["category"]), body.get("friction")
        frictions[body["region_id"]] = expected if stored is None else stored
        if stored != (expected if isinstance(job["physics"]["friction"], dict) else None):
            yield f"{where}, region {body['region_id']}: its friction is {stored}, and physics.friction gives {expected:g}"
    for body in (body for body in bodies if not kept or body["region_id"] in fallen):
        others = np.array([frictions.get(contact["with_region"], math.inf) for contact in body["contacts"]])
        friction = np.minimum(frictions[body["region_id"]] * others, MOST_FRICTION)
        yield from (f"{where}, region {body['region_id']}: {fault}" for fault in _check_body(body, friction))
    yield from (f"{where}: {fault}" for fault in _check_reactions(bodies))


def _friction_of(job: Mapping[str, Any], category: str) -> float:
    """The coefficient of a body of this category, or of the table."""
    given = job["physics"]["friction"]
    return float(given.get(category, FRICTION) if isinstance(given, dict) else given)


def _check_body(body: Row, friction: Array) -> Iterator[str]:
    contacts = body["contacts"]
    if not contacts:
        yield "nothing holds it"
        return
    force, normal, point = (np.array([contact[name] for contact in contacts]) for name in ("force", "normal", "point"))
    weight, lever = body["mass_kg"] * GRAVITY_M_S2, point - np.array(body["com"])
    left = np.linalg.norm(force.sum(axis=0) - [0.0, 0.0, weight]) / weight
    turning = np.linalg.norm(np.cross(lever, force).sum(axis=0)) / (weight * np.linalg.norm(lever, axis=1).max())
    if not left <= SHARE:
        yield f"its contact forces leave {left:.1%} of its weight over"
    if not turning <= SHARE:
        yield f"its contact forces turn it, by {turning:.1%} of its weight at the lever of its farthest contact"
    if not np.allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-9):
        yield "a normal of a contact has not the length 1"
    pressed = (force * normal).sum(axis=1)
    slipping = np.linalg.norm(force - pressed[:, None] * normal, axis=1)
    if (pressed < -ROUNDING * weight).any():
        yield "a contact pulls"
    if not (holds := slipping <= friction * pressed + ROUNDING * weight).all():
        yield f"a contact needs more than its friction of {friction[~holds].min():g}"


def _check_reactions(bodies: list[Row]) -> Iterator[str]:
    """Two bodies press one another with one force at one point."""
    forces = dict[tuple[int, int], Array]()
    for body in bodies:
        for contact in body["contacts"]:
            if FIRST_OBJECT <= contact["with_region"] < FIRST_CLUTTER:
                pair = (body["region_id"], contact["with_region"])
                total = forces.setdefault(pair, np.zeros(3))
                total += contact["force"]
    for (one, other), force in forces.items():
        back = forces.get((other, one), np.zeros(3))
        if not np.allclose(force, -back, rtol=1e-9, atol=1e-9):
            yield f"region {one} presses region {other} with another force than that region it"
