"""Poses from markers alone, and the verdict on a view's pose: used, flagged or refused, with the number measured."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, DepthCorrection, Detection, ViewEstimate, ViewStatus
from schemas.errors import CaptureError
from schemas.job.captures import Estimation
from workers.capture.board import first_poses
from workers.capture.poses.corners import FLOOR_PX, CornerTerm, corner_sigma
from workers.capture.poses.observation import (
    Corners,
    Observation,
    Setup,
    board_patches,
    corners_of,
    depth_at,
    no_patches,
    object_patches,
    pixels_of_points,
)
from workers.capture.poses.terms import MAD, POSE, SHARED, Problem, Shared, minimise
from workers.geometry.frames import angle_between, invert, pose, transform
from workers.geometry.pixels import rays_of_pixels

ROUNDS = 5
"""How often a pose and the spread of its residuals are found one by the other, at most."""
STEPS = 10
AMBIGUOUS = 9.0
"""The two poses of a planar target are told apart by at least this difference of their chi-square: three sigma."""
SAME_RAD = 0.02
"""Two poses that differ by less than this are one."""
MOST_REPROJECTION_PX = 3.0
"""Median reprojection error beyond which a view is flagged: fifteen times that of a detected corner."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose fitted to corners. residuals [K, 2] pixels, information [6, 6] at unit sigma, cost in squared pixels."""

    T_board_cam: Pose
    residuals: Array
    information: Array
    cost: float

    @property
    def spread_px(self) -> float:
        """Standard deviation of one coordinate, by the median of the residuals' absolute values; at least FLOOR_PX."""
        return max(FLOOR_PX, MAD * float(np.median(np.abs(self.residuals))))

    def covariance(self, corner_px: float) -> Array:
        """[6, 6] of a small motion, where corners have this sigma."""
        return np.asarray(corner_px**2 * np.linalg.pinv(self.information, hermitian=True), np.float64)


def fit_pose(start: Pose, corners: Corners, camera: CaptureCamera) -> Fit:
    """The pose nearest to `start` of least robust reprojection error; the loss's scale is the residuals' own spread."""

    def at(T: Pose, sigma_px: float, most: int) -> Fit:
        term = CornerTerm.of([corners], camera, np.full(4, sigma_px))
        problem = Problem([term], np.zeros(SHARED), np.zeros(1, np.bool_))
        solution = minimise(problem, T[None], Shared(), most)
        rows = term.rows(solution.poses, solution.shared)
        information = solution.matrix[:POSE, :POSE] * sigma_px**2
        return Fit(solution.poses[0], sigma_px * rows.residual.reshape(-1, 2), information, sigma_px**2 * rows.cost)

    fit = at(start, 1.0, 0)
    sigma_px = math.inf
    for _ in range(ROUNDS):
        before, sigma_px = sigma_px, min(sigma_px, fit.spread_px)
        if sigma_px > 0.99 * before:
            break
        fit = at(fit.T_board_cam, sigma_px, STEPS)
    return fit


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """One view's pose from its markers: the best fit, the rival that a planar target leaves, and what is wrong.

    fit is None where there is no pose, and `reason` then says why. `rival` is the other pose that fits, of another tilt.
    """

    fit: Fit | None
    rival: Fit | None = None
    reason: str = ""

    def is_ambiguous(self, corner_px: float) -> bool:
        """Whether the corners do not tell the pose from its rival."""
        fit, rival = self.fit, self.rival
        return fit is not None and rival is not None and rival.cost - fit.cost < AMBIGUOUS * corner_px**2


def fit_markers(observation: Observation, camera: CaptureCamera) -> MarkerPose:
    """The pose of one view: both solutions of the planar problem (IPPE), each refined with a robust loss, the better first."""
    corners = observation.corners
    if not observation.markers:
        return MarkerPose(None, reason="no markers of the board found")
    fits = [fit_pose(start, corners, camera) for start in first_poses(corners.board, corners.rays)]
    above = [fit for fit in fits if np.isfinite(fit.T_board_cam).all() and fit.T_board_cam[2, 3] > 0]
    if not above:
        why = "the markers are seen from below the board: it is mirrored, or not the board of board.json"
        return MarkerPose(None, reason=why)
    best, *others = sorted(above, key=lambda fit: fit.cost)
    R = best.T_board_cam[:3, :3]
    return MarkerPose(best, next((f for f in others if angle_between(R, f.T_board_cam[:3, :3]) > SAME_RAD), None))


