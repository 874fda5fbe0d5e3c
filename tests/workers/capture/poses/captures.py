"""Whole captures by arithmetic, with truth: corners by OpenCV's projectPoints, depth of a board with a box by planes."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Pose
from schemas.capture import CaptureCamera, CaptureEstimate, Detection
from schemas.job.captures import Board, Estimation
from tests.workers.capture.depths import DepthErrors, measured_depth
from tests.workers.capture.photographs import HALF, KINECT, QUARTER, hand_held
from tests.workers.capture.poses.scenes import errors, observe
from workers.capture.poses.observation import Setup, no_patches
from workers.capture.poses.patches import observe_view
from workers.capture.poses.verdict import Evidence

CAMERA = CaptureCamera(QUARTER, np.zeros(8))
"""A quarter of the Kinect's size, with a quarter of its error of a corner: the same accuracy in little time."""
FINER = CaptureCamera(HALF, np.zeros(8))
CORNER_PX = 0.05


@dataclass(frozen=True, eq=False)
class Virtual:
    """How a virtual capture is made; `few` are numbers of views that see only the markers `few_ids`."""

    views: int = 40
    seed: int = 0
    wrong: DepthErrors = field(default_factory=lambda: DepthErrors(sigma_m=0.003))
    print_scale: float = 1.0
    corner_px: float = 0.2
    """At the Kinect's full size."""
    box: bool = True
    few: tuple[int, ...] = ()
    few_ids: tuple[int, ...] = ()
    camera: CaptureCamera = CAMERA


def make(virtual: Virtual, **spec) -> tuple[list[Pose], Evidence]:
    """(true T_board_cam, what the estimates are made from)."""
    rng = np.random.default_rng(virtual.seed)
    truth = hand_held(rng, virtual.views)
    setup = Setup(virtual.camera, Board(), Estimation(corner_px=_corner_px(virtual), **spec))
    seen = [one_view(number, T, virtual, setup, rng) for number, T in enumerate(truth)]
    return truth, Evidence.of(setup, [o for o, _ in seen], [m for _, m in seen])


def one_view(number, T, virtual, setup, rng):
    """(observation, pose from markers) of one view; markers behind the box are not seen."""
    k, scale = setup.camera.intrinsics, virtual.print_scale
    visible = observe(T, rng, number=number, camera=setup.camera, scale=scale, corner_px=_corner_px(virtual))
    depth = measured_depth(T, k, virtual.wrong, rng, box=virtual.box, scale=scale, grain_px=1)
    ids = np.unique(visible.corners.markers)
    chosen = np.isin(ids, virtual.few_ids) if number in virtual.few else ~covered(ids) | (not virtual.box)
    pixels = visible.corners.pixels.reshape(-1, 4, 2)[chosen]
    return observe_view(Detection(number, ids[chosen], pixels), depth, setup)


def _corner_px(virtual: Virtual) -> float:
    return virtual.corner_px * virtual.camera.intrinsics.fx / KINECT.fx


def covered(ids):
    """[M] bool: markers in the middle of the board, where the box stands or behind which it hides them."""
    return np.isin(ids, [9, 10, 11, 16, 17, 18, 23, 24, 25])


def median_errors(estimate: CaptureEstimate, truth: list[Pose]) -> tuple[float, float]:
    """(millimetres, degrees), medians over the views that have a pose."""
    found = [errors(v.T_board_cam, truth[v.number]) for v in estimate.views if v.T_board_cam is not None]
    mm, degrees = np.median(found, axis=0)
    return float(mm), float(degrees)


def replaced(virtual: Virtual, **changes) -> Virtual:
    """The capture with other settings."""
    return dataclasses.replace(virtual, **changes)


def without_depth(evidence: Evidence) -> Evidence:
    """The same views, of a camera without depth."""
    bare = [
        dataclasses.replace(
            seen,
            corners=dataclasses.replace(seen.corners, depth_m=np.zeros(len(seen.corners.board))),
            board_patches=no_patches(),
            object_patches=no_patches(),
            has_depth=False,
        )
        for seen in evidence.observations
    ]
    return dataclasses.replace(evidence, observations=tuple(bare))
