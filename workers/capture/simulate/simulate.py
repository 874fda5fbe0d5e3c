"""A virtual capture from its settings to its folder: the plan of effects, the camera's path, photographs, held-out views.

The plan is of the same kind as that of scenes (workers/scene/effects.py). What it does not run is off.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.base import Array, frozen_array
from schemas.capture import CaptureCamera, CapturedView, CaptureTruth
from schemas.errors import CaptureError
from schemas.job.captures import Board, Simulate
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset
from schemas.scene.view import Camera
from workers.assets.catalogue import Catalogue, load_asset
from workers.assets.glb import asset_glb
from workers.capture.folder import (
    HELD_OUT,
    TRUTH,
    CaptureFile,
    TrueObject,
    write_description,
    write_pose,
    write_true_mask,
    write_truth,
    write_view,
)
from workers.capture.simulate.photograph import (
    DEPTH_UNITS_PER_M,
    Studio,
    build_studio,
    draw_labels,
    photograph,
    place_object,
    take_light,
)
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import encode_codes
from workers.geometry.frames import pose, rotation_about
from workers.geometry.pixels import opencv_lens
from workers.scene.chance import SceneChance, Stream
from workers.scene.effects import CAPTURE_EFFECTS, plan_capture
from workers.scene.plan import choose_assets


def planned_settings(simulate: Simulate, plan: EffectPlan) -> Simulate:
    """The settings of those effects that the plan runs: every other one is off."""
    return simulate.model_copy(update=dict.fromkeys(name for name in CAPTURE_EFFECTS if not plan.runs(name)))


VIEWS_PER_TURN = 14
"""A turn around the object at one height has about as many views, and a path has at most `MOST_TURNS`."""

MOST_TURNS = 3

ROLL_DEG = 12.0
"""Standard deviation of the roll of the hand-held camera."""

AIM_M = 0.02
"""Standard deviation of the point that the camera looks at about the object's middle."""

JITTER = 0.25
"""Share of an irregular step from view to view in what otherwise changes smoothly."""

OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


def plan_path(simulate: Simulate, target: Array, rng: np.random.Generator) -> Array:
    """[V, 4, 4] float64: poses in the frame of `target` [3], whose z points up, optical frame.

    The camera goes around the target up to three times, higher each time, looks at it and rolls. Its distance and its
    inclination stay within the intervals of `simulate`; the roll is normal.
    """
    views = simulate.views
    turns = min(max(round(views / VIEWS_PER_TURN), 1), MOST_TURNS)
    time = (np.arange(views) + 0.5) / views
    yaw0, way = rng.uniform(-math.pi, math.pi), rng.choice([-1.0, 1.0])
    step = 2.0 * math.pi * turns / views
    yaw = yaw0 + way * (2.0 * math.pi * turns * time + JITTER * step * rng.uniform(-1.0, 1.0, views))
    level = (_climb(time, turns) + 0.5 * _sway(time, rng)) / turns
    inclination = _within(simulate.inclination_rad, level)
    distance = _within(simulate.distance_m, 0.5 + 0.5 * _sway(time, rng))
    roll = np.radians(ROLL_DEG) * _normal_sway(time, rng)
    aim = target + AIM_M * rng.standard_normal((views, 3))
    rolls = [pose(rotation_about(OPTICAL_AXIS, float(angle)), np.zeros(3)) for angle in roll]
    return np.stack([orbit_pose(aim[n], inclination[n], yaw[n], distance[n]) @ rolls[n] for n in range(views)])


def _within(interval: tuple[float, float], share: Array) -> Array:
    """Values at shares of an interval; shares are clipped to [0, 1]."""
    low, high = interval
    return low + (high - low) * np.clip(share, 0.0, 1.0)


def _climb(time: Array, turns: int) -> Array:
    """0.5 on the first turn, 1.5 on the second, ..., rising smoothly in the last third of each but the last."""
    at = time * turns
    turn = np.minimum(np.floor(at), turns - 1)
    late = np.clip(3.0 * (at - turn) - 2.0, 0.0, 1.0)
    rise = late * late * (3.0 - 2.0 * late)
    return turn + 0.5 + np.where(turn < turns - 1, rise, 0.0)