TURNED = 25.0
"""A turned image is told by so much of chi-square: five sigma."""
WELL_FITTING = 0.5
"""And by at most this share of the misfit being left: a wrong lens fits a little better one way or the other."""
ILL_FITTING = 2.0
"""Only views whose corners fit so many times worse than those of the median view are looked at."""


def refuse_turned(
    observations: Sequence[Observation], markers: Sequence[MarkerPose], camera: CaptureCamera, corner_px: float
) -> list[MarkerPose]:
    """The poses, without those of views whose corners fit better where the image is turned by 180 degrees.

    The board looks turned as well, and a pose is found: the principal point and the lens are then those of another place.
    """
    usual = np.median([view.fit.spread_px for view in markers if view.fit] or [np.inf])
    k, kept = camera.intrinsics, list(markers)
    for place, (seen, view) in enumerate(zip(observations, markers, strict=True)):
        if view.fit is None or view.fit.spread_px < ILL_FITTING * usual:
            continue
        rays = rays_of_pixels(np.array([k.width, k.height]) - seen.corners.pixels, k, camera.lens)
        T_turned = view.fit.T_board_cam @ pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        if np.isfinite(rays).all():
            cost = fit_pose(T_turned, dataclasses.replace(seen.corners, rays=rays), camera).cost
            if view.fit.cost - cost > TURNED * corner_px**2 and cost < WELL_FITTING * view.fit.cost:
                reason = "its image is turned by 180 degrees against the others': turn rgb_ and depth_ back"
                kept[place] = MarkerPose(None, reason=reason)
    return kept


def measured_corner_px(markers: Sequence[MarkerPose], spec: Estimation) -> float:
    """Standard deviation of a detected corner in this capture, pixels, by the residuals of all views and the expected one."""
    fits = [view.fit.residuals.ravel() for view in markers if view.fit is not None and len(view.fit.residuals) > 3]
    residuals = np.concatenate([*fits, np.zeros(0)])
    free = len(residuals) - POSE * len(fits)
    if free <= 0:
        return spec.corner_px
    return corner_sigma((MAD * float(np.median(np.abs(residuals)))) ** 2 * len(residuals) / free, free, spec)


# ---------------------------------------------------------------------------------------------- what is known of a capture


@dataclass(frozen=True, eq=False)
class Evidence(Setup):
    """What is known of a capture, and of its views in order of number: what they show, their poses from markers.

    corner_px: measured sigma of a corner. `notes` for the user.
    """

    observations: tuple[Observation, ...]
    markers: tuple[MarkerPose, ...]
    corner_px: float
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(
        setup: Setup, observations: list[Observation], markers: list[MarkerPose], notes: tuple[str, ...] = ()
    ) -> "Evidence":
        """With the sigma of a corner measured over all views."""
        corner_px = measured_corner_px(markers, setup.spec)
        markers = refuse_turned(observations, markers, setup.camera, corner_px)
        return Evidence(setup.camera, setup.board, setup.spec, tuple(observations), tuple(markers), corner_px, notes)


def observe_view(
    detection: Detection, depth: NDArray[np.uint16] | None, setup: Setup
) -> tuple[Observation, MarkerPose]:
    """(the view's corners, and samples of its depth [H, W] where it has any; its pose from markers)."""
    seen = Observation(detection.number, corners_of(detection, setup.board, setup.camera))
    view = fit_markers(seen, setup.camera)
    if depth is None:
        return seen, view
    corner_depth = depth_at(depth, seen.corners.pixels, setup.camera.depth_units_per_m)
    on_board, on_object = board_patches(depth, detection, setup.board, setup.camera), no_patches()
    if view.fit is not None:
        on_object = object_patches(depth, view.fit.T_board_cam, on_board, setup)
    corners = dataclasses.replace(seen.corners, depth_m=corner_depth)
    return Observation(detection.number, corners, on_board, on_object), view


SAME_PLACE_M = 0.05
"""Two prints that lie to one another as in another view do so to this."""
OF_ITS_SIZE = 1.1
"""By depth a print is not so many times as large or small as board.json says."""
BARE = 0.1
"""The object covers this share of what it usually does with patches, where it stands on the print that a view shows."""

View = tuple[Observation, MarkerPose]


