"""One scene and its pairs; what every effect adds to them is proven in tests/effects."""

import numpy as np
import pytest

from schemas.scene.view import ROLES
from tests.effects.scenes import Made, Setting, make
from workers.geometry.frames import invert


@pytest.fixture(scope="module")
def made() -> Made:
    return make(Setting({"pairs_per_scene": 2}, scene_id=3))


def test_pose_ids_are_those_of_the_scene_and_the_mirrors_are_odd(made):
    ids = [[(view.role, view.pose_id, view.parent_id) for view in pair.views] for pair in made.scene.pairs]
    assert ids == [
        list(zip(ROLES, (parent, parent, parent + 1, parent), (parent,) * 4, strict=True)) for parent in (12, 14)
    ]


def test_floor_table_and_object_are_drawn_where_they_rest_in_order_of_region(made):
    things, plan = made.scene.posed.things, made.scene.plan
    assert [thing.region_id for thing in things] == [1, 2, 3]
    assert np.array_equal(things[1].T_world_shape, plan.table.T_world_table)
    assert np.array_equal(things[2].T_world_shape, made.scene.settled[0].T_world_obj)


def test_labels_say_where_the_camera_sees_the_object(made):
    for pair in made.scene.pairs:
        for view in (pair.input, pair.mirror):
            label = next(label for label in view.labels if label.region_id == 3)
            assert label.T_cam_obj == pytest.approx(
                invert(view.camera.T_world_cam) @ made.scene.settled[0].T_world_obj, abs=1e-12
            )
            assert label.pixels == (view.region == 3).sum() > 0


def test_the_projected_view_is_the_mirror_cameras_and_its_shares_are_counted(made):
    for pair in made.scene.pairs:
        assert pair.projected.camera is pair.mirror.camera
        assert pair.filled_share == (pair.projected.depth > 0).mean()
        assert 0.0 <= pair.hidden_share <= 1.0
