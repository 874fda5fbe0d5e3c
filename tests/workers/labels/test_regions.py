"""The label of each region of a rendered view."""

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.scene.scene import Placed, PosedScene
from tests.kit.shapes import asset_of, box, table
from tests.workers.labels.planes import HERE, K
from workers.geometry.frames import translation
from workers.geometry.pixels import Extent
from workers.scene.labels import count_unoccluded, label_region, label_regions, label_things
from workers.scene.plan import SceneChance, draw_scene


def count_as_200(things, camera):
    return [200 for _ in things]


def test_a_label_counts_boxes_and_shares_its_own_pixels():
    asset = asset_of(box(0.1, 0.1, 0.1))
    thing = Placed(3, asset.shape, HERE.T_world_cam @ translation(0.001, 0.001, 2.0))
    made = label_region(thing, ("mug", "m"), HERE, Extent(50, (30, 10, 5, 10)), 100)
    assert (made.region_id, made.category, made.instance_id) == (3, "mug", "m")
    assert (made.u, made.v) == (80, 60)
    assert made.bbox_xywh == (30, 10, 5, 10)
    assert (made.pixels, made.visible_fraction) == (50, 0.5)
    unseen = label_region(thing, ("mug", "m"), HERE, Extent(0, (0, 0, 0, 0)), 0)
    assert (unseen.pixels, unseen.visible_fraction, unseen.bbox_xywh) == (0, 0.0, (0, 0, 0, 0))


def test_table_and_objects_are_labelled_in_order_and_the_floor_is_not():
    plan = draw_scene(Job(name="t"), SceneChance(0, 0), table(), asset_of(box(0.1, 0.1, 0.1), category="box"))
    start = plan.objects[0]
    things = (
        Placed(1, plan.floor, np.eye(4)),
        Placed(2, plan.table.asset.shape, plan.table.T_world_table),
        Placed(3, start.asset.shape, start.T_world_obj),
    )
    region = np.ones((K.height, K.width), np.uint8)
    region[40:80, 40:120], region[50:60, 60:70] = 2, 3
    labels = label_regions(plan, PosedScene(things, plan.appearance), HERE, region, count_as_200)
    assert [(label.region_id, label.category) for label in labels] == [(2, "table"), (3, "box")]
    assert [label.pixels for label in labels] == [3100, 100]
    assert labels[1].bbox_xywh == (60, 50, 10, 10)
    assert labels[1].visible_fraction == 0.5
    assert np.allclose(HERE.T_world_cam @ labels[1].T_cam_obj, start.T_world_obj)


def test_only_things_that_are_seen_are_counted():
    asset = asset_of(box(0.1, 0.1, 0.1))
    things = [Placed(region_id, asset.shape, np.eye(4)) for region_id in (2, 3, 4)]
    region = np.zeros((K.height, K.width), np.uint8)
    region[0, :5], region[1, :8] = 2, 4
    names = dict.fromkeys((2, 3, 4), ("box", "b"))
    counts = {2: 10, 4: 32}
    labels = label_things(things, names, HERE, region, lambda seen, camera: [counts[one.region_id] for one in seen])
    assert [label.visible_fraction for label in labels] == [0.5, 0.0, 0.25]
    nothing = label_things(things, names, HERE, np.zeros_like(region), lambda seen, camera: pytest.fail("none is seen"))
    assert [label.pixels for label in nothing] == [0, 0, 0]


def test_what_the_processor_cannot_count_is_counted_by_the_renderer():
    near, far = (Placed(n, asset_of(box(0.1, 0.1, 0.1)).shape, HERE.T_world_cam @ translation(0, 0, n)) for n in (0, 2))
    asked = []

    def count_drawn(things, camera):
        asked.extend(things)
        return [77 for _ in things]

    counts = count_unoccluded([far, near, far], HERE, count_drawn)
    assert counts == [36, 77, 36]  # its side is 6.7 pixels
    assert asked == [near]
    assert count_unoccluded([far], HERE, lambda things, camera: pytest.fail("nothing is left")) == [36]
