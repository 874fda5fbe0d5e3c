"""Poses from markers alone, and the verdict on a view's pose: used, flagged or refused, with the number measured.

A pose is changed from the right, in camera axes: T_board_cam <- T_board_cam exp(motion), motion = (metres, radians).
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, DepthCorrection, Detection, ViewEstimate, ViewStatus
from schemas.errors import CaptureError
from schemas.job.captures import Estimation
from workers.capture.poses.observation import (
    Corners,
    Observation,
    Patches,
    Setup,
    board_patches,
    corners_of,
    depth_at,
    no_patches,
    object_patches,
    pixels_of_points,
)
from workers.geometry.frames import angle_between, invert, pose, rotation_about, transform
from workers.geometry.pixels import rays_of_pixels


def exponential(rotation_vector: Array) -> Array:
    """[3, 3] float64: the rotation about a vector [3] by its length in radians."""
    angle = float(np.linalg.norm(rotation_vector))
    if angle < 1e-12:
        return np.eye(3) + cross_matrix(rotation_vector)
    return rotation_about(rotation_vector / angle, angle)


def logarithm(R: Array) -> Array:
    """[3] float64: the rotation vector of a rotation [3, 3] by less than pi."""
    angle = angle_between(np.eye(3), R)
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return 0.5 * axis if angle < 1e-9 else axis * (0.5 * angle / math.sin(angle))


def cross_matrix(vectors: Array) -> Array:
    """[..., 3, 3] float64: the matrices v x of vectors [..., 3]."""
    x, y, z = np.moveaxis(np.asarray(vectors, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2)


def moved(T: Pose, motion: Array) -> Pose:
    """[4, 4] float64: T after a small motion [6] (metres, then radians) in its own axes, kept orthonormal."""
    R = T[:3, :3] @ exponential(motion[3:])
    U, _, V = np.linalg.svd(R)
    return pose(U @ V, T[:3, 3] + T[:3, :3] @ motion[:3])


def motion_between(T: Pose, other: Pose) -> Array:
    """[6]: the small motion (metres, then radians) in the axes of T that takes T to the other."""
    step = invert(T) @ other
    return np.concatenate([step[:3, 3], logarithm(step[:3, :3])])


CAUCHY = 3.0
"""A residual of this many standard deviations has half the weight of a small one."""
MAX_ROUNDS = 30
SETTLED = 1e-8
"""A step of fewer metres and radians ends a fit."""
FAR = 1e6
"""Residual, pixels, of a point behind the camera."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose fitted to corners. residuals [K, 2] pixels, information [6, 6] at unit sigma, cost in squared pixels."""

    T_board_cam: Pose
    residuals: Array
    information: Array
    cost: float


def residuals_of(T_board_cam: Pose, board: Array, rays: Array, focal: Array) -> tuple[Array, Array]:
    """([K, 2] pixels of an ideal pinhole with focal lengths [2], [K, 2, 6] derivatives by a small motion of the camera).

    Corners `board` [K, 3] are seen along `rays` [K, 2]. A point behind the camera has the residual FAR, without derivative.
    """
    p = transform(invert(T_board_cam), board)
    ahead = p[:, 2] > 1e-6
    z = np.where(ahead, p[:, 2], 1.0)
    x, y = p[:, 0] / z, p[:, 1] / z
    residuals = np.where(ahead[:, None], focal * (np.stack([x, y], axis=1) - rays), FAR)
    by_point = derivative_of_projection(x, y, z, focal) * ahead[:, None, None]
    by_motion = np.concatenate([-by_point, by_point @ cross_matrix(p)], axis=2)  # p changes by -dt - dr x p
    return residuals, by_motion


def derivative_of_projection(x: Array, y: Array, z: Array, focal: Array) -> Array:
    """[K, 2, 3]: of pixels by points in camera axes, at the rays (x, y) and depths z."""
    zero = np.zeros_like(x)
    rows = [np.stack([1 / z, zero, -x / z], axis=1), np.stack([zero, 1 / z, -y / z], axis=1)]
    return np.stack(rows, axis=1) * focal[:, None]


def spread(residuals: Array, floor: float) -> float:
    """Standard deviation of one coordinate of residuals [K, 2], by the median of their absolute values; at least `floor`."""
    return max(floor, float(np.median(np.abs(residuals))) * 1.4826) if residuals.size else floor


