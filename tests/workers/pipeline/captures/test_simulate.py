"""Virtual captures: the folder, the truth, and what each effect leaves alone."""

import hashlib
import json

import numpy as np
import pytest
import trimesh

from schemas.errors import CaptureError
from schemas.job.captures import Board, Simulate
from schemas.job.job import Job
from tests.workers.pipeline.captures.made_captures import asset_of, made
from workers.assets.catalogue import open_catalogue
from workers.capture.folder import read_truth, read_view
from workers.capture.simulate.simulate import load_object, simulate_capture
from workers.scene.effects import CAPTURE_EFFECTS
from workers.scene.plan import SceneChance

SMALL = {"views": 2, "image_scale": 0.25}

ON = {
    "hidden_markers": {"share": 0.5},
    "print_scale": 1.02,
    "motion_blur": {},
    "distortion": {"k1": 0.5},
    "exposure": {"stops": [-1.0, -1.0]},
    "rgb_noise": {},
    "depth_noise": {},
    "registration_error": {},
}

CHANGES = {
    "hidden_markers": {"rgb", "depth", "truth/held_out/rgb", "truth/held_out/depth"},
    "print_scale": {"rgb", "depth", "truth/held_out/rgb", "truth/held_out/depth"},
    "motion_blur": {"rgb"},
    "distortion": {"rgb", "depth", "truth/mask", "camera.json"},
    "exposure": {"rgb"},
    "rgb_noise": {"rgb"},
    "depth_noise": {"depth"},
    "registration_error": {"depth"},
}
"""Kinds of files that each effect may change, beside the receipt in truth.json."""


def digests(made_capture):
    path = made_capture.folder.path
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


def changed(one, other):
    """The kinds of files that differ: names up to their numbers."""
    a, b = digests(one), digests(other)
    assert a.keys() == b.keys()
    return {name.split("_0")[0] for name in a if a[name] != b[name]} - {"truth/truth.json"}


def test_the_folder_is_read_as_that_of_a_real_capture():
    capture = made(**SMALL)
    folder = capture.folder
    assert folder.numbers == (0, 1)
    assert (folder.about.category, folder.about.name) == ("can", "can-00000")
    k = folder.camera.intrinsics
    assert (k.width, k.height) == (480, 270)
    assert k.fx == pytest.approx(0.25 * 912.37)
    assert not folder.camera.has_lens
    view = read_view(folder, 1)
    assert view.mask is None
    assert (view.depth > 0).mean() > 0.3
    assert folder.board == Board()


def test_the_truth_is_beside_it_and_reads_back():
    capture = made(**SMALL)
    again = read_truth(capture.folder.path)
    assert np.array_equal(again.T_board_cam, capture.truth.T_board_cam)
    assert np.array_equal(again.T_board_obj, capture.truth.T_board_obj)
    mesh = trimesh.load(capture.folder.path / "truth" / "mesh.glb", force="mesh")
    placed = trimesh.transform_points(mesh.vertices, again.T_board_obj)
    assert placed[:, 2].min() == pytest.approx(0.0, abs=1e-8)
    assert np.linalg.norm(np.ptp(mesh.vertices, axis=0)) == pytest.approx(0.25, rel=1e-6)


def test_the_same_seed_writes_the_same_bytes(tmp_path):
    simulate_capture(Simulate(**SMALL), Board(), asset_of(), SceneChance(11, 0), tmp_path)
    for name, digest in digests(made(**SMALL)).items():
        assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == digest
    assert "rgb" in changed(made(**SMALL), made(seed=12, **SMALL))


def test_a_folder_with_files_is_refused():
    with pytest.raises(CaptureError, match="holds files"):
        simulate_capture(Simulate(), Board(), asset_of(), SceneChance(11, 0), made(**SMALL).folder.path)


@pytest.mark.parametrize("name", CAPTURE_EFFECTS)
def test_an_effect_that_is_withdrawn_leaves_every_byte_as_it_is_without_it(name):
    withdrawn = made(without=(name,), **SMALL, **{name: ON[name]})
    assert changed(withdrawn, made(**SMALL)) == set()
    receipt = json.loads((withdrawn.folder.path / "truth" / "truth.json").read_text())
    assert name not in receipt["effects"]
    assert {"effect": name, "why": "withdrawn"} in receipt["skipped"]


@pytest.mark.parametrize("name", CAPTURE_EFFECTS)
def test_an_effect_changes_its_own_files_and_no_pose(name):
    plain, asked = made(**SMALL), made(**SMALL, **{name: ON[name]})
    assert changed(asked, plain) == CHANGES[name]
    assert np.array_equal(asked.truth.T_board_cam, plain.truth.T_board_cam)
    receipt = json.loads((asked.folder.path / "truth" / "truth.json").read_text())
    assert name in receipt["effects"]


def test_no_effect_changes_the_random_numbers_of_another():
    """With exposure beside it, noise is drawn from the same stream: depth noise leaves colour alone and the other way round."""
    both = made(**SMALL, depth_noise={}, rgb_noise={})
    assert changed(both, made(**SMALL, depth_noise={})) == {"rgb"}
    assert changed(both, made(**SMALL, rgb_noise={})) == {"depth"}


def test_the_object_is_of_the_jobs_category(tmp_path):
    job = Job(name="t", categories=["bowl"])
    catalogue = open_catalogue(job.assets, tmp_path, job.categories)
    asset = load_object(job, catalogue, SceneChance(3, 1))
    assert asset.category == "bowl"
    assert asset.instance_id == load_object(job, catalogue, SceneChance(3, 1)).instance_id
    assert asset.instance_id != load_object(job, catalogue, SceneChance(3, 2)).instance_id
