"""Cameras that nobody would choose: each scene is made whole or is a row that says why not, and nothing crashes.

Every scene runs through the shard's own path onto disk, and is held against the ray caster before it is committed.
"""

from pathlib import Path

import numpy as np
import pytest

from schemas.dataset.layout import FINGERPRINT_FILE, IMAGES, commit_path
from schemas.errors import MachineError
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import MODALITIES
from services.job.job_file import validate_job
from tests.workers.shard import shards
from workers.render.raster.gbuffer import shared_renderer
from workers.store.commit import committed_files, read_record
from workers.store.images import decode_png
from workers.store.local import LocalStore

ARTICLE = [image for image in IMAGES if MODALITIES[image.pixels].target is None]
"""The images that a job without targets has."""
IN_THE_MIDDLE = {"offset_m": [0.0, 0.0], "pose": "placed"}
EVERY_EFFECT = {"depth_noise": {}, "distortion": {"k1": -0.1}, "rgb_noise": {}, "exposure": {}}
HARD_TO_DERIVE = {"projection": {"splat": 15, "hidden_point_removal": True}}


def job_of(width: int, height: int, focal: float, **changes):
    """A job whose sensor looks along the middle of its image."""
    sensor = {"width": width, "height": height, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
    cameras = {"sensor": sensor, **changes.pop("cameras", {})}
    tree = {"name": "extreme", "seed": 5, "cameras": cameras, "check": {"raycast_share": 1.0}, **changes}
    return validate_job(tree, "test")


def run(job, out: Path, scenes: int = 2):
    """(scenes made, failures by reason, the store) of a shard of one range."""
    (span,) = shards.run(job, out, (0, scenes)).spans
    assert span.made + sum(span.failed.values()) == scenes
    return span.made, span.failed, LocalStore(out)


def images_of(store: LocalStore) -> dict[str, np.ndarray]:
    """Every image of the range, read back."""
    record = read_record(store, 0)
    assert record is not None
    paths = [entry.path for entry in committed_files(store, record) if entry.path.endswith(".png")]
    return {path: decode_png(store.read(path), path) for path in paths}


@pytest.mark.minute
def test_images_of_one_pixel_or_without_an_inside_are_made_whole(tmp_path):
    hard = {"sensor": EVERY_EFFECT, "images": HARD_TO_DERIVE}
    sizes = ((2, 2), (3, 1), (1, 3), (2, 640), (4096, 1))
    cases = [(1, 1, 525.0, {"render": {"samples": 4}, **changes}) for changes in ({}, hard)]
    cases += [(width, height, 60.0, hard) for width, height in sizes]
    for number, (width, height, focal, changes) in enumerate(cases):
        job = job_of(width, height, focal, start=IN_THE_MIDDLE, **changes)
        made, failed, store = run(job, tmp_path / str(number), scenes=4)
        assert made > 0 and set(failed) <= {"intrinsic: object_not_seen"}, (width, height)
        images = images_of(store)
        assert {image.shape[:2] for image in images.values()} == {(height, width)}
        assert len(images) == made * len(ARTICLE), "and no patch, which would be larger than the image"


@pytest.mark.minute
def test_a_sensor_that_sees_half_the_world_in_a_pixel_says_that_it_sees_no_object(tmp_path):
    for n, focal in enumerate((0.001, 0.5)):
        made, failed, _ = run(job_of(64, 48, focal), tmp_path / str(n))
        assert (made, failed) == (0, {"intrinsic: object_not_seen": 2})


@pytest.mark.minute
def test_a_sensor_that_sees_micrometres_makes_scenes_or_says_what_disagrees(tmp_path):
    made, failed, store = run(job_of(64, 48, 1e6, start=IN_THE_MIDDLE), tmp_path, scenes=4)
    assert set(failed) <= {f"intrinsic: {reason}" for reason in ("views_disagree", "object_not_seen")}
    assert made > 0
    paths = [path for path in images_of(store) if Path(path).name.startswith("segment") and "patch" not in path]
    assert paths and all(decode_png(store.read(path), path).min() >= REGION_FIRST_OBJECT for path in paths[:1])


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("changes", [{}, {"sensor": EVERY_EFFECT, "render": {"samples": 4}}])
def test_the_largest_image_is_made_whole(tmp_path, changes):
    job = job_of(4096, 4096, 3360.0, check={"raycast_share": 0.0}, run={"scene_timeout_s": 1000.0}, **changes)
    made, failed, store = run(job, tmp_path, scenes=1)
    assert (made, failed) == (1, {})
    whole = [image for path, image in images_of(store).items() if "/patches/" not in path]
    assert len(whole) == len(ARTICLE) and {image.shape[:2] for image in whole} == {(4096, 4096)}


def test_a_gpu_that_is_asked_for_and_not_there_stops_the_shard_before_any_scene(tmp_path, monkeypatch):
    monkeypatch.setattr(shared_renderer(), "name", "llvmpipe (LLVM 15.0.6, 256 bits)")
    with pytest.raises(MachineError, match=r"run\.device is gpu"):
        run(job_of(64, 48, 60.0, run={"device": "gpu"}), tmp_path)
    assert not (tmp_path / FINGERPRINT_FILE).exists() and not (tmp_path / commit_path(0)).exists()
