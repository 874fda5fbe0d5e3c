"""What the joint estimate says of simulated captures, by what is wrong with them, and whether its camera makes them worse.

`python -m tests.workers.capture.confusion --captures 50` prints the table of docs/captures.md. Corners and patches of depth are
computed, not drawn: by OpenCV's projections and by planes, from parameters that are drawn anew for each capture.
"""

import argparse
import dataclasses
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.capture import CaptureCamera, CaptureEstimate
from schemas.errors import CaptureError
from schemas.job.captures import Board, Estimation
from tests.workers.capture.drawn import BOX, KINECT, LENS, PINHOLE, errors, hand_held, project
from workers.capture.board import marker_corners
from workers.capture.poses.estimates import estimate_joint
from workers.capture.poses.markers import Evidence, fit_markers
from workers.capture.poses.observation import Corners, Observation, Patches, Setup
from workers.capture.poses.standing import check_moments
from workers.capture.poses.terms import moved
from workers.geometry.frames import invert, pose, rotation_about, transform
from workers.geometry.pixels import project_points, rays_of_pixels

Random = np.random.Generator
SIZE = np.array([KINECT.width, KINECT.height])


@dataclass(frozen=True, eq=False)
class Flaw:
    """What is wrong with a capture: the camera that is given and the true one, the print, and what moved.

    printed: board points [N, 3] of a true print; pixels [N, 2] of printed points in a view, by its number, T and true camera;
    T_depth: where the depth camera stood, by number; T_object: where the object stood on the board, by number.
    """

    given: CaptureCamera = PINHOLE
    true: CaptureCamera = PINHOLE
    board: Board = field(default_factory=Board)
    printed: Callable[[Array], Array] = lambda points: points
    pixels: Callable[[int, Array, Pose, CaptureCamera], Array] = lambda number, points, T, camera: project(
        points, T, camera
    )
    T_depth: Callable[[list[Pose], int], Pose] = lambda poses, number: poses[number]
    T_object: Callable[[int], Pose] = lambda number: np.eye(4)


def directions(rng: Random, count: int = 1) -> Array:
    """[count, 3] unit vectors."""
    v = rng.standard_normal((count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True), np.float64)


def numbers(camera: CaptureCamera, **changed: float) -> CaptureCamera:
    return dataclasses.replace(camera, intrinsics=camera.intrinsics.model_copy(update=changed))


def sign(rng: Random) -> float:
    return float(rng.choice([-1.0, 1.0]))


def centre(rng: Random) -> Flaw:
    half = 0.5 * sign(rng)
    off = np.array([half, half]) if rng.random() < 0.5 else rng.uniform(4, 20, 2) * [sign(rng), sign(rng)]
    return Flaw(numbers(LENS, cx=KINECT.cx + off[0], cy=KINECT.cy + off[1]), LENS)


def focal(rng: Random) -> Flaw:
    by = 1 + sign(rng) * rng.uniform(0.005, 0.02)
    return Flaw(numbers(LENS, fx=KINECT.fx * by, fy=KINECT.fy * by), LENS)


def radial(rng: Random) -> Flaw:
    return Flaw(PINHOLE, dataclasses.replace(PINHOLE, lens=np.eye(8)[0] * sign(rng) * rng.uniform(0.02, 0.1)))


AZURE = np.array([0.33, -2.49, -1.6e-4, -1.3e-4, 1.45, 0.21, -2.30, 1.38])


def five_of_eight(rng: Random) -> Flaw:
    lens = AZURE * (1 + rng.uniform(-0.1, 0.1) * np.array([0, 1, 0, 0, 1, 0, 1, 1]))
    true = dataclasses.replace(PINHOLE, lens=lens)
    return Flaw(dataclasses.replace(true, lens=lens * (np.arange(8) < 5)), true)


def fisheye(rng: Random) -> Flaw:
    focal_px, k = rng.uniform(700, 950), rng.uniform(-0.02, 0.02, 4)
    true = numbers(PINHOLE, fx=focal_px, fy=focal_px)

    def pixels(number: int, points: Array, T: Pose, camera: CaptureCamera) -> Array:
        i, T = camera.intrinsics, invert(T)
        K = np.array([[i.fx, 0, i.cx - 0.5], [0, i.fy, i.cy - 0.5], [0, 0, 1]])
        at, _ = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, k)
        return np.asarray(at.reshape(-1, 2) + 0.5, np.float64)

    return Flaw(true, true, pixels=pixels)


def focus(rng: Random) -> Flaw:
    by = 1 + rng.uniform(0.003, 0.01) * rng.uniform(-1, 1, 40)

    def pixels(number: int, points: Array, T: Pose, camera: CaptureCamera) -> Array:
        i = camera.intrinsics
        return project(points, T, numbers(camera, fx=i.fx * by[number], fy=i.fy * by[number]))

    return Flaw(LENS, LENS, pixels=pixels)