def fit_pose(start: Pose, board: Array, rays: Array, focal: Array, floor_px: float) -> Fit:
    """The pose nearest to `start` of least robust reprojection error: Levenberg-Marquardt, Cauchy weights.

    The scale of the weights is the residuals' own spread, at least `floor_px`.
    """
    T, damping = start, 1e-6
    residuals, jacobian = residuals_of(T, board, rays, focal)
    scale = CAUCHY * spread(residuals, floor_px)
    cost = _cost(residuals, scale)
    for _ in range(MAX_ROUNDS):
        information, gradient = _normal_equations(residuals, jacobian, scale)
        step = np.asarray(
            np.linalg.solve(information + damping * np.diag(np.diag(information) + 1e-9), -gradient), np.float64
        )
        trial = moved(T, step)
        new_residuals, new_jacobian = residuals_of(trial, board, rays, focal)
        new_cost = _cost(new_residuals, scale)
        if not new_cost < cost:
            damping = max(damping, 1e-6) * 10
            if damping > 1e8 or float(np.abs(step).max()) < SETTLED:
                break
            continue
        settled = float(np.abs(step).max()) < SETTLED
        T, residuals, jacobian, damping = trial, new_residuals, new_jacobian, damping * 0.1
        scale = min(scale, CAUCHY * spread(residuals, floor_px))
        cost = _cost(residuals, scale)
        if settled:
            break
    return Fit(T, residuals, _normal_equations(residuals, jacobian, scale)[0], cost)


def _cost(residuals: Array, scale: float) -> float:
    """Sum of Cauchy's loss over corners, squared pixels."""
    squares = (residuals**2).sum(axis=1)
    return float((scale**2 * np.log1p(squares / scale**2)).sum())


def _normal_equations(residuals: Array, jacobian: Array, scale: float) -> tuple[Array, Array]:
    weights = 1.0 / (1.0 + (residuals**2).sum(axis=1) / scale**2)
    weighted = jacobian * weights[:, None, None]
    return np.einsum("kij,kil->jl", weighted, jacobian), np.einsum("kij,ki->j", weighted, residuals)


FLOOR_PX = 0.02
"""No corner is taken to be better than this."""
AMBIGUOUS = 9.0
"""The two poses of a planar target are told apart by at least this difference of their chi-square: three sigma."""
SAME_RAD = 0.02
MOST_REPROJECTION_PX = 3.0
"""Median reprojection error beyond which a view is flagged: fifteen times that of a detected corner."""
"""Two poses that differ by less than this are one."""
PRIOR_RESIDUALS = 2
"""The expected sigma of a corner counts as much as so many measured residuals."""


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """One view's pose from its markers: the best fit, the rival that a planar target leaves, and what is wrong.

    fit is None where there is no pose, and `reason` then says why. `rival` is the other pose that fits, of another tilt.
    """

    number: int
    fit: Fit | None
    rival: Fit | None = None
    reason: str = ""


def fit_markers(observation: Observation, camera: CaptureCamera) -> MarkerPose:
    """The pose of one view: both solutions of the planar problem (IPPE), each refined with a robust loss, the better first."""
    corners, number = observation.corners, observation.number
    if not observation.markers:
        return MarkerPose(number, None, reason="no markers of the board found")
    focal = focal_lengths(camera)
    fits = [fit_pose(start, corners.board, corners.rays, focal, FLOOR_PX) for start in first_poses(corners)]
    above = [fit for fit in fits if np.isfinite(fit.T_board_cam).all() and fit.T_board_cam[2, 3] > 0]
    fits = sorted(above, key=lambda fit: fit.cost)
    if not fits:
        return MarkerPose(
            number,
            None,
            reason="the markers are seen from below the board: it is mirrored, or not the board of board.json",
        )
    R = fits[0].T_board_cam[:3, :3]
    rival = next((fit for fit in fits[1:] if angle_between(R, fit.T_board_cam[:3, :3]) > SAME_RAD), None)
    return MarkerPose(number, fits[0], rival)


FLAT = 1e-4
"""Points whose thickness is less than this share of their extent are a plane: a board's print is flatter than that."""


def first_poses(corners: Corners) -> list[Pose]:
    """T_board_cam of the one or two poses from which a plane looks alike (Collins and Bartoli 2014).

    Points that lie in no plane have one pose (SQPnP, Terzakis and Lourakis 2020).
    """
    middle = corners.board.mean(axis=0)
    _, extents, axes = np.linalg.svd(corners.board - middle, full_matrices=False)
    flat, T_board_plane = bool(extents[2] <= FLAT * extents[0]), np.eye(4)
    if flat and corners.board[:, 2].any():
        T_board_plane = pose(axes.T * np.linalg.det(axes), middle)
    points = transform(invert(T_board_plane), corners.board)
    found, rotations, translations, _ = cv2.solvePnPGeneric(
        points.reshape(-1, 1, 3),
        corners.rays.reshape(-1, 1, 2),
        np.eye(3),
        None,
        flags=cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP,
    )
    poses = []
    for rotation, position in zip(rotations[:found], translations[:found], strict=True):
        T_cam_plane = pose(cv2.Rodrigues(rotation)[0].astype(np.float64), position.ravel().astype(np.float64))
        if np.isfinite(T_cam_plane).all():
            poses.append(T_board_plane @ invert(T_cam_plane))
    return poses


