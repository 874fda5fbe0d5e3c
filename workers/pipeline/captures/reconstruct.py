"""The surface of a capture's object from its folder and the estimated poses."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from schemas.capture.estimate import CaptureEstimate, Reconstruction
from schemas.errors import CaptureError
from schemas.job.captures import Fusion
from schemas.scene.shape import Mesh
from workers.capture.fuse import fuse_views
from workers.capture.masks import down_to_board
from workers.capture.object_region import ObjectRegion, find_object
from workers.capture.posed_view import PosedView, pose_view
from workers.pipeline.captures.corrections import Given
from workers.scene.context import Stopwatch
from workers.store.capture_folder import read_view


@dataclass(frozen=True, eq=False)
class Merged:
    """The object of a capture: where it stands, its surface, and that surface continued down to the board, for masks."""

    region: ObjectRegion
    surface: Reconstruction
    body: Mesh
    notes: tuple[str, ...]


def read_posed(given: Given, estimate: CaptureEstimate, number: int) -> PosedView:
    """One view with its pose in an estimate; the mask is the user's. Raises CaptureError where it has no pose or no depth."""
    own = next(view for view in estimate.views if view.number == number)
    if own.T_board_cam is None:
        raise CaptureError("no_pose", f"view {number} has no pose: {'; '.join(own.reasons)}")
    stored = read_view(given.folder, number)
    if not given.has_mask(number):
        stored = replace(stored, mask=None)
    return pose_view(stored, given.folder.camera, own.T_board_cam, estimate.depth)


def read_used(given: Given, estimate: CaptureEstimate) -> Iterator[PosedView]:
    """The used views that have a depth image with anything in it, in order."""
    for view in estimate.used:
        if (given.folder.path / f"depth_{view.number:05d}.png").exists():
            posed = read_posed(given, estimate, view.number)
            if posed.depth_m.any():
                yield posed


def reconstruct(given: Given, estimate: CaptureEstimate, spec: Fusion, watch: Stopwatch | None = None) -> Merged:
    """Merge the used views. Raises CaptureError where no view has depth, or no object is found or confirmed."""
    watch = watch or Stopwatch()
    with watch.stage("read"):
        views = list(read_used(given, estimate))
    if not views:
        raise CaptureError(
            "no_depth",
            f"none of the {len(estimate.used)} used views of {given.folder.path} has depth: depth_00000.png and so on are "
            "missing or empty, and without depth there is no surface",
        )
    with watch.stage("find_object"):
        region = find_object(views, given.folder.board, spec)
    with watch.stage("fuse"):
        surface = fuse_views(views, region, spec)
    missing = len(estimate.used) - len(views)
    notes = (*region.notes, *((f"{missing} used views have no depth",) if missing else ()), *_holes(surface))
    body = down_to_board(Mesh(surface.vertices, surface.faces), region)
    return Merged(region, surface, body, notes)


def _holes(surface: Reconstruction) -> tuple[str, ...]:
    """What is to be said of a surface with few points."""
    if len(surface.points) >= 500:
        return ()
    extent = 1e3 * np.ptp(surface.points, axis=0).max(initial=0.0) if len(surface.points) else 0.0
    return (
        f"the cloud has {len(surface.points)} points over {extent:.0f} mm: the object is small, or has little depth",
    )