def rolling(rng: Random) -> Flaw:
    motion = np.hstack([directions(rng, 40), directions(rng, 40)]) * np.repeat(
        rng.uniform([0.08, 0.07], [0.2, 0.18]), 3
    )
    read_s = rng.uniform(0.02, 1 / 30)

    def pixels(number: int, points: Array, T: Pose, camera: CaptureCamera) -> Array:
        at = project(points, T, camera)
        for _ in range(4):
            time_s = read_s * (at[:, 1] / KINECT.height - 0.5)
            at = np.stack(
                [project(p[None], moved(T, t * motion[number]), camera)[0] for p, t in zip(points, time_s, strict=True)]
            )
        return at

    return Flaw(LENS, LENS, pixels=pixels)


def bent(rng: Random) -> Flaw:
    sag_m, turn = sign(rng) * rng.uniform(0.0015, 0.004), rng.uniform(0, np.pi)
    along = np.array([np.cos(turn), np.sin(turn)])

    def printed(points: Array) -> Array:
        reach = 0.5 * float(np.ptp(marker_corners(Board())[..., :2].reshape(-1, 2) @ along))
        return points + np.outer(sag_m * ((points[:, :2] @ along / reach) ** 2), [0, 0, 1])

    return Flaw(LENS, LENS, printed=printed)


def scaled(rng: Random, least: float, most: float, along: Array) -> Flaw:
    by = 1 + sign(rng) * rng.uniform(least, most) * along
    return Flaw(LENS, LENS, printed=lambda points: points * by)


def late(rng: Random) -> Flaw:
    shift_m, turn_rad = rng.uniform(0.004, 0.010), np.radians(rng.uniform(0.3, 0.8))
    motion = np.hstack([shift_m * directions(rng, 40), turn_rad * directions(rng, 40)])
    return Flaw(LENS, LENS, T_depth=lambda poses, number: moved(poses[number], motion[number]))


def swapped(rng: Random) -> Flaw:
    step = int(sign(rng))
    return Flaw(LENS, LENS, T_depth=lambda poses, number: poses[(number + step) % len(poses)])


def object_moved(rng: Random) -> Flaw:
    turn, way, first = np.radians(rng.uniform(4, 15) * sign(rng)), rng.uniform(0, 2 * np.pi), rng.integers(3, 6)
    T = pose(
        rotation_about(np.array([0, 0, 1.0]), turn), rng.uniform(0.02, 0.04) * np.array([np.cos(way), np.sin(way), 0])
    )
    return Flaw(LENS, LENS, T_object=lambda number: T if number < first else np.eye(4))


def unregistered(rng: Random) -> Flaw:
    step = np.hstack([rng.uniform(0.005, 0.02) * directions(rng), np.radians(rng.uniform(0.3, 2.0)) * directions(rng)])[
        0
    ]
    T_color_depth = moved(np.eye(4), step)
    return Flaw(LENS, LENS, T_depth=lambda poses, number: poses[number] @ T_color_depth)


def rolling_and_scaled(rng: Random) -> Flaw:
    return dataclasses.replace(rolling(rng), printed=scaled(rng, 0.008, 0.015, np.ones(3)).printed)


def moved_and_centre(rng: Random) -> Flaw:
    return dataclasses.replace(centre(rng), T_object=object_moved(rng).T_object)


CAUSES: dict[str, tuple[Callable[[Random], Flaw], str]] = {
    "nothing": (lambda rng: Flaw(LENS, LENS, Board(measured_ruler_m=0.2)), ""),
    "principal point": (centre, "camera"),
    "focal length": (focal, "camera"),
    "k1": (radial, "camera"),
    "five of eight numbers": (five_of_eight, "lens"),
    "fisheye": (fisheye, "lens"),
    "focus by view": (focus, "focus"),
    "rolling shutter": (rolling, "rows"),
    "bent board": (bent, "bent"),
    "stretched print": (lambda rng: scaled(rng, 0.003, 0.01, np.eye(3)[0]), "stretched"),
    "print scale": (lambda rng: scaled(rng, 0.004, 0.012, np.ones(3)), "ruler scale"),
    "depth late": (late, "moment"),
    "depth of the next view": (swapped, "moment swapped"),
    "object moved": (object_moved, "moved"),
    "object moved and principal point": (moved_and_centre, "camera moved"),
    "rolling shutter and print scale": (rolling_and_scaled, "rows scale"),
    "registration": (unregistered, ""),
}
"""How each is drawn, and what must be said of it."""
SAID = {
    "camera": "camera.json does not fit: ",
    "lens": "another lens",
    "focus": "focal length changes",
    "rows": "rows of an image",
    "bent": "board is bent",
    "stretched": "longer along x",
    "none fits": "no explanation fits",
    "alike": "too few or too alike",
    "moment": "not of one moment",
    "swapped": "depth_0",
    "moved": "the object moved",
    "scale": "disagree about the scale",
    "ruler": "ruler was not measured",
}
"""Words by which a message is known."""

