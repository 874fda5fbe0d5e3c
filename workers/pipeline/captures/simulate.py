"""One virtual capture from its settings to its folder: the list of steps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture.view import CaptureCamera, CapturedView, CaptureTruth
from schemas.errors import CaptureError
from schemas.job.captures import Board, Simulate
from schemas.job.render import Render
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera
from schemas.scene.effects import EffectPlan
from schemas.scene.region import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE
from schemas.scene.scene import Placed
from schemas.scene.shape import Asset
from workers.assets.appearance.draw import draw_appearance
from workers.assets.glb import asset_glb
from workers.capture.simulate.board_body import THICKNESS_M, board_body
from workers.capture.simulate.effects import plan_effects
from workers.capture.simulate.path import plan_path
from workers.capture.simulate.place import place_object, true_board
from workers.capture.simulate.rig import Rig, make_rig
from workers.capture.simulate.sampling import LIGHT_OF, add_light, make_samples, shift_camera
from workers.geometry.frames import translation
from workers.geometry.registration import register_depth
from workers.geometry.srgb import encode_codes
from workers.plan.randomness import SceneChance, Stream
from workers.render.raster.gbuffer import Renderer, shared_renderer
from workers.render.step import draw_view
from workers.store.capture_folder import CaptureFile, write_description, write_view
from workers.store.capture_truth import TrueObject, write_true_mask, write_truth

DEPTH_UNITS_PER_M = 1000.0
DEPTH_ONLY = EffectPlan(("floor", "table"), {})


@dataclass(frozen=True, eq=False)
class Studio:
    """What is photographed and by what; everything stands on the floor of the world, z up.

    T_world_board [4, 4]: the board frame lies on top of the board.
    """

    things: tuple[Placed, ...]
    appearance: Appearance
    rig: Rig
    T_world_board: Pose
    render: Render
    effects: EffectPlan
    chance: SceneChance


def simulate_capture(simulate: Simulate, board: Board, asset: Asset, chance: SceneChance, path: Path) -> CaptureTruth:
    """Photograph `asset` on the board and write the folder of a capture, with truth/, to `path`, a new or empty folder.

    `chance` decides all that is random: the same arguments write the same bytes. camera.json is written last, so that a
    capture that was cut off cannot be mistaken for a whole one. Raises CaptureError where the folder has files.
    """
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise CaptureError("exists", f"{path} holds files already: name a new or an empty folder")
    effects = plan_effects(simulate)
    T_board_obj = place_object(asset, chance.stream(Stream.START))
    studio = build_studio(simulate, board, asset, T_board_obj, effects, chance)
    target = T_board_obj[:3, 3]
    poses = plan_path(simulate, target, chance.stream(Stream.CAMERA))
    for number, T_board_cam in enumerate(poses):
        view, mask = photograph(studio, number, T_board_cam)
        write_view(path, view)
        write_true_mask(path, number, mask)
    truth = CaptureTruth(
        T_board_cam=frozen_array(poses),
        T_board_obj=T_board_obj,
        print_scale=1.0 if simulate.print_scale is None else simulate.print_scale,
        T_color_depth=studio.rig.depth.T_color_depth,
        depth_bias_m=0.0 if simulate.depth_noise is None else simulate.depth_noise.bias_m,
        lens=simulate.distortion,
    )
    write_truth(
        path, truth, TrueObject(asset.category, asset.instance_id, asset_glb(asset)), effects.ran, effects.skipped
    )
    about = CaptureFile(name=f"{asset.category}-{chance.scene_id:05d}", category=asset.category, licence=asset.licence)
    write_description(path, about, CaptureCamera(studio.rig.color, np.zeros(8), DEPTH_UNITS_PER_M), board)
    return truth


def build_studio(
    simulate: Simulate, board: Board, asset: Asset, T_board_obj: Pose, effects: EffectPlan, chance: SceneChance
) -> Studio:
    """The floor, the board on it, and the object on the board, in their light."""
    floor, appearance = draw_appearance(chance.stream(Stream.APPEARANCE), "raster")
    T_world_board = frozen_array(translation(0.0, 0.0, THICKNESS_M))
    things = (
        Placed(REGION_FLOOR, floor, frozen_array(np.eye(4))),
        Placed(REGION_TABLE, board_body(true_board(board, simulate)), T_world_board),
        Placed(REGION_FIRST_OBJECT, asset.shape, frozen_array(T_world_board @ T_board_obj)),
    )
    render = Render(tier=simulate.tier)
    return Studio(things, appearance, make_rig(simulate.image_scale), T_world_board, render, effects, chance)


def photograph(studio: Studio, number: int, T_board_cam: Pose) -> tuple[CapturedView, NDArray[np.bool_]]:
    """One view as it is stored, and the object's true pixels [H, W] bool."""
    renderer = shared_renderer()
    T_world_cam = studio.T_world_board @ T_board_cam
    light, mask = expose(renderer, studio, number, T_world_cam)
    depth_m = measure_depth(renderer, studio, number, T_world_cam)
    depth = np.rint(np.clip(depth_m * DEPTH_UNITS_PER_M, 0.0, 65_535.0)).astype(np.uint16)
    return CapturedView(number, encode_codes(light), depth, None), mask


def expose(
    renderer: Renderer, studio: Studio, number: int, T_world_cam: Pose
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(linear light [H, W, 3], the object's pixels [H, W] bool at pixel centres) of one photograph."""
    k = studio.rig.color
    total, mask = np.zeros((k.height, k.width, 3), np.float32), np.zeros((k.height, k.width), np.bool_)
    rng = studio.chance.stream(Stream.PATHS, number)
    for sample in make_samples():
        camera = Camera(shift_camera(k, sample), T_world_cam)
        drawn = draw_view(renderer, studio.things, studio.appearance, camera, studio.render, rng, studio.effects)
        assert drawn.rgb is not None
        add_light(total, drawn.rgb, LIGHT_OF)
        if sample.right_px == 0.0:
            mask = drawn.region == REGION_FIRST_OBJECT
    return total, mask


def measure_depth(renderer: Renderer, studio: Studio, number: int, T_world_cam: Pose) -> Array:
    """[H, W] float64, metres: depth from the depth camera's place, registered to the colour camera."""
    device = studio.rig.depth
    camera = Camera(device.intrinsics, T_world_cam @ device.T_color_depth)
    drawn = renderer.draw(studio.things, studio.appearance, camera, studio.render, DEPTH_ONLY)
    return register_depth(drawn.depth_m.astype(np.float64), device, studio.rig.color)
