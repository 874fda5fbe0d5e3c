"""One pair of a capture: a captured view as it is stored, and its view from the other side."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.capture.estimate import SynthesizedView
from schemas.capture.processed import PosedImages
from schemas.dataset.layout import file_pose_id, input_pose_id
from schemas.job.captures import Board
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_NOTHING, REGION_TABLE, Asset
from schemas.scene.view import Camera, ObjectLabel, Pair, Role, View
from workers.geometry.pixels import quantise_depth
from workers.labels.board_regions import capture_regions
from workers.scene.labels import CountPixels, derive_projected, label_things, projection_shares
from workers.scene.pairs import object_distance, place_mirror_camera

Synthesize = Callable[[Camera], SynthesizedView]


@dataclass(frozen=True, eq=False)
class CapturedObject:
    """The object of a capture on its board, in the board frame, which is the world of a capture.

    `effects` of the dataset's images that the job asks for.
    """

    scene_id: int
    asset: Asset
    T_world_obj: Pose
    board: Board
    board_asset: Asset
    effects: EffectPlan

    @property
    def things(self) -> tuple[Placed, Placed]:
        """Board and object where they are."""
        eye = np.eye(4)
        return (
            Placed(REGION_TABLE, self.board_asset.shape, eye),
            Placed(REGION_FIRST_OBJECT, self.asset.shape, self.T_world_obj),
        )


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """A pair as scenes have it; the number of its captured view, and its mirror view as it was made."""

    number: int
    pair: Pair
    mirror: SynthesizedView | None


def make_capture_pair(
    job: Job, thing: CapturedObject, images: PosedImages, at: int, synthesize: Synthesize, count: CountPixels
) -> CapturedPair:
    """The views of captured view `at` (its place among the used ones) that the job asks for.

    The mirror camera follows from the stored input depth as in scenes. Raises ViewError where the view has no depth of
    the object, CaptureError where no captured view shows anything to the mirror camera.
    """
    parent_id = input_pose_id(thing.scene_id, at, job.pairs_per_scene)

    def view(role: Role, camera: Camera, made: PosedImages | SynthesizedView) -> View:
        region, depth = capture_regions(camera, thing.board, made.mask), quantise_depth(made.depth_m, job.images)
        if role == "mirror":
            region[depth == 0] = REGION_NOTHING
        labels = _labels(thing, camera, region, count)
        return View(role, file_pose_id(role, parent_id), parent_id, camera, made.rgb, depth, region, labels)

    first = view("input", images.camera, images)
    assert first.region is not None
    pair = Pair(object_distance(first.depth, first.region, job.images, job.cameras.mirror), first, None)
    if not thing.effects.runs("mirror"):
        return CapturedPair(images.number, pair, None)
    camera = place_mirror_camera(images.camera, pair.d_z_m, job.cameras.mirror)
    made = synthesize(camera)
    mirror = view("mirror", camera, made)
    # No agreement: which pixels are co-visible follows from normals, which the noise of measured depth turns about.
    pair = replace(pair, mirror=mirror)
    if thing.effects.runs("projection"):
        rgb, depth = derive_projected(first, camera, job.images, None, thing.effects)
        filled, hidden = projection_shares(depth, mirror.depth, job.images)
        projected = View("projected", first.pose_id, first.pose_id, camera, rgb, depth, None, ())
        pair = replace(pair, projected=projected, filled_share=filled, hidden_share=hidden)
    return CapturedPair(images.number, pair, made)


def _labels(
    thing: CapturedObject, camera: Camera, region: NDArray[np.uint8], count: CountPixels
) -> tuple[ObjectLabel, ...]:
    """Labels of board and object in a mask."""
    assets = (thing.board_asset, thing.asset)
    names = {
        placed.region_id: (asset.category, asset.instance_id)
        for placed, asset in zip(thing.things, assets, strict=True)
    }
    return label_things(thing.things, names, camera, region, count)