def _sway(time: Array, rng: np.random.Generator) -> Array:
    """Within [-1, 1]: a smooth swaying and a little irregular jitter."""
    cycles, phase = rng.uniform(1.0, 5.0, 3), rng.uniform(0.0, 2.0 * math.pi, 3)
    smooth = np.sin(2.0 * math.pi * cycles * time[:, None] + phase).mean(axis=1)
    return (1.0 - JITTER) * smooth + JITTER * rng.uniform(-1.0, 1.0, len(time))


def _normal_sway(time: Array, rng: np.random.Generator) -> Array:
    """Standard normal at each moment; neighbours are alike, because a hand turns back slowly."""
    keep = 0.7
    drawn = rng.standard_normal(len(time))
    value = np.empty(len(time))
    for n in range(len(time)):
        value[n] = drawn[n] if n == 0 else keep * value[n - 1] + math.sqrt(1.0 - keep * keep) * drawn[n]
    return value


VIEWS = 3

HELD_OUT_UNITS_PER_M = 10_000.0
"""Finer than a capture's, so that rounding is no part of an error: 0.1 mm, up to 6.5 m."""


def write_held_out(studio: Studio, board: Board, target: Array, path: Path) -> None:
    """Write `VIEWS` exact views to `path`, a new folder of the same layout as a capture.

    Their poses are drawn as those of a path around `target` [3], board frame, and stand in board_00000.txt. They are pictures
    of the same things without the effects of any sensor or lens: depth and mask are those of the pixel centres.
    """
    path.mkdir(parents=True)
    ideal = studio.simulate.model_copy(update={"views": VIEWS} | dict.fromkeys(CAPTURE_EFFECTS))
    exact = replace(studio, simulate=ideal, drawn_color=studio.rig.color, lookup=None)
    for number, T_board_cam in enumerate(plan_path(ideal, target, studio.chance.stream(Stream.HELD_OUT))):
        T_world_cam = studio.T_world_board @ T_board_cam
        depth_m, mask = draw_labels(exact, Camera(studio.rig.color, T_world_cam))
        depth = np.rint(np.clip(depth_m * HELD_OUT_UNITS_PER_M, 0.0, 65_535.0)).astype(np.uint16)
        depth[depth == 65_535] = 0
        rgb = encode_codes(take_light(exact, number, T_world_cam))
        write_view(path, CapturedView(number, rgb, depth, mask))
        write_pose(path / f"board_{number:05d}.txt", T_board_cam)
    camera = CaptureCamera(studio.rig.color, opencv_lens(None), HELD_OUT_UNITS_PER_M)
    write_description(path, CaptureFile(name="held-out"), camera, board)


def load_object(job: Job, catalogue: Catalogue, chance: SceneChance) -> Asset:
    """The object of a capture, chosen as the first object of a scene is. Raises MeshError where its mesh is refused."""
    (ref, *_), _ = choose_assets(job, catalogue, chance)
    return load_asset(catalogue, ref)


def simulate_capture(
    simulate: Simulate, board: Board, asset: Asset, chance: SceneChance, path: Path, effects: EffectPlan | None = None
) -> CaptureTruth:
    """Photograph `asset` on the board and write the folder of a capture, with truth/, to `path`, a new or empty folder.

    `chance` decides all that is random: the same arguments write the same bytes. `effects` is the plan for these settings
    unless given. camera.json comes last, so that a capture that was cut off cannot be mistaken for a whole one. Raises
    CaptureError where the folder has files or the lens cannot be.
    """
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise CaptureError("exists", f"{path} holds files already: name a new or an empty folder")
    plan = plan_capture(simulate) if effects is None else effects
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
    about = CaptureFile(name=f"{asset.category}-{chance.scene_id:05d}", category=asset.category, licence=asset.licence)
    camera = CaptureCamera(studio.rig.color, opencv_lens(simulate.distortion), DEPTH_UNITS_PER_M)
    write_description(path, about, camera, board)
    return truth