TURNED = 25.0
"""A turned image is told by so much of chi-square: five sigma."""
WELL_FITTING = 0.5
"""And by at most this share of the misfit being left: a wrong lens fits a little better one way or the other."""
ILL_FITTING = 2.0
"""Only views whose corners fit so many times worse than those of the median view are looked at."""


def refuse_turned(
    observations: Sequence[Observation], found: Sequence[MarkerPose], camera: CaptureCamera, corner_px: float
) -> list[MarkerPose]:
    """The poses, without those of views whose corners fit better where the image is turned by 180 degrees.

    The board looks turned as well, and a pose is found: the principal point and the lens are then those of another place.
    """
    spreads = [np.inf if one.fit is None else spread(one.fit.residuals, FLOOR_PX) for one in found]
    usual = float(np.median([value for value in spreads if np.isfinite(value)] or [np.inf]))
    k, focal, told = camera.intrinsics, focal_lengths(camera), list(found)
    for place, (seen, one, value) in enumerate(zip(observations, found, spreads, strict=True)):
        if one.fit is None or value < ILL_FITTING * usual:
            continue
        corners = seen.corners
        rays = rays_of_pixels(np.array([k.width, k.height]) - corners.pixels, k, camera.lens)
        turned = one.fit.T_board_cam @ pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        if np.isfinite(rays).all():
            cost = fit_pose(turned, corners.board, rays, focal, FLOOR_PX).cost
            if one.fit.cost - cost > TURNED * corner_px**2 and cost < WELL_FITTING * one.fit.cost:
                reason = "its image is turned by 180 degrees against the others': turn rgb_ and depth_ back"
                told[place] = MarkerPose(one.number, None, reason=reason)
    return told


def focal_lengths(camera: CaptureCamera) -> Array:
    """[2] float64, pixels."""
    return np.array([camera.intrinsics.fx, camera.intrinsics.fy])


def measured_corner_px(poses: list[MarkerPose], spec: Estimation) -> float:
    """Standard deviation of a detected corner in this capture, pixels, by the residuals of all views.

    The expected one, `corner_px`, counts as much as PRIOR_RESIDUALS.
    """
    fits = [found.fit for found in poses if found.fit is not None and len(found.fit.residuals) > 3]
    residuals = np.concatenate([fit.residuals.ravel() for fit in fits]) if fits else np.zeros(0)
    free = len(residuals) - 6 * len(fits)
    if free <= 0:
        return spec.corner_px
    return corner_sigma((1.4826 * float(np.median(np.abs(residuals)))) ** 2 * len(residuals) / free, free, spec)


def corner_sigma(variance: float, free: float, spec: Estimation) -> float:
    """Standard deviation, pixels, by the variance of residuals, `free` of them left by what was fitted, and by the expected."""
    mixed = (free * variance + PRIOR_RESIDUALS * spec.corner_px**2) / (free + PRIOR_RESIDUALS)
    return max(FLOOR_PX, float(np.sqrt(mixed)))


def is_ambiguous(found: MarkerPose, corner_px: float) -> bool:
    """Whether the corners do not tell the pose from its rival."""
    if found.fit is None or found.rival is None:
        return False
    return found.rival.cost - found.fit.cost < AMBIGUOUS * corner_px**2


MANY = 40
"""So many corners with depth, in views with a pose from markers, tell what depth measures."""
NO_PRINT = 1.25
"""Depth of a scale beyond this is in other units: no print is wrong by as much."""
NO_SENSOR_M = 0.05
"""Nor has a sensor such an offset: specifications are near 0.01."""
CLEARLY = 0.5
"""Depth along the ray leaves at most this share of the spread that depth along the axis leaves."""
UNITS = (1.0, 100.0, 256.0, 1000.0, 4000.0, 5000.0, 8000.0, 10_000.0, 65_535.0)
"""Of depth images that are in use, a metre; one of them is named where it fits to a tenth."""


