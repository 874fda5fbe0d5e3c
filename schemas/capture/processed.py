"""A processed capture: all that its dataset is made of, and what it was scored with."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.capture.estimate import Estimates, Reconstruction, SynthesizedView
from schemas.job.captures import Board
from schemas.scene.view import Camera


@dataclass(frozen=True, eq=False)
class PosedImages:
    """A captured view without its lens: rgb [H, W, 3] uint8, depth_m [H, W] of the same camera, mask [H, W] of the object."""

    number: int
    camera: Camera
    rgb: NDArray[np.uint8]
    depth_m: Array
    mask: NDArray[np.bool_]


@dataclass(frozen=True)
class ViewScore:
    """Errors of one view against truth: of its pose, and the median of the depth that the other views together give for it.

    None where not measured.
    """

    pose_mm: float | None = None
    pose_deg: float | None = None
    depth_median_mm: float | None = None


@dataclass(frozen=True)
class CaptureScore:
    """Errors of a capture against truth: medians over the views, distances of the cloud, and by view number."""

    pose_mm: float | None = None
    pose_deg: float | None = None
    cloud_median_mm: float | None = None
    cloud_p95_mm: float | None = None
    completeness: float | None = None
    depth_median_mm: float | None = None
    views: Mapping[int, ViewScore] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ProcessedCapture:
    """A capture with its poses and its surface.

    `name` of the object; `images` reads a used view by its number; `synthesize` draws what another camera sees, poses in
    the board frame. `undistorted`: the stored images have a lens, which those of `images` have not. `depth_corrected`:
    the depth of `images` is corrected by what the estimate found.
    """

    name: str
    category: str
    licence: str
    board: Board
    estimates: Estimates
    surface: Reconstruction
    images: Callable[[int], PosedImages]
    synthesize: Callable[[Camera], SynthesizedView]
    undistorted: bool = False
    depth_corrected: bool = False
    score: CaptureScore | None = None
