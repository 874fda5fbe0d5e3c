"""Cameras by the article's definitions: intrinsics, orbit, d_z, the depth camera, and the mirror pose as a product of five."""

import math
from collections.abc import Iterator

import numpy as np

from services.read.independent.pair import FIRST_OBJECT, ROUNDING, Array, Row, StoredPair, distance, matrix


def check_camera(pair: StoredPair, view: Row) -> Iterator[str]:
    """Ids, intrinsics in both conventions, a rigid pose, and its angles."""
    pairs, sensor = pair.job["pairs_per_scene"], pair.job["cameras"]["sensor"]
    first = 2 * pairs * pair.scene["scene_id"]
    expected_id = view["parent_id"] + (view["role"] == "mirror")
    if view["parent_id"] not in range(first, first + 2 * pairs, 2) or view["pose_id"] != expected_id:
        yield f"ids {view['pose_id']} and {view['parent_id']} do not follow from scene {pair.scene['scene_id']}"
    expected = {**sensor, "cx_opencv": sensor["cx"] - 0.5, "cy_opencv": sensor["cy"] - 0.5}
    expected["depth_units_per_m"] = pair.job["images"]["depth_units_per_m"]
    for name, value in expected.items():
        if view[name] != value:
            yield f"{name} is {view[name]}, the job gives {value}"
    T = matrix(view, "T_world_cam")
    R, axis = T[:3, :3], T[:3, 2]
    if distance(R.T @ R, np.eye(3)) > ROUNDING or np.linalg.det(R) < 0 or list(T[3]) != [0, 0, 0, 1]:
        yield "T_world_cam is no rigid transform"
    if abs(math.sin(view["inclination_rad"]) + axis[2]) > ROUNDING:
        yield f"inclination_rad {view['inclination_rad']} is not the angle of the optical axis below the horizontal"
    level = math.hypot(axis[0], axis[1])
    direction = level * np.array([math.cos(view["yaw_rad"]), math.sin(view["yaw_rad"])])
    if level > ROUNDING and distance(direction, -axis[:2]) > ROUNDING:
        yield f"yaw_rad {view['yaw_rad']} is not the direction from the table to the camera"


def check_poses(pair: StoredPair) -> Iterator[str]:
    """The input camera on its orbit, d_z, and from these the aligned and the mirror camera."""
    cameras, T_in = pair.job["cameras"], matrix(pair.views["input"], "T_world_cam")
    orbit, axis = cameras["orbit"], T_in[:3, 2]
    target = T_in[:3, 3] + orbit["radius_m"] * axis
    low, high = np.sin(orbit["inclination_rad"])
    if distance(target[:2], np.zeros(2)) > ROUNDING or abs(T_in[2, 0]) > ROUNDING:
        yield "the input camera does not look at the table's centre from cameras.orbit.radius_m without roll"
    if not low - ROUNDING <= -axis[2] <= high + ROUNDING:
        yield "the input camera's inclination is outside cameras.orbit.inclination_rad"
    d_z = _derive_d_z(pair)
    for role, view in pair.views.items():
        if not abs(view["d_z_m"] - d_z) <= ROUNDING:
            yield f"d_z_m of {role} is {view['d_z_m']}, the object's input depth gives {d_z}"
    expected = {"aligned": T_in @ _translation(*cameras["depth"]["offset_m"])}
    expected["mirror"] = expected["projected"] = _derive_mirror(T_in, d_z, cameras["mirror"]["T_z_m"])
    for role, T in expected.items():
        if role in pair.views and not (off := distance(matrix(pair.views[role], "T_world_cam"), T)) <= ROUNDING:
            yield f"T_world_cam of {role} is off by {off:.3g} from its definition"


def _derive_d_z(pair: StoredPair) -> float:
    """Metres: a percentile (interpolated linearly), the median or the least of the object's stored input depth."""
    mirror, depth = pair.job["cameras"]["mirror"], pair.images["input", "depth"]
    own = depth[(pair.images["input", "region"] >= FIRST_OBJECT) & (depth > 0)]
    z = np.sort(own / pair.job["images"]["depth_units_per_m"])
    if not len(z):
        return math.nan
    percentile = {"nearest": 0.0, "median": 50.0, "percentile": mirror["percentile"]}[mirror["pivot_depth"]]
    place = percentile / 100.0 * (len(z) - 1)
    below, above = z[math.floor(place)], z[math.ceil(place)]
    return float(below + (place - math.floor(place)) * (above - below))


def _derive_mirror(T_in: Array, d_z: float, T_z: float) -> Array:
    """T_in Trans_z(d_z) Rot_x(phi) Rot_y(pi) Rot_x(-phi) Trans_z(-T_z), phi the angle of the axis below the horizontal."""
    phi = math.atan2(-T_in[2, 2], math.hypot(T_in[0, 2], T_in[1, 2]))
    half_turn_y = np.diag([-1.0, 1.0, -1.0, 1.0])
    there, back = _translation(0.0, 0.0, d_z), _translation(0.0, 0.0, -T_z)
    return T_in @ there @ _rotation_x(phi) @ half_turn_y @ _rotation_x(-phi) @ back


def _translation(x: float, y: float, z: float) -> Array:
    return np.array([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def _rotation_x(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0, 0.0], [0.0, c, -s, 0.0], [0.0, s, c, 0.0], [0.0, 0.0, 0.0, 1.0]])
