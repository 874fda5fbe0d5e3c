"""A wrong formula in the producer: plain verify derives labels by the same formula and passes, the second one tells."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import workers.geometry.camera
import workers.geometry.pixels
import workers.geometry.projection
import workers.render.tiers
import workers.scene.labels
import workers.scene.pairs
from schemas.scene.view import Camera, Intrinsics
from services.read.audit import verify_independently
from tests.datasets import faults_of, make_dataset
from workers.geometry.frames import pose, rotation_about, translation

Plant = Callable[[Callable, Callable], None]

SCENES = 3


def shifted(camera: Camera, du: float, dv: float = 0.0) -> Camera:
    k = camera.intrinsics
    return Camera(k.model_copy(update={"cx": k.cx + du, "cy": k.cy + dv}), camera.T_world_cam)


def mirrored_phi(plant: Plant, _: Any) -> None:
    """Rot_x(-phi) Rot_y(pi) Rot_x(+phi) in place of Rot_x(+phi) Rot_y(pi) Rot_x(-phi)."""

    def planted(T_world_cam, d_z_m, T_z_m=1.3, up=None):
        phi = workers.geometry.camera.inclination(T_world_cam)
        tilt = rotation_about(np.array([1.0, 0.0, 0.0]), -phi)
        turn = pose(tilt @ np.diag([-1.0, 1.0, -1.0]) @ tilt.T, np.zeros(3))
        return T_world_cam @ translation(0, 0, d_z_m) @ turn @ translation(0, 0, -T_z_m)

    plant(workers.scene.pairs.mirror_pose, planted)


def wrong_T_z(plant: Plant, _: Any) -> None:
    original = workers.scene.pairs.mirror_pose
    plant(original, lambda T, d_z_m, T_z_m=1.3, *up: original(T, d_z_m, T_z_m + 1e-3, *up))


def nearest_for_percentile(plant: Plant, _: Any) -> None:
    original = workers.scene.pairs.front_distance
    plant(original, lambda z, own, mirror: original(z, own, mirror.model_copy(update={"pivot_depth": "nearest"})))


def offset_with_the_other_sign(plant: Plant, _: Any) -> None:
    original = workers.scene.pairs.place_beside

    def planted(camera, job):
        turned = {"offset_m": tuple(-x for x in job.cameras.depth.offset_m)}
        cameras = job.cameras.model_copy(update={"depth": job.cameras.depth.model_copy(update=turned)})
        return original(camera, job.model_copy(update={"cameras": cameras}))

    plant(original, planted)


def orbit_too_near(plant: Plant, _: Any) -> None:
    original = workers.geometry.camera.orbit_pose
    plant(original, lambda centre, inclination, yaw, radius: original(centre, inclination, yaw, 0.99 * radius))


def yaw_with_the_other_sign(plant: Plant, _: Any) -> None:
    original = workers.geometry.camera.yaw
    plant(original, lambda T: -original(T))


def opencv_on_the_wrong_side(_: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Intrinsics, "cx_opencv", property(lambda k: k.cx + 0.5))


def half_a_pixel_in_rendering(plant: Plant, _: Any) -> None:
    original = workers.render.tiers.draw_view
    plant(
        original,
        lambda renderer, things, look, camera, *rest: original(
            renderer, things, look, shifted(camera, 0.0, 0.5), *rest
        ),
    )


def depth_in_other_units(plant: Plant, _: Any) -> None:
    original = workers.geometry.pixels.round_depth
    plant(original, lambda depth_m, low, high, units: original(depth_m, low, high, 1.001 * units))


def half_a_pixel_in_projection(plant: Plant, _: Any) -> None:
    original = workers.geometry.projection.forward_project
    plant(original, lambda depth, source, *rest: original(depth, shifted(source, 0.5), *rest))


def ties_to_the_highest_index(plant: Plant, _: Any) -> None:
    """The input image and its camera turned by half a turn: the same cloud, its pixels in the opposite order."""
    original = workers.geometry.projection.forward_project

    def planted(depth, source, target, *rest):
        k = source.intrinsics
        turned = k.model_copy(update={"cx": k.width - k.cx, "cy": k.height - k.cy})
        camera = Camera(turned, source.T_world_cam @ np.diag([-1.0, -1.0, 1.0, 1.0]))
        found = original(np.ascontiguousarray(depth[::-1, ::-1]), camera, target, *rest)
        index = np.where(found.source >= 0, depth.size - 1 - found.source, -1).astype(np.int32)
        return workers.geometry.projection.Projected(found.depth_m, index)

    plant(original, planted)


def thinned_cloud(plant: Plant, _: Any) -> None:
    """Every other source row is left out."""
    original = workers.geometry.projection.forward_project

    def planted(depth, *rest):
        thinned = depth.copy()
        thinned[::2] = 0
        return original(thinned, *rest)

    plant(original, planted)


def box_without_its_last_column(plant: Plant, _: Any) -> None:
    original = workers.geometry.pixels.measure_regions

    def planted(region):
        return [
            extent._replace(bbox_xywh=(x, y, w - 1, h)) if extent.pixels else extent
            for extent in original(region)
            for x, y, w, h in [extent.bbox_xywh]
        ]

    plant(original, planted)


def rounded_image_coordinates(plant: Plant, _: Any) -> None:
    original = workers.geometry.camera.image_coordinates

    def planted(T_cam_obj, intrinsics):
        u, v = original(T_cam_obj, intrinsics)
        x, _, z = T_cam_obj[:3, 3]
        return (u, v) if u < 0 else (round(intrinsics.fx * x / z + intrinsics.cx), v)

    plant(original, planted)


def patch_a_pixel_too_far_left(plant: Plant, _: Any) -> None:
    original = workers.scene.labels.crop_box

    def planted(*arguments):
        box = original(*arguments)
        return box and (box[0], slice(box[1].start - 1, box[1].stop - 1))

    plant(original, planted)


@pytest.mark.parametrize(
    ("planted", "told"),
    [
        (mirrored_phi, "T_world_cam of mirror is off"),
        (wrong_T_z, "T_world_cam of mirror is off by 0.0"),
        (nearest_for_percentile, "the object's input depth gives"),
        (offset_with_the_other_sign, "T_world_cam of aligned is off by 0.1"),
        (orbit_too_near, "does not look at the table's centre from cameras.orbit.radius_m"),
        (yaw_with_the_other_sign, "is not the direction from the table to the camera"),
        (opencv_on_the_wrong_side, "cx_opencv is 80.5, the job gives 79.5"),
        (half_a_pixel_in_rendering, "mm off the floor's plane"),
        (depth_in_other_units, "mm off the floor's plane"),
        (half_a_pixel_in_projection, "depth pixels are not those of the input cloud"),
        (thinned_cloud, "depth pixels are not those of the input cloud"),
        (ties_to_the_highest_index, "ties do not go to the lowest source index"),
        (box_without_its_last_column, "bbox_xywh is"),
        (rounded_image_coordinates, "is not the pixel of the object's origin"),
        (patch_a_pixel_too_far_left, "is not the crop about"),
    ],
)
def test_a_wrong_formula_passes_plain_verify_and_not_the_second_derivation(tmp_path, monkeypatch, plant, planted, told):
    planted(plant, monkeypatch)
    store, _ = make_dataset(tmp_path, scenes=SCENES)
    assert faults_of(store) == []
    faults = verify_independently(store, SCENES, lambda _: None).faults
    assert any(told in fault for fault in faults), faults