POINTS, GRAIN_M, EDGE_M = 60, 0.001, 0.01
"""Points of depth on each face of the object, sigma of a patch's middle at 1 m, and half its width."""


def patches_at(points: Array, normals: Array, T: Pose, flaw: Flaw, rng: Random) -> Patches:
    """Depth's patches in camera axes of points on the board [P, 3] that face the camera at T, read with the given camera."""
    p, normal = transform(invert(T), points), normals @ T[:3, :3]
    seen = (normal * p).sum(axis=1) < -0.35 * np.linalg.norm(p, axis=1)
    p, normal = p[seen], normal[seen]
    i = flaw.given.intrinsics
    pixels = project_points(p, flaw.true.intrinsics, flaw.true.lens)
    rays = rays_of_pixels(pixels, i, flaw.given.lens)
    inside = np.isfinite(rays).all(axis=1) & ((pixels > 0) & (pixels < [i.width, i.height])).all(axis=1)
    ray, z = np.column_stack([rays, np.ones(len(p))])[inside], p[inside, 2]
    z = z + rng.normal(0, GRAIN_M, len(z)) * z**2
    return Patches(ray * z[:, None], ray, normal[inside], 0.003 * z**2)


def surface(rng: Random) -> tuple[Array, Array]:
    """(points [P, 3], normals [P, 3]) of the box on the board."""
    points, normals, (low, high) = [], [], BOX
    for axis, end in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):
        p = low + (high - low) * rng.uniform(0.1, 0.9, (POINTS, 3))
        p[:, axis] = (low, high)[end][axis]
        points.append(p)
        normals.append(np.tile((2 * end - 1) * np.eye(3)[axis], (POINTS, 1)))
    return np.concatenate(points), np.concatenate(normals)


def hidden(points: Array, T: Pose, T_object: Pose) -> NDArray[np.bool_]:
    """[P] bool: points on the board that the box hides from a camera at T, or stands on."""
    eye, p = transform(invert(T_object), T[None, :3, 3])[0], transform(invert(T_object), points)
    with np.errstate(divide="ignore"):
        low, high = ((end - EDGE_M * side - eye) / (p - eye) for end, side in zip(BOX, (1, -1), strict=True))
    return np.asarray(np.minimum(low, high).max(axis=1) < np.minimum(np.maximum(low, high).min(axis=1), 1.0 + 1e-6))


def simulate(cause: str, seed: int, camera: CaptureCamera | None = None) -> tuple[list[Pose], Evidence]:
    """(true T_board_cam, what is seen) of a capture with this cause, read with a camera; the parameters are the seed's."""
    rng = np.random.default_rng([seed, list(CAUSES).index(cause)])
    flaw, truth = CAUSES[cause][0](rng), hand_held(rng, int(rng.integers(8, 15)))
    flaw = flaw if camera is None else dataclasses.replace(flaw, given=camera)
    corner_px, nominal = float(rng.uniform(0.03, 0.15)), marker_corners(flaw.board)
    seen = []
    for number, T in enumerate(truth):
        T_object, T_depth, printed = (
            flaw.T_object(number),
            flaw.T_depth(truth, number),
            flaw.printed(nominal.reshape(-1, 3)),
        )
        pixels = flaw.pixels(number, printed, T, flaw.true)
        pixels = pixels + rng.normal(0, corner_px, pixels.shape)
        rays = rays_of_pixels(pixels, flaw.given.intrinsics, flaw.given.lens)
        inside = ((pixels > 3) & (pixels < SIZE - 3) & np.isfinite(rays)).all(axis=1) & ~hidden(printed, T, T_object)
        whole = np.repeat(inside.reshape(-1, 4).all(axis=1), 4)
        ids = np.repeat(np.arange(len(nominal)), 4)[whole]
        corners = Corners(nominal.reshape(-1, 3)[whole], pixels[whole], rays[whole], ids, np.zeros(len(ids)))
        middles = printed.reshape(-1, 4, 3).mean(axis=1)
        middles = middles[~hidden(middles, T_depth, T_object)]
        on_board = patches_at(middles, np.tile([0, 0, 1.0], (len(middles), 1)), T_depth, flaw, rng)
        points, normals = surface(rng)
        on_object = patches_at(transform(T_object, points), normals @ T_object[:3, :3].T, T_depth, flaw, rng)
        seen.append(Observation(number, corners, on_board, on_object))
    setup = Setup(flaw.given, flaw.board, Estimation(corner_px=0.1))
    return truth, Evidence.of(setup, seen, [fit_markers(o, flaw.given) for o in seen])


