"""What of a pair is not stored."""

from services.dataset.dataset import open_dataset
from tests.datasets import make_dataset


def test_views_that_the_job_switched_off_are_none(tmp_path):
    off = {
        "cameras": {"depth": {"enabled": False}, "mirror": {"enabled": False}},
        "images": {"projection": {"enabled": False}},
    }
    store, _ = make_dataset(tmp_path, scenes=1, render={"rgb": False}, **off)
    (pair,) = open_dataset(store.root).pairs()
    assert (pair.aligned, pair.mirror, pair.projected) == (None, None, None)
    assert set(pair.input.images) == {"depth", "region"}
    assert repr(pair) == f"Pair(pose_id=0, scene_id=0, category={pair.category!r}, instance_id={pair.instance_id!r})"
