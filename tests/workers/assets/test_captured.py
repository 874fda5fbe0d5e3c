import io

import numpy as np
import pytest
import trimesh

from schemas.capture import Reconstruction
from schemas.job.assets import Assets
from schemas.job.captures import Board
from workers.assets.captured import CaptureNames, board_asset, reconstructed_asset
from workers.assets.external.plain import read_visual
from workers.assets.glb import asset_glb

NAMES = CaptureNames("box-00003", "box", "CC0-1.0", "capture")


def surface(closed: bool = True) -> Reconstruction:
    """A red box of 0.1 x 0.2 x 0.3 m about (0.05, -0.02, 0.15), with or without its bottom."""
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    faces = box.faces if closed else box.faces[box.face_normals[:, 2] > -0.5]
    red = np.tile(np.array([[200, 10, 20]], np.uint8), (len(box.vertices), 1))
    vertices = np.asarray(box.vertices) + np.array([0.05, -0.02, 0.15])
    return Reconstruction(vertices, vertices * 0, red, np.ones(8, np.int32), vertices, faces.astype(np.int32), red)


def test_the_object_frame_is_at_the_middle_of_the_box_along_the_boards_axes():
    asset, T_board_obj = reconstructed_asset(surface(), NAMES, Assets())
    np.testing.assert_allclose(T_board_obj[:3, 3], [0.05, -0.02, 0.15], atol=1e-15)
    np.testing.assert_allclose(asset.extents_m, [0.1, 0.2, 0.3], atol=1e-15)
    np.testing.assert_allclose(asset.shape.vertices + T_board_obj[:3, 3], surface().vertices, atol=1e-15)
    assert (asset.source, asset.licence, asset.watertight) == ("capture", "CC0-1.0", True)
    assert asset.volume_m3 == pytest.approx(0.006, rel=1e-9)


def test_an_open_mesh_has_no_volume_and_says_that_it_was_reconstructed():
    asset, _ = reconstructed_asset(surface(closed=False), NAMES, Assets())
    assert (asset.watertight, asset.volume_m3) == (False, None)
    assert "reconstructed" in asset.notes[0]


def test_the_stored_shape_reads_back_with_its_colours():
    asset, _ = reconstructed_asset(surface(), NAMES, Assets())
    scene = trimesh.load_scene(io.BytesIO(asset_glb(asset)), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.extents, [0.1, 0.2, 0.3], atol=1e-7)
    colors = read_visual(mesh, linear=True)[0].colors
    assert colors.shape == (8, 4)
    assert {tuple(color) for color in colors.tolist()} == {(200, 10, 20, 255)}


def test_another_surface_has_another_digest():
    first, _ = reconstructed_asset(surface(), NAMES, Assets())
    second, _ = reconstructed_asset(surface(closed=False), NAMES, Assets())
    assert first.sha256 != second.sha256


def test_a_board_has_its_true_size_and_a_name_that_tells_it_from_others():
    small = board_asset(Board(measured_ruler_m=0.19), Assets())
    np.testing.assert_allclose(small.extents_m, [0.57, 0.38, 0.0], atol=1e-12)
    names = {board_asset(board, Assets()).instance_id for board in (Board(), Board(first_id=35 - 20), Board(columns=6))}
    assert len({*names, small.instance_id}) == 4