def choose_prints(views: Sequence[Sequence[View]]) -> tuple[list[View], tuple[str, ...]]:
    """(of the prints of the board in each view the one that the object stands on, notes).

    Prints that lie to one another alike in several views are judged by all of these together, in views without depth by the
    number of their markers. A view that shows one bare print may show the other, and then has no pose.
    """
    several = [view for view in views if len(view) > 1]
    if not several:
        return [view[0] for view in views], ()
    pairs = [
        (_beside(a, b), _stands_on(a) - _stands_on(b)) for view in several for a in view for b in view if a is not b
    ]
    beside, better = np.array([place for place, _ in pairs]), np.array([score for _, score in pairs])

    def score(candidate: View, view: Sequence[View]) -> float:
        places = [_beside(candidate, other) for other in view if other is not candidate]
        return sum(float(better[_norm(beside - place) < SAME_PLACE_M].sum()) for place in places)

    chosen = [max(view, key=lambda one: (score(one, view), _stands_on(one))) for view in views]
    usual = np.median([len(pick[0].object_patches) for pick, view in zip(chosen, views, strict=True) if len(view) > 1])
    reason = "it shows one print of the board, and a second is in view elsewhere: nothing stands on the one it shows"
    for n, (pick, view) in enumerate(zip(chosen, views, strict=True)):
        if len(view) == 1 and pick[1].fit is not None and len(pick[0].object_patches) < BARE * usual:
            chosen[n] = pick[0], MarkerPose(None, reason=reason)
    numbers = ", ".join(str(view[0][0].number) for view in several)
    where = "poses are those of the print that the object stands on; take the other one away"
    return chosen, (f"a second print of the board is in view ({numbers}): {where}",)


def _beside(view: View, other: View) -> Array:
    """[3]: where the origin of another print lies, by the poses of both; nan where one has none."""
    if view[1].fit is None or other[1].fit is None:
        return np.full(3, np.nan)
    return (view[1].fit.T_board_cam @ invert(other[1].fit.T_board_cam))[:3, 3]


def _stands_on(view: View) -> float:
    """How much of an object stands on a print as large as depth has it; next to nothing of it is its number of markers."""
    seen, markers = view
    if markers.fit is None:
        return -1.0
    corners, count = seen.corners, len(seen.object_patches)
    true_z = transform(invert(markers.fit.T_board_cam), corners.board)[:, 2]
    ratio = float(np.median((corners.depth_m / true_z)[corners.depth_m > 0])) if corners.depth_m.any() else 1.0
    return count * float(1 / OF_ITS_SIZE < ratio < OF_ITS_SIZE) + 1e-3 * seen.markers


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


def check_depth(evidence: Evidence) -> None:
    """Raises CaptureError where depth at the markers is what no sensor measures, with the key of camera.json to change.

    Units, an offset, and distances along the ray in place of z: these grow with the angle to the axis as sqrt(1 + x^2 + y^2).
    """
    parts, camera = [np.zeros((0, 3))], evidence.camera
    for seen, view in zip(evidence.observations, evidence.markers, strict=True):
        if view.fit is not None and fits_board(seen, view.fit.T_board_cam, camera):  # else they tell no distance
            corners, length = seen.corners, np.hypot(1.0, _norm(seen.corners.rays))
            true_z = transform(invert(view.fit.T_board_cam), corners.board)[:, 2]
            parts.append(np.column_stack([corners.depth_m, true_z, length])[(corners.depth_m > 0) & (true_z > 0)])
    z, true_z, length = np.concatenate(parts).T
    if len(z) < MANY:
        return
    scale = float(np.median(z / true_z))
    if not 1 / NO_PRINT < scale < NO_PRINT:
        fits = camera.depth_units_per_m * scale
        fits = next((known for known in UNITS if abs(known / fits - 1) < 0.1), float(f"{fits:.3g}"))
        given = f"depth_units_per_m in camera.json is {camera.depth_units_per_m:g}"
        raise CaptureError(
            "depth", f"depth is {float(f'{scale:.3g}'):g} times what the markers say: {given}, and {fits:g} would fit"
        )
    # Scale and offset are left open: a print of another size and a sensor's own error are no matter of the ray.
    by_kind = {power: _fit_line(true_z * length**power, z) for power in (-1, 0, 1)}
    best = min(by_kind, key=lambda power: by_kind[power][1])
    if best and by_kind[best][1] < CLEARLY * by_kind[0][1]:
        seen_as, word = ("the distance along the ray", "ray") if best > 0 else ("z along the optical axis", "z")
        grows = f'its error grows with the angle to the optical axis; write "depth": "{word}" into camera.json'
        raise CaptureError("depth", f"depth is {seen_as}, and camera.json says {camera.depth}: {grows}")
    offset_m = by_kind[0][0]
    if abs(offset_m) > NO_SENSOR_M:
        words = f"depth is off by {1000 * offset_m:+.0f} mm at every distance, which no sensor is"
        raise CaptureError("depth", f"{words}: export it again without an offset (0 is no depth)")


