"""The views of one pair: which there are, their ids, and the cameras that follow from the input's."""

import numpy as np
import pytest

from schemas.scene.view import Pair
from tests.effects.scenes import Setting, make


def made_pairs(withdrawn: tuple[str, ...] = (), **changes) -> tuple[Pair, ...]:
    return make(Setting(changes, scene_id=3), withdrawn=withdrawn).scene.pairs


def test_pose_ids_are_arithmetic_and_every_view_names_its_input():
    ids = [[(view.role, view.pose_id, view.parent_id) for view in pair.views] for pair in made_pairs(pairs_per_scene=2)]
    assert ids == [[("input", n, n), ("aligned", n, n), ("mirror", n + 1, n), ("projected", n, n)] for n in (12, 14)], (
        "pair k of scene 3 has the even id 2 (2 * 3 + k)"
    )


def test_the_mirror_camera_looks_at_the_pivot_from_its_distance():
    (pair,) = made_pairs(cameras={"mirror": {"T_z_m": 1.1}})
    T_in, T_mirror = pair.input.camera.T_world_cam, pair.mirror.camera.T_world_cam
    pivot = T_in[:3, 3] + pair.d_z_m * T_in[:3, 2]
    assert T_mirror[:3, 3] + 1.1 * T_mirror[:3, 2] == pytest.approx(pivot, abs=1e-12)
    assert T_mirror[2, 2] == pytest.approx(T_in[2, 2]), "half a turn about z keeps the inclination"


def test_the_pivot_depth_is_read_from_the_stored_pixels_of_the_object():
    (pair,) = made_pairs(cameras={"mirror": {"pivot_depth": "nearest"}})
    own = pair.input.depth[(pair.input.region >= 3) & (pair.input.depth > 0)]
    assert pair.d_z_m == own.min() / 5000.0


@pytest.mark.parametrize(
    ("withdrawn", "roles"),
    [
        ("depth_camera", ["input", "mirror", "projected"]),
        ("mirror", ["input", "aligned"]),
        ("projection", ["input", "aligned", "mirror"]),
    ],
)
def test_a_view_that_the_plan_does_not_run_is_not_there_and_the_input_stays(withdrawn, roles):
    (pair,), (whole,) = made_pairs((withdrawn,)), made_pairs()
    assert [view.role for view in pair.views] == roles
    assert np.array_equal(pair.input.depth, whole.input.depth) and np.array_equal(pair.input.rgb, whole.input.rgb)
