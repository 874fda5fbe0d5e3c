"""Stand-ins for the processing of captures: exact poses, and images drawn from a built-in shape on a plain board.

What a dataset makes of a processed capture is then known: the mirror views are true, and so is every depth.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.base import frozen_array
from schemas.capture import (
    CaptureCamera,
    CapturedView,
    CaptureEstimate,
    CaptureScore,
    CaptureTruth,
    DepthCorrection,
    Estimates,
    PosedImages,
    ProcessedCapture,
    Reconstruction,
    SynthesizedView,
    ViewEstimate,
    ViewScore,
)
from schemas.job.assets import Assets, ProceduralSource
from schemas.job.captures import Board, Captures, Simulate
from schemas.job.job import Job
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_TABLE, Asset
from schemas.scene.view import Camera, Intrinsics
from services.job.job_file import validate_job
from tests.datasets import overlaid
from workers.assets.builtin.make import make_asset
from workers.assets.look.appearance import draw_appearance
from workers.capture import make_capture
from workers.capture.folder import CaptureFile, CaptureFolder, write_description, write_view
from workers.capture.make_capture import board_asset
from workers.capture.truth import write_truth
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import pose, rotation_about, translation
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.chance import SceneChance
from workers.stopwatch import Stopwatch

SMALL_CAPTURES: dict[str, Any] = {
    "name": "captures",
    "seed": 5,
    "scenes": 2,
    "categories": ["mug"],
    "images": {"patch": {"width": 32, "height": 24}},
    "pairs_per_scene": 4,
    "captures": {"simulate": {"views": 3}},
}
CAMERA = Intrinsics(width=192, height=108, fx=91.2, fy=91.2, cx=96.2, cy=54.8)
PLAIN = EffectPlan(("floor", "table", "rgb"), {})
RENDER = Render(tier="flat")


def captures_job(**changes: Any) -> Job:
    """A small job of captures with these changes."""
    return validate_job(overlaid(SMALL_CAPTURES, changes), "test")


def rolled_pose(number: int, views: int) -> np.ndarray:
    """[4, 4] of a hand-held camera: about the object, looking at it, rolled by some degrees."""
    T = orbit_pose(np.array([0.0, 0.0, 0.04]), 0.6 + 0.1 * number, 2.0 * np.pi * number / views + 0.3, 0.55)
    axes = T[:3, :3] @ rotation_about(np.array([0.0, 0.0, 1.0]), 0.2 * (-1) ** number)
    return frozen_array(pose(axes, T[:3, 3]))


def exact_capture(number: int = 0, views: int = 3, board: Board | None = None) -> ProcessedCapture:
    """A capture of mug `number` whose poses, images and mirror views are exact; its view 0 is flagged."""
    board = board or Board()
    settings = ProceduralSource(source="procedural")
    asset = make_asset("mug", settings, number, 1000.0)
    lowest = float(asset.shape.vertices[:, 2].min())
    T_board_obj = translation(0.01, -0.02, -lowest)
    things = (
        Placed(REGION_TABLE, board_asset(board, Assets()).shape, np.eye(4)),
        Placed(REGION_FIRST_OBJECT, asset.shape, T_board_obj),
    )
    _, appearance = draw_appearance(np.random.default_rng(number), "flat")

    def draw(camera: Camera):
        return shared_renderer().draw(things, appearance, camera, RENDER, PLAIN)

    def images(at: int) -> PosedImages:
        camera = Camera(CAMERA, rolled_pose(at, views))
        seen = draw(camera)
        return PosedImages(at, camera, seen.rgb, seen.depth_m.astype(np.float64), seen.region == REGION_FIRST_OBJECT)

    def synthesize(camera: Camera) -> SynthesizedView:
        seen = draw(camera)
        known = seen.depth_m > 0.0
        mask = seen.region == REGION_FIRST_OBJECT
        return SynthesizedView(seen.rgb, seen.depth_m.astype(np.float64), mask, known, 0.97, (1, 2))

    mesh = asset.shape.mesh
    vertices = mesh.vertices + T_board_obj[:3, 3]
    grey = np.full((len(vertices), 3), 120, np.uint8)
    surface = Reconstruction(
        vertices, np.zeros_like(vertices), grey, np.ones(len(vertices), np.int32), vertices, mesh.faces, grey
    )
    score = CaptureScore(0.2, 0.01, 0.4, 1.5, 0.98, 0.6, {1: ViewScore(0.1, 0.02, 0.5)})
    return ProcessedCapture(
        f"mug-{number}", "mug", "CC0-1.0", board, estimates(views), surface, images, synthesize, score=score
    )


def estimates(views: int) -> Estimates:
    """Two estimates with a flagged first view."""

    def one(name, px: float) -> CaptureEstimate:
        found = tuple(
            ViewEstimate(
                number=n,
                status="used" if n else "flagged",
                T_board_cam=rolled_pose(n, views),
                covariance=None,
                markers=30,
                reprojection_px=px + 0.01 * n,
                depth_mm=1.2,
                reasons=() if n else ("blurred: 9 px",),
            )
            for n in range(views)
        )
        return CaptureEstimate(name, found, DepthCorrection(0.002, 1.0, np.eye(4), ("offset_m",)), iterations=7)

    return Estimates("joint", {"markers": one("markers", 0.5), "joint": one("joint", 0.2)})


def use_exact_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces simulation and processing in this process: a capture named mug-n is `exact_capture(n)`."""

    def simulate(
        simulate: Simulate, board: Board, asset: Asset, chance: SceneChance, path: Path, around: object
    ) -> None:
        write_folder(path, f"mug-{chance.scene_id % 2}", board)

    def process(folder: CaptureFolder, captures: Captures, watch: Stopwatch) -> ProcessedCapture:
        return exact_capture(int(folder.about.name.rpartition("-")[2]), board=folder.board)

    monkeypatch.setattr(make_capture, "simulate_capture", simulate)
    monkeypatch.setattr(make_capture, "process_capture", process)


def write_folder(path: Path, name: str, board: Board | None = None, truth: bool = True) -> None:
    """The folder of a capture with one grey picture, and the receipt of a simulation."""
    path.mkdir(parents=True)
    about = CaptureFile(name=name, category="mug", licence="CC0-1.0")
    write_description(path, about, CaptureCamera(CAMERA, np.zeros(8)), board or Board())
    grey = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    write_view(path, CapturedView(0, grey, None, None))
    if truth:
        known = CaptureTruth(np.eye(4)[None], np.eye(4), 1.0, np.eye(4), 0.0, None)
        write_truth(
            path,
            known,
            make_asset("mug", ProceduralSource(source="procedural"), 0, 1000.0),
            EffectPlan(("depth_noise",), {"motion_blur": "is not asked for"}),
        )
