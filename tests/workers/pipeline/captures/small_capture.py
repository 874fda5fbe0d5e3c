"""A small virtual capture, made and processed once for all tests of a process."""

import functools
import shutil
import tempfile
from pathlib import Path

from schemas.capture import CaptureEstimate, DepthCorrection, Estimates, ViewEstimate
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Board, Captures, Estimation, KinectDepthNoise, Simulate
from workers.assets.builtin.make import make_asset
from workers.capture.folder import open_folder, read_truth
from workers.capture.process import ProcessedFolder, process_folder
from workers.capture.simulate.simulate import simulate_capture
from workers.scene.plan import SceneChance

VIEWS = 10
CAPTURES = Captures(estimation=Estimation(compare=True))
_kept = tempfile.TemporaryDirectory(prefix="verso-small-capture-")


@functools.cache
def made() -> Path:
    """A box with the preset's depth noise, at about a third of the resolution. Copy it before it is changed."""
    path = Path(_kept.name) / "made"
    asset = make_asset("box", ProceduralSource(source="procedural"), 1, 600.0)
    settings = Simulate(views=VIEWS, image_scale=0.35, depth_noise=KinectDepthNoise())
    simulate_capture(settings, Board(), asset, SceneChance(11, 1), path)
    return path


@functools.cache
def processed() -> tuple[Path, ProcessedFolder]:
    """The same after processing."""
    path = Path(_kept.name) / "processed"
    shutil.copytree(made(), path)
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
    return Estimates("joint", {"markers": markers, "joint": joint}, ())
