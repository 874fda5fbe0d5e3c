"""The views of a processed capture: captured ones without their lens, and ones from elsewhere."""

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.capture import CaptureEstimate, PosedImages, SynthesizedView
from schemas.job.captures import Captures
from schemas.job.views import Mirror
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import CaptureFolder
from workers.capture.reconstruct import Given, read_posed
from workers.capture.surface.object_mask import silhouette
from workers.capture.surface.posed_view import PosedView
from workers.capture.surface.synthesize import choose_sources, synthesize_view
from workers.capture.surface.tsdf import fit_depth
from workers.capture.surface.warp import Source, move_depth, prepare_source
from workers.scene.pairs import front_distance, place_mirror_camera

KEPT = 12
"""Prepared views in memory, 40 MB each at 1920 x 1080: twice as many as one synthesised view needs."""


@dataclass(eq=False)
class CaptureViews:
    """Reads and prepares views when they are needed, and keeps the latest. `body` is the object down to the board."""

    given: Given
    estimate: CaptureEstimate
    captures: Captures
    body: Mesh
    _sources: OrderedDict[int, Source] = field(default_factory=OrderedDict)

    def __post_init__(self) -> None:
        self.cameras = {
            view.number: view.T_board_cam @ self.estimate.depth.T_cam_depth
            for view in self.estimate.used
            if view.T_board_cam is not None and (self.folder.path / f"depth_{view.number:05d}.png").exists()
        }
        """T_board_depth [4, 4] of the views that can be sources."""

    @property
    def folder(self) -> CaptureFolder:
        """Where the views are."""
        return self.given.folder

    def posed(self, number: int) -> PosedView:
        """A used view, read anew. Raises CaptureError."""
        return read_posed(self.given, self.estimate, number)

    def images(self, number: int) -> PosedImages:
        """A captured view: its picture without the lens, its depth in the same camera, the object's mask.

        Depth is what was measured, corrected. Where the correction moves the depth camera, depth is drawn anew from there.
        """
        view = self.posed(number)
        mask = self.mask(view, view.camera)
        return PosedImages(number, view.camera, view.rgb, self._depth(view), mask)

    def synthesize(self, camera: Camera, without: int | None = None) -> SynthesizedView:
        """What `camera` sees, poses in the board frame; `without` names a view that must not be a source."""
        axes = {number: T[:3, 2] for number, T in self.cameras.items() if number != without}
        chosen = choose_sources(axes, camera, self.captures.synthesis)
        return synthesize_view([self._source(number) for number in chosen], camera, self.captures.synthesis)

    def mirror(self, number: int, mirror: Mirror | None = None) -> tuple[Camera, float, SynthesizedView]:
        """(camera, d_z in metres, view) from the other side of the object, half a turn about the board's normal.

        d_z comes from the object's own depth pixels. Raises ViewError where the view has none, CaptureError.
        """
        images = self.images(number)
        d_z = front_distance(images.depth_m, images.mask, mirror or Mirror())
        camera = place_mirror_camera(images.camera, d_z, mirror or Mirror())
        return camera, d_z, self.synthesize(camera)

    def mask(self, view: PosedView, camera: Camera) -> NDArray[np.bool_]:
        """[H, W] the object's pixels: the user's mask in the camera that it was given for, else the silhouette."""
        if view.mask is not None and camera is view.camera:
            return view.mask
        return silhouette(self.body, camera)

    def _depth(self, view: PosedView) -> Array:
        if np.array_equal(view.camera.T_world_cam, view.depth_camera.T_world_cam):
            return view.depth_m.astype(np.float64)
        return move_depth(view.depth_m, view.depth_camera, view.camera).astype(np.float64)

    def _source(self, number: int) -> Source:
        if number not in self._sources:
            view = self.posed(number)
            fitted = fit_depth(view.depth_m, view.depth_camera.intrinsics, self.captures.fusion.max_edge_deg)
            self._sources[number] = prepare_source(view, fitted, silhouette(self.body, view.depth_camera))
            while len(self._sources) > max(KEPT, 2 * self.captures.synthesis.views):
                self._sources.popitem(last=False)
        self._sources.move_to_end(number)
        return self._sources[number]