def _norm(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1), np.float64)


def _fit_line(x: Array, y: Array) -> tuple[float, float]:
    """(offset, median of the absolute residuals) of a robust line through points (x, y), each [N] metres."""
    line = least_squares(lambda line: line[0] + line[1] * x - y, [0.0, 1.0], loss="soft_l1", f_scale=1e-3)
    return float(line.x[0]), float(np.median(np.abs(line.fun)))


# ---------------------------------------------------------------------------------------------- the verdict

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
    observation: Observation, view: Judged, evidence: Evidence, depth: DepthCorrection, print_scale: float = 1.0
) -> ViewEstimate:
    """The estimate of one view, with its residuals."""
    number, markers, T = observation.number, observation.markers, view.T_board_cam
    if T is None or not np.isfinite(T).all():
        reasons = view.faults or ("no pose was found",)
        return ViewEstimate(number, "refused", None, None, markers, None, None, reasons)
    off_px, covariance, faults = median_reprojection(observation, T, evidence.camera, print_scale), view.covariance, []
    count = len(observation.corners.board)
    if covariance is not None and view.by_corners and off_px is not None and count >= MIN_CORNERS:
        # The median of a Rayleigh law is 1.177 sigma; of 2 K coordinates 6 are used up by the pose.
        worse = (off_px / (1.1774 * evidence.corner_px)) ** 2 * (2 * count) / (2 * count - POSE)
        covariance = covariance * max(1.0, worse)
    if covariance is not None:
        blocks = covariance[:3, :3], covariance[3:, 3:]
        sigma_m, sigma_rad = (math.sqrt(max(0.0, float(np.linalg.eigvalsh(block)[-1]))) for block in blocks)
        if sigma_m > MAX_SIGMA_M or sigma_rad > MAX_SIGMA_RAD:
            sigma = f"{1000 * sigma_m:.1f} mm, {math.degrees(sigma_rad):.2f} degrees"
            by_depth = sigma_rad <= MAX_SIGMA_RAD and evidence.spec.trust == "depth"
            remedy = (
                ": take more views, or take the print for metric truth (estimation.trust: print)" if by_depth else ""
            )
            faults.append(f"the pose is uncertain: {sigma} (one sigma){remedy}")
    if off_px is not None and off_px > MOST_REPROJECTION_PX:
        faults.append(
            f"median reprojection error {off_px:.2f} px, above {MOST_REPROJECTION_PX:g}: "
            "the markers do not lie as board.json says, or the view is blurred"
        )
    patches, depth_mm = observation.board_patches, None
    if len(patches):
        points = transform(depth.T_cam_depth, depth.scale * patches.ray_z + depth.offset_m * patches.ray)
        depth_mm = 1000 * float(np.median(np.abs(transform(T, points)[:, 2])))
    faults = [*view.faults, *faults]
    status: ViewStatus = "flagged" if faults else "used"
    return ViewEstimate(number, status, T, covariance, markers, off_px, depth_mm, (*faults, *view.remarks))


def median_reprojection(observation: Observation, T: Pose, camera: CaptureCamera, print_scale: float) -> float | None:
    """Median distance, pixels, of all corners found from where the pose projects them; None without corners."""
    corners = observation.corners
    if not len(corners.board):
        return None
    distance = _norm(pixels_of_points(corners.board * print_scale, T, camera) - corners.pixels)
    return float(np.median(np.where(np.isfinite(distance), distance, 1e6)))


def fits_board(observation: Observation, T: Pose, camera: CaptureCamera) -> bool:
    """Whether a pose explains the view's corners."""
    off_px = median_reprojection(observation, T, camera, 1.0)
    return off_px is not None and off_px <= MOST_REPROJECTION_PX
