"""What captures come to against their truth: ten objects, 40 views of 1920 x 1080, the preset of the noise and twice that.

Half an hour of one core. `./verso test --all tests/workers/capture/test_accuracy.py --figures FILE` writes the figures.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from schemas.capture import Estimates
from schemas.job.captures import Board, Captures, Estimation, KinectDepthNoise, RegistrationError, Simulate
from schemas.job.views import RgbNoise
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset, Mesh
from tests.workers.capture.drawn import errors
from tests.workers.capture.simulated import asset_of, made
from workers.capture.folder import open_folder
from workers.capture.make_capture import process_capture
from workers.capture.poses.terms import motion_between
from workers.capture.process import CaptureViews
from workers.capture.reconstruct import estimate_poses, given_files, processor_clock
from workers.capture.score import read_whole_truth, score_measured
from workers.capture.simulate.simulate import DEPTH_UNITS_PER_M, measure_depth, simulate_capture
from workers.capture.simulate.studio import build_studio, place_object
from workers.capture.truth import read_truth
from workers.scene.chance import SceneChance, Stream
from workers.store.images import encode_png

NOISE = Simulate(views=40, depth_noise=KinectDepthNoise(), rgb_noise=RgbNoise())
OTHER_DEPTH = {
    "twice the noise": {"depth_noise": KinectDepthNoise(times=2.0)},
    "10 mm depth bias": {"depth_noise": KinectDepthNoise(bias_m=0.010)},
    "10 mm registration error": {"registration_error": RegistrationError()},
}
OBJECTS = [
    *(("bottle", 11), ("camera", 12), ("can", 13), ("jar", 14), ("laptop", 15)),
    *(("mug", 16), ("bowl", 17), ("box", 18), ("bottle", 19), ("mug", 20)),
]


def chance_of(number: int) -> SceneChance:
    return SceneChance(2026, number)


def with_other_depth(path: Path, simulate: Simulate, asset: Asset, number: int) -> Path:
    """The same capture, depth measured anew with other settings; its colour images do not depend on them."""
    other = path.with_name("other")
    shutil.rmtree(other, ignore_errors=True)
    shutil.copytree(path, other, copy_function=os.link)
    chance = chance_of(number)
    thing = Placed(REGION_FIRST_OBJECT, asset.shape, place_object(asset, chance.stream(Stream.START)))
    studio = build_studio(simulate, Board(), thing, chance)
    truth = read_truth(path)
    assert truth is not None
    for view, T_board_cam in enumerate(truth.T_board_cam):
        depth_m = measure_depth(studio, view, studio.T_world_board @ T_board_cam)
        file = other / f"depth_{view:05d}.png"
        file.unlink()
        file.write_bytes(encode_png(np.rint(np.clip(depth_m * DEPTH_UNITS_PER_M, 0, 65_535)).astype(np.uint16)))
    return other


def pose_errors(path: Path, estimates: Estimates) -> dict:
    """(millimetres, degrees, root mean square millimetres) over the used views, by estimate; the first two are medians."""
    truth = read_truth(path)
    assert truth is not None
    found = {}
    for name, one in estimates.by_name.items():
        used = [(view.T_board_cam, truth.T_board_cam[view.number]) for view in one.used if view.T_board_cam is not None]
        if not used:  # all of its views are flagged, as the article's are where the print is of another size
            continue
        off = np.array([errors(*pair) for pair in used])
        found[name] = (*np.median(off, axis=0).tolist(), float(np.sqrt(np.mean(off[:, 0] ** 2))))
    return found


def assess(path: Path, record, what: str) -> tuple[dict, list]:
    """Process and score a capture and record its figures: pose errors by estimate, and (name, figure, bound) of the missed."""
    clock = processor_clock()
    folder = open_folder(path)
    done = process_capture(folder, Captures(), clock)
    poses, score, truth = pose_errors(path, done.estimates), done.score, read_whole_truth(folder)
    assert score is not None and truth is not None
    mesh = Mesh(done.surface.vertices, done.surface.faces)
    views = CaptureViews(given_files(folder), Captures(), done.estimates.estimate, done.surface, mesh)
    unmeasured = 1.0 - score_measured(views, truth)[0]
    figures = {
        "joint_mm": (poses["joint"][0], 0.5),
        "joint_deg": (poses["joint"][1], 0.05),
        # Root mean squares: where both err by 0.02 mm, medians of 40 views differ by a fifth by chance.
        "joint_over_markers": (poses["joint"][2] / poses["markers"][2], 1.1),
        "cloud_median_mm": (score.cloud_median_mm, 1.0),
        "cloud_p95_mm": (score.cloud_p95_mm, 3.0),
        "unmeasured_share": (unmeasured, None),
        # Of an open bowl a twelfth is seen at such angles alone that no view has depth of it.
        "missing_share": (1.0 - (score.completeness or 0.0), 0.05 + unmeasured),
        "view_depth_median_mm": (score.depth_median_mm, 1.5),
        "processor_s": (sum(s for stage, s in clock.seconds.items() if stage != "score"), None),
    }
    missed = []
    for name, (figure, bound) in figures.items():
        fine = figure is not None and (bound is None or figure <= bound)
        record(f"{what}: {name}", "passed" if fine else "missed", figure, bound)
        missed += [] if fine else [(name, figure, bound)]
    return poses, missed


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("category", "number"), OBJECTS)
def test_a_capture_is_as_exact_as_promised(category, number, tmp_path, record_figure):
    asset, path = asset_of(category, number), tmp_path / "capture"
    simulate_capture(NOISE, Board(), asset, chance_of(number), path)
    _, missed = assess(path, record_figure, f"{category} {number}, the noise")
    for what, changes in OTHER_DEPTH.items():  # all of them are measured, also where one misses
        other = with_other_depth(path, NOISE.model_copy(update=changes), asset, number)
        if what == "twice the noise":
            missed += assess(other, record_figure, f"{category} {number}, {what}")[1]
            continue
        done = process_capture(open_folder(other), Captures(), processor_clock())
        poses = pose_errors(other, done.estimates)
        better = poses["article"][0] / poses["joint"][0]
        record_figure(f"{category} {number}, {what}: article over joint", "passed", better, 3.0)
        missed += [] if better >= 3.0 else [(what, better, 3.0)]
    assert not missed, missed


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_over_two_hundred_views_poses_err_by_as_much_as_their_sigma_says(record_figure):
    squares = []
    for seed in range(40, 50):
        capture = made(seed, views=20, image_scale=0.5, depth_noise=KinectDepthNoise(), rgb_noise=RgbNoise())
        found = estimate_poses(given_files(capture.folder), Estimation(compare=False)).estimate
        for view in found.used:
            off = motion_between(view.T_board_cam, capture.truth.T_board_cam[view.number])
            squares.append(off[:3] ** 2 / np.diag(view.covariance)[:3])
    ratio = float(np.sqrt(np.mean(squares)))
    record_figure(
        "rms of error over sigma, camera position", "passed" if 0.8 <= ratio <= 1.25 else "missed", ratio, 1.25
    )
    assert 0.8 <= ratio <= 1.25 and len(squares) >= 190


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("category", "number"), [("jar", 31), ("box", 32)])
def test_a_print_that_is_two_percent_too_large_is_told_or_measured_by_depth(category, number, tmp_path, record_figure):
    simulate = NOISE.model_copy(update={"print_scale": 1.02})
    simulate_capture(simulate, Board(), asset_of(category, number), chance_of(number), tmp_path / "capture")
    folder = open_folder(tmp_path / "capture")
    done = process_capture(folder, Captures(), processor_clock())
    assert any("ruler" in note for note in done.estimates.estimate.notes), done.estimates.estimate.notes
    trusting = Captures.model_validate({"estimation": {"trust": "depth"}})
    poses = pose_errors(folder.path, process_capture(folder, trusting, processor_clock()).estimates)
    better = poses["markers"][0] / poses["joint"][0]
    record_figure(
        f"{category} {number}, print 2 % too large: markers over joint that trusts depth", "passed", better, 3.0
    )
    assert better >= 3.0