def check_depth(evidence: "Evidence") -> None:
    """Raises CaptureError where depth at the markers is what no sensor measures, with the key of camera.json to change.

    Units, an offset, and distances along the ray in place of z: these grow with the angle to the axis as sqrt(1 + x^2 + y^2).
    """
    parts = [
        _depth_of(o, f.fit.T_board_cam)
        for o, f in zip(evidence.observations, evidence.markers, strict=True)
        if f.fit
        and _fits(o, f.fit.T_board_cam, evidence)  # else the markers tell no distance, as those of another board
    ]
    z, true_z, length = np.concatenate(parts or [np.zeros((0, 3))]).T
    if len(z) < MANY:
        return
    camera, scale = evidence.camera, float(np.median(z / true_z))
    if not 1 / NO_PRINT < scale < NO_PRINT:
        fits = camera.depth_units_per_m * scale
        fits = next((known for known in UNITS if abs(known / fits - 1) < 0.1), float(f"{fits:.3g}"))
        given = f"depth_units_per_m in camera.json is {camera.depth_units_per_m:g}"
        raise CaptureError(
            "depth", f"depth is {float(f'{scale:.3g}'):g} times what the markers say: {given}, and {fits:g} would fit"
        )
    # Scale and offset are left open: a print of another size and a sensor's own error are no matter of the ray.
    by_kind = {power: _affine(true_z * length**power, z) for power in (-1, 0, 1)}
    best = min(by_kind, key=lambda power: by_kind[power][1])
    if best and by_kind[best][1] < CLEARLY * by_kind[0][1]:
        seen, word = ("the distance along the ray", "ray") if best > 0 else ("z along the optical axis", "z")
        grows = f'its error grows with the angle to the optical axis; write "depth": "{word}" into camera.json'
        raise CaptureError("depth", f"depth is {seen}, and camera.json says {camera.depth}: {grows}")
    offset_m = by_kind[0][0]
    if abs(offset_m) > NO_SENSOR_M:
        words = f"depth is off by {1000 * offset_m:+.0f} mm at every distance, which no sensor is"
        raise CaptureError("depth", f"{words}: export it again without an offset (0 is no depth)")


def _fits(seen: Observation, T: Pose, evidence: "Evidence") -> bool:
    off_px = median_reprojection(seen, T, evidence.camera, 1.0)
    return off_px is not None and off_px <= MOST_REPROJECTION_PX


def _depth_of(seen: Observation, T: Pose) -> Array:
    """[N, 3]: measured z of corners, z of their places on the board, and the lengths at z = 1 of their rays."""
    corners = seen.corners
    true_z, length = transform(invert(T), corners.board)[:, 2], np.sqrt(1.0 + (corners.rays**2).sum(axis=1))
    whole = np.column_stack([corners.depth_m, true_z, length])
    return whole[(corners.depth_m > 0) & (whole[:, 1] > 0)]


def _affine(x: Array, y: Array) -> tuple[float, float]:
    """(offset, median of the absolute residuals) of a robust line through points (x, y), each [N]."""
    weight: Array = np.ones(len(x))
    basis = np.column_stack([np.ones(len(x)), x])
    residual: Array = y
    line: Array = np.zeros(2)
    for _ in range(10):
        line = np.asarray(np.linalg.lstsq(basis * weight[:, None], y * weight, rcond=None)[0], np.float64)
        residual = np.abs(y - basis @ line)
        weight = 1.0 / np.sqrt(np.maximum(residual, 1e-4 + 0.1 * np.median(residual)))
    return float(line[0]), float(np.median(residual))


def observe_view(
    detection: Detection, depth: NDArray[np.uint16] | None, setup: Setup
) -> tuple[Observation, MarkerPose]:
    """(the view's corners, and samples of its depth [H, W] where it has any; its pose from markers)."""
    seen = Observation(detection.number, corners_of(detection, setup.board, setup.camera))
    found = fit_markers(seen, setup.camera)
    return (seen if depth is None else _with_depth(seen, depth, detection, found, setup)), found


def _with_depth(
    seen: Observation, depth: NDArray[np.uint16], detection: Detection, found: MarkerPose, setup: Setup
) -> Observation:
    corner_depth = depth_at(depth, seen.corners.pixels, setup.camera.depth_units_per_m)
    on_board = board_patches(depth, detection, setup.board, setup.camera)
    on_object = no_patches()
    if found.fit is not None:
        on_object = object_patches(depth, found.fit.T_board_cam, on_board, setup)
    corners = dataclasses.replace(seen.corners, depth_m=corner_depth)
    return dataclasses.replace(seen, corners=corners, board_patches=on_board, object_patches=on_object)


