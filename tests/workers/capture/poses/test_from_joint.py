import dataclasses

import numpy as np
import pytest

from tests.workers.capture.poses.captures import FINER, Virtual, make, median_errors, replaced, without_depth
from tests.workers.capture.poses.scenes import errors
from workers.capture.poses.estimates import estimate_joint, estimate_markers
from workers.capture.poses.markers import fit_markers, moved
from workers.capture.poses.verdict import Evidence

QUICK = Virtual(views=10, camera=FINER)
TRUTH, EVIDENCE = make(QUICK)


def changed(evidence, number, **changes):
    """Evidence with another observation in place of one."""
    observations = tuple(dataclasses.replace(o, **changes) if o.number == number else o for o in evidence.observations)
    return dataclasses.replace(evidence, observations=observations)


def test_a_pose_given_by_hand_is_kept_to_the_bit():
    given = moved(TRUTH[3], np.array([0.004, 0, 0, 0, 0.01, 0]))
    found = estimate_joint(changed(EVIDENCE, 3, manual_T_board_cam=given, given_by="as told"))
    assert found.views[3].T_board_cam == pytest.approx(given, abs=1e-12)
    assert found.views[3].reasons[-1] == "as told"
    assert median_errors(found, TRUTH)[0] < 0.5


def test_without_depth_it_is_what_markers_are():
    bare = without_depth(EVIDENCE)
    joint, markers = estimate_joint(bare), estimate_markers(bare)
    for a, b in zip(joint.views, markers.views, strict=True):
        mm, degrees = errors(a.T_board_cam, b.T_board_cam)
        assert mm < 0.1 and degrees < 0.01  # the scale of the robust loss differs
    assert joint.depth.identified == () and joint.depth.offset_m == 0


def test_depth_tells_apart_what_markers_do_not():
    """One small marker, far off: both tilts fit; the tilt of the board in depth decides."""
    far = replaced(QUICK, views=10, few=(2, 5), few_ids=(0,))
    truth, evidence = make(far)
    found = estimate_joint(evidence)
    for number in far.few:
        assert errors(found.views[number].T_board_cam, truth[number])[1] < 3


def test_an_object_that_moved_is_noted_and_the_smaller_part_flagged():
    parts = []
    for seen, T in zip(EVIDENCE.observations, TRUTH, strict=True):
        patches = seen.object_patches
        if seen.number >= 7:  # the object, not the board, 3 cm farther along x and 1 cm along y
            shift = T[:3, :3].T @ np.array([0.03, 0.01, 0])
            ray_z = patches.ray_z + shift
            patches = dataclasses.replace(patches, ray_z=ray_z, ray=ray_z / ray_z[:, 2:])
        parts.append(dataclasses.replace(seen, object_patches=patches))
    found = estimate_joint(dataclasses.replace(EVIDENCE, observations=tuple(parts)))
    assert "the object moved on the board after view 6" in found.notes[0]
    assert [view.status for view in found.views] == ["used"] * 7 + ["flagged"] * 3
    assert median_errors(found, TRUTH)[0] < 0.5


def test_an_object_that_stood_still_is_not_said_to_have_moved():
    found = estimate_joint(EVIDENCE)
    assert not any("moved" in note for note in found.notes) and len(found.used) == len(TRUTH)


def test_a_view_that_does_not_fit_takes_no_part_and_is_flagged():
    corners = EVIDENCE.observations[4].corners
    wrong = dataclasses.replace(corners, board=corners.board * np.array([0.5, 1.3, 1]))
    seen = [dataclasses.replace(o, corners=wrong) if o.number == 4 else o for o in EVIDENCE.observations]
    poses = [fit_markers(o, EVIDENCE.camera, EVIDENCE.spec) for o in seen]
    found = estimate_joint(Evidence.of(EVIDENCE.setup, seen, poses))
    assert found.views[4].status in ("flagged", "refused")
    rest = dataclasses.replace(found, views=tuple(v for v in found.views if v.number != 4))
    assert median_errors(rest, TRUTH)[0] < 0.5


def test_depth_far_off_the_board_flags_its_view():
    patches = EVIDENCE.observations[5].board_patches
    off = dataclasses.replace(patches, ray_z=patches.ray_z * 1.1)
    found = estimate_joint(changed(EVIDENCE, 5, board_patches=off))
    assert found.views[5].status == "flagged" and "off the board, after the correction" in found.views[5].reasons[-1]
    assert errors(found.views[5].T_board_cam, TRUTH[5])[0] < 1.0
