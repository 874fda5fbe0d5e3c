"""Simulated captures for tests: one function, kept for the process, because a photograph takes a second at full size."""

import functools
import tempfile
from dataclasses import dataclass
from pathlib import Path

from schemas.capture import CaptureCamera, CaptureTruth
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Board, Simulate
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT
from workers.assets.builtin.make import make_asset
from workers.capture.folder import CaptureFolder, open_folder
from workers.capture.simulate.camera import opencv_lens
from workers.capture.simulate.photograph import build_studio, photograph, place_object
from workers.capture.simulate.simulate import plan_path, simulate_capture
from workers.scene.effects import plan_capture
from workers.scene.plan import SceneChance, Stream

KEPT = tempfile.TemporaryDirectory(prefix="verso-captures-")


@dataclass(frozen=True, eq=False)
class Made:
    """A capture on disk and its truth."""

    folder: CaptureFolder
    truth: CaptureTruth


def asset_of(category="can"):
    return make_asset(category, ProceduralSource(source="procedural"), 3, 600.0)


def made(seed=11, without=(), **settings):
    """A capture of a can by its seed and settings; effects `without` are asked for and withdrawn from the plan."""
    return _made(Simulate(**settings).model_dump_json(), seed, tuple(without))


@functools.cache
def _made(settings, seed, without):
    simulate = Simulate.model_validate_json(settings)
    path = Path(tempfile.mkdtemp(dir=KEPT.name))
    plan = plan_capture(simulate).without(*without)
    truth = simulate_capture(simulate, Board(), asset_of(), SceneChance(seed, 0), path, plan)
    return Made(open_folder(path), truth)


def take_one(seed=11, **settings):
    """(view, camera, T_board_cam): the first photograph of a can, without a folder."""
    return _taken(Simulate(**settings).model_dump_json(), seed)


@functools.cache
def _taken(settings, seed):
    simulate, chance, asset = Simulate.model_validate_json(settings), SceneChance(seed, 0), asset_of()
    thing = Placed(REGION_FIRST_OBJECT, asset.shape, place_object(asset, chance.stream(Stream.START)))
    studio = build_studio(simulate, Board(), thing, plan_capture(simulate), chance)
    (T_board_cam, *_) = plan_path(simulate, thing.T_world_shape[:3, 3], chance.stream(Stream.CAMERA))
    view, _ = photograph(studio, 0, T_board_cam)
    return view, CaptureCamera(studio.rig.color, opencv_lens(simulate.distortion)), T_board_cam
