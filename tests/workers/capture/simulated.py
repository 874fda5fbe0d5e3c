"""Simulated captures, kept for the process because a photograph takes long: cans by their settings, and a box, processed."""

import functools
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from schemas.base import Array, Pose
from schemas.capture import (
    CaptureCamera,
    CapturedView,
    CaptureEstimate,
    CaptureTruth,
    DepthCorrection,
    Estimates,
    ViewEstimate,
)
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Board, Captures, Estimation, KinectDepthNoise, Simulate
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset
from tests.workers.capture.drawn import project
from workers.assets.builtin.make import make_asset
from workers.capture.board import marker_corners
from workers.capture.detect import refine_corners
from workers.capture.folder import CaptureFolder, open_folder
from workers.capture.process import ProcessedFolder, process_folder
from workers.capture.simulate.simulate import photograph, simulate_capture
from workers.capture.simulate.studio import Studio, build_studio, place_object, plan_path
from workers.capture.truth import read_truth
from workers.geometry.pixels import opencv_lens
from workers.scene.chance import SceneChance, Stream

KEPT = tempfile.TemporaryDirectory(prefix="verso-captures-")
VIEWS = 10
CAPTURES = Captures(estimation=Estimation(compare=True))


@dataclass(frozen=True, eq=False)
class Made:
    """A capture on disk and its truth."""

    folder: CaptureFolder
    truth: CaptureTruth


def asset_of(category: str = "can", number: int = 3) -> Asset:
    return make_asset(category, ProceduralSource(source="procedural"), number, 600.0)


def made(seed=11, **settings) -> Made:
    """A capture of a can by its seed and settings."""
    return _made(Simulate(**settings).model_dump_json(), seed)


@functools.cache
def _made(settings: str, seed: int) -> Made:
    path = Path(tempfile.mkdtemp(dir=KEPT.name))
    truth = simulate_capture(Simulate.model_validate_json(settings), Board(), asset_of(), SceneChance(seed, 0), path)
    return Made(open_folder(path), truth)


def studio_of(simulate: Simulate, board: Board | None = None, seed: int = 11) -> tuple[Studio, Placed, Array]:
    """(a can on a board and what photographs it, the can in the board frame, the path's poses)."""
    chance, asset = SceneChance(seed, 0), asset_of()
    thing = Placed(REGION_FIRST_OBJECT, asset.shape, place_object(asset, chance.stream(Stream.START)))
    poses = plan_path(simulate, thing.T_world_shape[:3, 3], chance.stream(Stream.CAMERA))
    return build_studio(simulate, board or Board(), thing, chance), thing, poses


def take_one(seed=11, **settings) -> tuple[CapturedView, CaptureCamera, Pose]:
    """(view, camera, T_board_cam): the first photograph of a can, without a folder."""
    return _taken(Simulate(**settings).model_dump_json(), seed)


@functools.cache
def _taken(settings: str, seed: int) -> tuple[CapturedView, CaptureCamera, Pose]:
    simulate = Simulate.model_validate_json(settings)
    studio, _, (T_board_cam, *_) = studio_of(simulate, seed=seed)
    view, _ = photograph(studio, 0, T_board_cam)
    return view, CaptureCamera(studio.rig.color, opencv_lens(simulate.distortion)), T_board_cam


def corner_errors(view, camera, T, board=None):
    """(errors [N, 2] px of corners along straight edges against OpenCV's projection, their outward parts [N]).

    The edges are found in linear light; what a drawn square leaves is held by a test of its own. Hidden squares are left out.
    """
    return corner_errors_at(view, camera, project(marker_corners(board or Board()).reshape(-1, 3), T, camera))


def corner_errors_at(view, camera, places):
    """The same, of corners [N, 2] that lie at places of their own."""
    true = places.reshape(-1, 4, 2) - 0.5
    inside = ((true > 8) & (true < [camera.intrinsics.width - 8, camera.intrinsics.height - 8])).all(axis=(1, 2))
    true = true[inside]
    found = refine_corners(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), true, 6)
    seen = ((found != true).any(axis=2) & (np.abs(found - true).max(axis=2) < 0.5)).all(axis=1)
    errors, away = (found - true)[seen], true[seen] - true[seen].mean(axis=1, keepdims=True)
    outwards = (errors * away).sum(axis=2) / np.linalg.norm(away, axis=2)
    return errors.reshape(-1, 2), outwards.ravel()


@functools.cache
def box() -> Path:
    """A box with the preset's depth noise, at about a third of the resolution. Copy it before it is changed."""
    path = Path(KEPT.name) / "box"
    settings = Simulate(views=VIEWS, image_scale=0.35, depth_noise=KinectDepthNoise())
    simulate_capture(settings, Board(), asset_of("box", 1), SceneChance(11, 1), path)
    return path


@functools.cache
def processed() -> tuple[Path, ProcessedFolder]:
    """The same after processing."""
    path = Path(shutil.copytree(box(), Path(KEPT.name) / "processed"))
    return path, process_folder(path, CAPTURES)


def copy_of(path: Path, to: Path) -> Path:
    return Path(shutil.copytree(path, to / "capture"))


def true_estimates(path: Path, without: tuple[int, ...] = ()) -> Estimates:
    """Estimates that are the truth, with the preset's systematic error of depth corrected."""
    truth, folder = read_truth(path), open_folder(path)
    assert truth is not None
    depth = DepthCorrection(offset_m=-0.0015, scale=1 / 1.001, identified=("offset_m", "scale"))
    views = tuple(
        ViewEstimate(n, "refused", None, None, 0, None, None, ("left out by the test",))
        if n in without
        else ViewEstimate(n, "used", truth.T_board_cam[n], None, 35, 0.2, 1.0)
        for n in folder.numbers
    )
    markers, joint = CaptureEstimate("markers", views), CaptureEstimate("joint", views, depth)
    return Estimates("joint", {"markers": markers, "joint": joint})
