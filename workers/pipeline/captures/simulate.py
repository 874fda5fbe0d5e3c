"""One virtual capture from its settings to its folder: the list of steps."""

from pathlib import Path

from schemas.base import frozen_array
from schemas.capture.view import CaptureCamera, CaptureTruth
from schemas.errors import CaptureError
from schemas.job.captures import Board, Simulate
from schemas.job.job import Job
from schemas.scene.effects import EffectPlan
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import Placed
from schemas.scene.shape import Asset
from workers.assets.catalogue import Catalogue, load_asset
from workers.assets.glb import asset_glb
from workers.capture.simulate.effects import plan_effects, planned_settings
from workers.capture.simulate.lens import opencv_lens
from workers.capture.simulate.path import plan_path
from workers.capture.simulate.place import place_object
from workers.pipeline.captures.held_out import write_held_out
from workers.pipeline.captures.photograph import DEPTH_UNITS_PER_M, Studio, build_studio, photograph
from workers.plan.randomness import SceneChance, Stream
from workers.plan.step import choose_assets
from workers.store.capture_folder import TRUTH, CaptureFile, write_description, write_view
from workers.store.capture_truth import HELD_OUT, TrueObject, write_true_mask, write_truth


def load_object(job: Job, catalogue: Catalogue, chance: SceneChance) -> Asset:
    """The object of a capture, chosen as the first object of a scene is. Raises MeshError where its mesh is refused."""
    (ref, *_), _ = choose_assets(job, catalogue, chance)
    return load_asset(catalogue, ref)


def simulate_capture(
    simulate: Simulate,
    board: Board,
    asset: Asset,
    chance: SceneChance,
    path: Path,
    effects: EffectPlan | None = None,
) -> CaptureTruth:
    """Photograph `asset` on the board and write the folder of a capture, with truth/, to `path`, a new or empty folder.

    `chance` decides all that is random: the same arguments write the same bytes. `effects` is the plan for these settings
    unless given. camera.json comes last, so that a capture that was cut off cannot be mistaken for a whole one. Raises
    CaptureError where the folder has files or the lens cannot be.
    """
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise CaptureError("exists", f"{path} holds files already: name a new or an empty folder")
    plan = plan_effects(simulate) if effects is None else effects
    simulate = planned_settings(simulate, plan)
    thing = Placed(REGION_FIRST_OBJECT, asset.shape, place_object(asset, chance.stream(Stream.START)))
    studio = build_studio(simulate, board, thing, plan, chance)
    target = thing.T_world_shape[:3, 3]
    poses = plan_path(simulate, target, chance.stream(Stream.CAMERA))
    for number, T_board_cam in enumerate(poses):
        view, mask = photograph(studio, number, T_board_cam)
        write_view(path, view)
        write_true_mask(path, number, mask)
    truth = CaptureTruth(
        T_board_cam=frozen_array(poses),
        T_board_obj=thing.T_world_shape,
        print_scale=1.0 if simulate.print_scale is None else simulate.print_scale,
        T_color_depth=studio.rig.depth.T_color_depth,
        depth_bias_m=0.0 if simulate.depth_noise is None else simulate.depth_noise.bias_m,
        lens=simulate.distortion,
    )
    write_held_out(studio, board, target, path / TRUTH / HELD_OUT)
    write_truth(path, truth, TrueObject(asset.category, asset.instance_id, asset_glb(asset)), plan.ran, plan.skipped)
    _describe(studio, board, asset, path)
    return truth


def _describe(studio: Studio, board: Board, asset: Asset, path: Path) -> None:
    """Write camera.json, board.json and capture.json."""
    name = f"{asset.category}-{studio.chance.scene_id:05d}"
    about = CaptureFile(name=name, category=asset.category, licence=asset.licence)
    camera = CaptureCamera(studio.rig.color, opencv_lens(studio.simulate.distortion), DEPTH_UNITS_PER_M)
    write_description(path, about, camera, board)
