import numpy as np
import pytest

from schemas.capture import PosedImages
from schemas.errors import ViewError
from schemas.job.assets import Assets
from tests.captures import captures_job, exact_capture
from workers.assets.captured import CaptureNames, board_asset, reconstructed_asset
from workers.capture.make_capture import image_effects
from workers.capture.rows import CapturedObject, CapturedPair, make_capture_pair
from workers.geometry.camera import project
from workers.geometry.frames import invert, transform
from workers.geometry.projection import Bounds, Seen, compare_covisible
from workers.render.raster.gbuffer import shared_renderer

JOB = captures_job(cameras={"mirror": {"T_z_m": 0.6}})
DONE = exact_capture()


def thing() -> CapturedObject:
    names = CaptureNames("mug-0-00002", "mug", "CC0-1.0", "capture")
    asset, T = reconstructed_asset(DONE.surface, names, Assets())
    return CapturedObject(2, asset, T, DONE.board, board_asset(DONE.board, Assets()), image_effects(JOB))


def pair_of(images: PosedImages, at: int = 1) -> CapturedPair:
    return make_capture_pair(JOB, thing(), images, at, DONE.synthesize, shared_renderer().count_pixels)


@pytest.mark.parametrize("number", [1, 2])
def test_a_mirror_camera_looks_at_the_object_from_the_other_side_at_the_asked_distance(number):
    pair = pair_of(DONE.images(number)).pair
    first, mirror = pair.input.camera.T_world_cam, pair.mirror.camera.T_world_cam
    pivot = first[:3, 3] + pair.d_z_m * first[:3, 2]
    np.testing.assert_allclose(mirror[:3, 3] + 0.6 * mirror[:3, 2], pivot, atol=1e-12)
    np.testing.assert_allclose(mirror[:2, 2], -first[:2, 2], atol=1e-12)  # half a turn about the board's normal
    np.testing.assert_allclose(mirror[2, :3], first[2, :3], atol=1e-12)
    u, v = project(transform(invert(mirror), pivot[None]), pair.mirror.camera.intrinsics)
    k = pair.mirror.camera.intrinsics
    assert (u[0], v[0]) == pytest.approx((k.cx, k.cy))


def test_the_board_has_one_place_in_both_views_so_poses_and_depth_have_one_frame():
    pair = pair_of(DONE.images(1)).pair
    first, mirror = pair.input, pair.mirror
    units = JOB.images.depth_units_per_m
    source, target = (Seen(view.depth, view.region, view.camera) for view in (first, mirror))
    wide = Bounds(facing=-1.0, smooth_m=(1.0, 1.0), hidden_m=1.0)
    difference_m, region = compare_covisible(source, target, np.flatnonzero(first.region == 2), wide, units)
    assert len(difference_m) > 1000
    assert set(region.tolist()) == {2}
    assert np.median(difference_m) < 0.0005
    assert pair.agreement is None


def test_pose_ids_follow_from_capture_and_place_and_labels_name_board_and_object():
    pair = pair_of(DONE.images(2), at=3).pair
    assert [(view.role, view.pose_id, view.parent_id) for view in pair.views] == [
        ("input", 22, 22),
        ("mirror", 23, 22),
        ("projected", 22, 22),
    ]
    for view in (pair.input, pair.mirror):
        assert [(one.region_id, one.category) for one in view.labels] == [(2, "board"), (3, "mug")]
        assert 0.95 < view.labels[1].visible_fraction <= 1.0


def test_a_mirror_view_has_no_region_where_nothing_was_synthesised():
    pair = pair_of(DONE.images(1)).pair
    assert not pair.mirror.region[pair.mirror.depth == 0].any()
    assert (pair.mirror.region == 3).any()


def test_a_view_without_depth_of_the_object_has_no_pair():
    seen = DONE.images(1)
    blind = np.where(seen.mask, 0.0, seen.depth_m)
    with pytest.raises(ViewError):
        pair_of(PosedImages(1, seen.camera, seen.rgb, blind, seen.mask))


def test_views_that_the_job_switches_off_are_not_made():
    job = captures_job(images={"projection": {"enabled": False}}, cameras={"mirror": {"enabled": False}})
    alone = CapturedObject(**{**vars(thing()), "effects": image_effects(job)})

    def refuse(camera):
        raise AssertionError

    one = make_capture_pair(job, alone, DONE.images(1), 0, refuse, shared_renderer().count_pixels)
    assert (len(one.pair.views), one.mirror) == (1, None)