@dataclass(frozen=True, eq=False)
class Evidence(Setup):
    """What is known of a capture, and of its views in order of number: what they show, their poses from markers.

    corner_px: measured sigma of a corner.
    """

    observations: tuple[Observation, ...]
    markers: tuple[MarkerPose, ...]
    corner_px: float

    @staticmethod
    def of(setup: Setup, observations: list[Observation], markers: list[MarkerPose]) -> "Evidence":
        """With the sigma of a corner measured over all views."""
        corner_px = measured_corner_px(markers, setup.spec)
        markers = refuse_turned(observations, markers, setup.camera, corner_px)
        return Evidence(setup.camera, setup.board, setup.spec, tuple(observations), tuple(markers), corner_px)


MATERIAL = 5e-4
"""What moves a pose by more than this share of its distance is told: a calibration is no better."""
MAX_SIGMA_M = 0.005
MAX_SIGMA_RAD = math.radians(1.0)
"""A pose that is less certain than this spoils a cloud; its view is flagged."""
MIN_CORNERS = 4


@dataclass(frozen=True, eq=False)
class Judged:
    """A view's pose in one estimate, before it is judged: T_board_cam or None, covariance [6, 6] or None, known faults."""

    T_board_cam: Pose | None
    covariance: Array | None = None
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    """Said of a view that is used."""
    by_corners: bool = True
    """Whether the covariance is by the sigma of a corner, and must grow where the view's corners fit worse than that."""


def judge(
    observation: Observation, pose: Judged, evidence: Evidence, depth: DepthCorrection, print_scale: float = 1.0
) -> ViewEstimate:
    """The estimate of one view, with its residuals."""
    number, markers, T = observation.number, observation.markers, pose.T_board_cam
    if T is None or not np.isfinite(T).all():
        reasons = pose.faults or ("no pose was found",)
        return ViewEstimate(number, "refused", None, None, markers, None, None, reasons)
    reprojection_px = median_reprojection(observation, T, evidence.camera, print_scale)
    covariance = pose.covariance
    if pose.by_corners:
        covariance = _widened(covariance, reprojection_px, len(observation.corners.board), evidence.corner_px)
    faults = [*pose.faults, *_doubts(covariance)]
    if reprojection_px is not None and reprojection_px > MOST_REPROJECTION_PX:
        faults.append(
            f"median reprojection error {reprojection_px:.2f} px, above {MOST_REPROJECTION_PX:g}: "
            "the markers do not lie as board.json says, or the view is blurred"
        )
    status: ViewStatus = "flagged" if faults else "used"
    depth_mm = median_board_distance(observation.board_patches, T, depth)
    return ViewEstimate(number, status, T, covariance, markers, reprojection_px, depth_mm, (*faults, *pose.remarks))


def median_reprojection(observation: Observation, T: Pose, camera: CaptureCamera, print_scale: float) -> float | None:
    """Median distance, pixels, of all corners found from where the pose projects them; None without corners."""
    corners = observation.corners
    if not len(corners.board):
        return None
    distance = np.linalg.norm(pixels_of_points(corners.board * print_scale, T, camera) - corners.pixels, axis=1)
    return float(np.median(np.where(np.isfinite(distance), distance, 1e6)))


def median_board_distance(patches: Patches, T: Pose, depth: DepthCorrection) -> float | None:
    """Median distance, millimetres, of the board as depth measures it from the board's plane; None without depth there."""
    if not len(patches):
        return None
    points = transform(T, transform(depth.T_cam_depth, depth.scale * patches.ray_z + depth.offset_m * patches.ray))
    return 1000 * float(np.median(np.abs(points[:, 2])))


def _widened(covariance: Array | None, reprojection_px: float | None, corners: int, corner_px: float) -> Array | None:
    """The covariance of a view whose corners fit worse than those of the capture do, by how much worse.

    The median of a Rayleigh law is 1.177 sigma; of 2 K coordinates 6 are used up by the pose.
    """
    if covariance is None or reprojection_px is None or corners < MIN_CORNERS:
        return covariance
    worse = (reprojection_px / (1.1774 * corner_px)) ** 2 * (2 * corners) / (2 * corners - 6)
    return covariance * max(1.0, worse)


def _doubts(covariance: Array | None) -> list[str]:
    if covariance is None:
        return []
    sigma_m = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:3, :3])[-1])))
    sigma_rad = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])))
    if sigma_m <= MAX_SIGMA_M and sigma_rad <= MAX_SIGMA_RAD:
        return []
    return [f"the pose is uncertain: {1000 * sigma_m:.1f} mm, {math.degrees(sigma_rad):.2f} degrees (one sigma)"]
