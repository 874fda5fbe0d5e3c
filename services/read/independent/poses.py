"""Where the cameras of one stored pair stand, by the definitions of Staszak and Belter 2024.

Matrices and conventions are those of derive.py.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from services.read.independent.derive import (
    FIRST_OBJECT,
    ROUNDING,
    TABLE,
    Array,
    StoredPair,
    distance,
    matrix,
    unproject,
)

BOARD_M = 0.05
"""Largest median height of a captured board's pixels over its plane: depth or a pose in another convention is further off."""


def check_orbit(pair: StoredPair) -> Iterator[str]:
    """The input camera of a scene on its orbit."""
    orbit, T_in = pair.job["cameras"]["orbit"], matrix(pair.views["input"], "T_world_cam")
    axis = T_in[:3, 2]
    target = T_in[:3, 3] + orbit["radius_m"] * axis
    low, high = np.sin(orbit["inclination_rad"])
    if distance(target[:2], np.zeros(2)) > ROUNDING or abs(T_in[2, 0]) > ROUNDING:
        yield "the input camera does not look at the table's centre from cameras.orbit.radius_m without roll"
    if not low - ROUNDING <= -axis[2] <= high + ROUNDING:
        yield "the input camera's inclination is outside cameras.orbit.inclination_rad"


def check_board(pair: StoredPair) -> Iterator[str]:
    """The board of a capture is the plane z = 0 of its world, in the photograph's depth and in the mirror view's."""
    for role in ("input", "mirror"):
        if (role, "region") not in pair.images:
            continue
        depth, region = pair.images[role, "depth"], pair.images[role, "region"]
        points, _ = unproject(pair.views[role], np.where(region == TABLE, depth, 0))
        if (
            points.shape[1]
            and (off := float(np.median(np.abs(matrix(pair.views[role], "T_world_cam")[2] @ points)))) > BOARD_M
        ):
            yield f"board pixels of {role} lie {off * 1e3:.1f} mm off the board's plane in the median"


def check_poses(pair: StoredPair) -> Iterator[str]:
    """d_z, and from it and the input camera the aligned and the mirror camera."""
    cameras, T_in = pair.job["cameras"], matrix(pair.views["input"], "T_world_cam")
    d_z = _derive_d_z(pair)
    for role, view in pair.views.items():
        if not abs(view["d_z_m"] - d_z) <= ROUNDING:
            yield f"d_z_m of {role} is {view['d_z_m']}, the object's input depth gives {d_z}"
    expected = {"aligned": T_in @ _transform(np.eye(3), cameras["depth"]["offset_m"])}
    derive = _derive_rolled_mirror if pair.is_captured else _derive_mirror
    expected["mirror"] = expected["projected"] = derive(T_in, d_z, cameras["mirror"]["T_z_m"])
    for role, T in expected.items():
        if role in pair.views and not (off := distance(matrix(pair.views[role], "T_world_cam"), T)) <= ROUNDING:
            yield f"T_world_cam of {role} is off by {off:.3g} from its definition"


def _derive_d_z(pair: StoredPair) -> float:
    """Metres: a percentile (interpolated linearly), the median or the least of the object's stored input depth."""
    mirror, depth = pair.job["cameras"]["mirror"], pair.images["input", "depth"]
    z = np.sort(depth[(pair.images["input", "region"] >= FIRST_OBJECT) & (depth > 0)])
    if not len(z):
        return math.nan
    percentile = {"nearest": 0.0, "median": 50.0, "percentile": mirror["percentile"]}[mirror["pivot_depth"]]
    units = np.interp(percentile / 100.0 * (len(z) - 1), np.arange(len(z)), z)
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