def messages(evidence: Evidence) -> tuple[str, CaptureEstimate | None]:
    """(what is said of a capture, in the words of `SAID`, and its estimate unless it is refused)."""
    try:
        check_moments(evidence)
        estimate = estimate_joint(evidence)
    except CaptureError as error:
        return " ".join(name for name, words in SAID.items() if words in str(error)), None
    said = [name for name, words in SAID.items() if any(words in note for note in estimate.notes)]
    return " ".join(said), estimate


def median_mm(estimate: CaptureEstimate, truth: list[Pose]) -> tuple[float, float]:
    """(error, sigma) of the positions of cameras, medians."""
    off, sigma = [], []
    for view in estimate.views:
        if view.T_board_cam is not None and view.covariance is not None:
            off.append(errors(view.T_board_cam, truth[view.number])[0])
            sigma.append(1000 * np.sqrt(np.trace(view.covariance[:3, :3])))
    return float(np.median(off)), float(np.median(sigma))


COVERED, WORSE, WORSE_MM = 2.0, 1.1, 0.05
"""What is not named is right where poses are off by at most so many sigmas. A camera that is taken may not make them worse by
more than this factor and this much."""


@dataclass(frozen=True)
class Outcome:
    """Of one capture: what is said, in words of `SAID`; whether that is its cause, and whether it is covered if nothing is.

    worse: the camera that `--calibrate` takes brings the poses farther from the truth. sigmas: by how many cameras are off.
    """

    said: str
    named: bool
    covered: bool
    worse: bool
    sigmas: float

    @property
    def right(self) -> bool:
        """Whether it is named, or nothing wrong is said and the sigma covers it."""
        return self.named or self.covered


def judge(cause: str, seed: int) -> Outcome:
    """Simulates a capture and judges what is said of it."""
    truth, evidence = simulate(cause, seed)
    words, estimate = messages(evidence)
    expected, said = set(CAUSES[cause][1].split()), set(words.split())
    usual = {"ruler"} - expected  # said beside the object, and true
    named = expected == said - usual or (cause == "print scale" and len(said) == 1 and said < expected)
    if estimate is None:
        return Outcome(words, named, False, False, 0.0)
    off, sigma = median_mm(estimate, truth)
    covered = said <= usual and off < COVERED * sigma and not expected & {"moved", "moment", "swapped", "ruler"}
    worse = False
    if said & {"camera", "lens", "alike", "none"}:
        spec = evidence.spec.model_copy(update={"calibrate": True})
        camera = estimate_joint(dataclasses.replace(evidence, spec=spec)).camera
        if camera is not None:
            after = median_mm(estimate_joint(simulate(cause, seed, camera)[1]), truth)[0]
            worse = after > WORSE * off + WORSE_MM
    return Outcome(words, named, covered, worse, off / sigma)


def confusion(captures: int, causes: list[str], workers: int = 1) -> dict[str, list[Outcome]]:
    """The outcomes of so many captures of each cause."""
    tasks = [(cause, seed) for cause in causes for seed in range(captures)]
    with ProcessPoolExecutor(workers) as pool:
        outcomes = list(pool.map(judge, *zip(*tasks, strict=True), chunksize=4))
    return {cause: outcomes[n * captures : (n + 1) * captures] for n, cause in enumerate(causes)}


def table(outcomes: dict[str, list[Outcome]]) -> str:
    """The table of docs/captures.md: of each cause the shares named, and covered, and what else is said."""
    lines = ["| cause | named | covered | else said |", "|---|---|---|---|"]
    for cause, each in outcomes.items():
        other = Counter(o.said.replace("ruler", "").strip() or "nothing" for o in each if not o.right)
        words = ", ".join(f"{name} {count}" for name, count in other.most_common())
        shares = [
            100 * sum(values) / len(each)
            for values in ((o.named for o in each), (o.covered and not o.named for o in each))
        ]
        lines.append(
            f"| {cause} | {shares[0]:.0f} % | {shares[1]:.0f} % | {words}{' WORSE' * any(o.worse for o in each)} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", type=int, default=50)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--cause", action="append", choices=list(CAUSES))
    arguments = parser.parse_args()
    print(table(confusion(arguments.captures, arguments.cause or list(CAUSES), arguments.workers)))


if __name__ == "__main__":
    main()
