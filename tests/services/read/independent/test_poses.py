"""Wrong formulas in what makes captures: plain verify derives labels by the same formula and passes, the second one tells."""

import numpy as np
import pytest

import workers.scene.pairs
from services.read.audit import verify_independently
from tests.captures import CAMERA, captures_job, exact_capture, use_exact_captures
from tests.datasets import faults_of, run_here
from workers.capture import make_capture
from workers.geometry.frames import pose, rotation_about, translation


@pytest.fixture(autouse=True)
def exact(monkeypatch):
    use_exact_captures(monkeypatch)


def level_turn(T_world_cam, d_z_m, T_z_m=1.3, up=None):
    """The article's product, which holds for cameras without roll alone."""
    phi = np.arctan2(-T_world_cam[2, 2], np.hypot(T_world_cam[0, 2], T_world_cam[1, 2]))
    tilt = rotation_about(np.array([1.0, 0.0, 0.0]), phi)
    turn = pose(tilt @ np.diag([-1.0, 1.0, -1.0]) @ tilt.T, np.zeros(3))
    return T_world_cam @ translation(0, 0, d_z_m) @ turn @ translation(0, 0, -T_z_m)


def farther(T_world_cam, d_z_m, T_z_m=1.3, up=None):
    n = T_world_cam[2, :3]
    turn = pose(2 * np.outer(n, n) - np.eye(3), np.zeros(3))
    return T_world_cam @ translation(0, 0, d_z_m) @ turn @ translation(0, 0, -T_z_m - 1e-3)


@pytest.mark.parametrize("planted", [level_turn, farther])
def test_a_wrong_mirror_camera_of_a_rolled_photograph_is_found(plant, tmp_path, planted):
    plant(workers.scene.pairs.mirror_pose, planted)
    store, _ = run_here(captures_job(scenes=1), tmp_path)
    assert faults_of(store) == []
    found = verify_independently(store, 1, lambda _: None)
    assert found.faults
    assert all("T_world_cam of" in fault for fault in found.faults)


def test_depth_along_the_ray_instead_of_the_axis_is_found(tmp_path, monkeypatch):
    """A pixel at the edge of this wide camera is 40 % farther along its ray than along the axis."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    length = np.sqrt(1 + ((columns - CAMERA.cx) / CAMERA.fx) ** 2 + ((rows - CAMERA.cy) / CAMERA.fy) ** 2)

    def process(folder, captures, watch):
        done = exact_capture()
        usual = done.images

        def images(number):
            seen = usual(number)
            return type(seen)(seen.number, seen.camera, seen.rgb, seen.depth_m * length**2, seen.mask)

        return type(done)(**{**vars(done), "images": images})

    monkeypatch.setattr(make_capture, "process_capture", process)
    store, _ = run_here(captures_job(scenes=1), tmp_path)
    assert any("off the board's plane" in fault for fault in verify_independently(store, 1, lambda _: None).faults)
