"""Whole captures by arithmetic, with truth: corners by OpenCV's projectPoints, depth of a board with a box by planes."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Pose
from schemas.capture.estimate import CaptureEstimate
from schemas.capture.view import CaptureCamera, Detection
from schemas.job.captures import Board, Estimation
from tests.workers.capture.depths import DepthErrors, measured_depth
from tests.workers.capture.photographs import HALF, hand_held
from tests.workers.capture.poses.scenes import errors, observe
from workers.capture.poses.evidence import Evidence
from workers.capture.poses.observation import Setup
from workers.capture.poses.observe import observe_view

CAMERA = CaptureCamera(HALF, np.zeros(8))
"""Half the Kinect's size, with half its error of a corner: the same accuracy in a quarter of the time."""
CORNER_PX = 0.1


@dataclass(frozen=True, eq=False)
class Virtual:
    """How a virtual capture is made; `few` are numbers of views that see only the markers `few_ids`."""

    views: int = 40
    seed: int = 0
    wrong: DepthErrors = field(default_factory=lambda: DepthErrors(sigma_m=0.003))
    print_scale: float = 1.0
    corner_px: float = CORNER_PX
    box: bool = True
    few: tuple[int, ...] = ()
    few_ids: tuple[int, ...] = ()


def make(virtual: Virtual, **spec) -> tuple[list[Pose], Evidence]:
    """(true T_board_cam, what the estimates are made from)."""
    rng = np.random.default_rng(virtual.seed)
    truth = hand_held(rng, virtual.views)
    setup = Setup(CAMERA, Board(), Estimation(corner_px=CORNER_PX, **spec))
    seen = [one_view(number, T, virtual, setup, rng) for number, T in enumerate(truth)]
    return truth, Evidence.of(setup, [o for o, _ in seen], [m for _, m in seen])


def one_view(number, T, virtual, setup, rng):
    """(observation, pose from markers) of one view; markers behind the box are not seen."""
    visible = observe(T, rng, number=number, camera=CAMERA, scale=virtual.print_scale, corner_px=virtual.corner_px)
    depth = measured_depth(T, HALF, virtual.wrong, rng, box=virtual.box, scale=virtual.print_scale)
    ids = np.unique(visible.corners.markers)
    chosen = np.isin(ids, virtual.few_ids) if number in virtual.few else ~covered(ids) | (not virtual.box)
    pixels = visible.corners.pixels.reshape(-1, 4, 2)[chosen]
    return observe_view(Detection(number, ids[chosen], pixels), depth, setup)


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
