"""Held-out views: exact pictures from other poses, against a ray caster that shares nothing with the rasteriser."""

import numpy as np
import pytest
import trimesh

from schemas.scene.scene import Placed
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Camera
from tests.workers.pipeline.captures.edge_corners import corner_errors
from tests.workers.pipeline.captures.made_captures import made
from workers.capture.folder import open_folder, read_pose, read_view
from workers.capture.simulate.simulate import VIEWS
from workers.geometry.raycast import cast_view

SMALL = {"views": 2, "image_scale": 0.25}
EFFECTS = {"depth_noise": {}, "rgb_noise": {}, "distortion": {"k1": 0.08}, "exposure": {}, "motion_blur": {}}


def held_out(capture):
    return open_folder(capture.folder.path / "truth" / "held_out")


def test_depth_and_mask_are_those_of_the_true_mesh_on_the_print():
    capture = made(**SMALL, **EFFECTS)
    folder = held_out(capture)
    mesh = trimesh.load(capture.folder.path / "truth" / "mesh.glb", force="mesh")
    thing = Shape((Part("object", np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)),))
    square = np.array([[-0.3, -0.2, 0.0], [0.3, -0.2, 0.0], [0.3, 0.2, 0.0], [-0.3, 0.2, 0.0]])
    plane = Shape((Part("print", square, np.array([[0, 1, 2], [0, 2, 3]], np.int32)),))
    things = [Placed(2, plane, np.eye(4)), Placed(3, thing, capture.truth.T_board_obj)]
    assert folder.numbers == tuple(range(VIEWS))
    for number in folder.numbers:
        view = read_view(folder, number)
        T = read_pose(folder.path / f"board_{number:05d}.txt")
        depth_m, region, _ = cast_view(things, Camera(folder.camera.intrinsics, T))
        assert ((region == 3) != view.mask).mean() < 1e-4  # rays at an outline's very edge
        same = (region >= 2) & ((region == 3) == view.mask)
        error = np.abs(view.depth / folder.camera.depth_units_per_m - depth_m)[same]
        assert np.percentile(error, 99.9) < 1e-4
        assert same.mean() > 0.03


def test_colour_is_seen_without_a_lens_from_the_stated_pose():
    capture = made(views=1, image_scale=0.5, distance_m=[0.4, 0.45], **EFFECTS)
    folder = held_out(capture)
    assert not folder.camera.has_lens
    T = read_pose(folder.path / "board_00000.txt")
    errors, _ = corner_errors(read_view(folder, 0).rgb, folder.camera, T, folder.board)
    assert np.abs(errors.mean(axis=0)).max() < 0.03
    assert np.median(np.abs(errors)) < 0.05


def test_no_pose_was_photographed_and_all_lie_on_such_a_path():
    capture = made(**SMALL)
    folder = held_out(capture)
    for number in folder.numbers:
        T = read_pose(folder.path / f"board_{number:05d}.txt")
        away = np.linalg.norm(capture.truth.T_board_cam[:, :3, 3] - T[:3, 3], axis=1)
        assert away.min() > 0.01
        assert 0.5 < np.linalg.norm(T[:3, 3] - capture.truth.T_board_obj[:3, 3]) < 1.1


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_no_effect_of_a_sensor_changes_them(name):
    plain, asked = held_out(made(**SMALL)), held_out(made(**SMALL, **{name: EFFECTS[name]}))
    for file in sorted(plain.path.iterdir()):
        assert file.read_bytes() == (asked.path / file.name).read_bytes()
