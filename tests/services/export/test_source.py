import numpy as np

from services.export.source import iter_ranges, scenes_of
from tests.exported import source_image, source_rows
from workers.store.commit import list_codes


def scenes(store, first=0):
    ranges = list(iter_ranges(store, list_codes(store), first))
    return [scene for one in ranges for scene in scenes_of(store, one, [row["scene_id"] for row in one.rows["scenes"]])]


def test_scenes_come_in_order_with_their_pairs_and_from_the_range_that_is_asked_for(files):
    assert [scene.scene_id for scene in scenes(files)] == [0, 1, 2, 3]
    assert [scene.scene_id for scene in scenes(files, 2)] == [2, 3]
    assert [[pair.pose_id for pair in scene.pairs] for scene in scenes(files)] == [[0, 2], [4, 6], [8, 10], [12, 14]]


def test_images_of_a_pair_are_those_that_are_stored(files, tars):
    for store in (files, tars):
        pair = scenes(store)[1].pairs[1]
        for role, kind, word, number in (("input", "rgb", "RGB", 6), ("mirror", "depth", "depth", 7)):
            stored = source_image(files.root, scenes(files)[1].category, word, number)
            np.testing.assert_array_equal(pair.pixels(role, kind), stored)
        assert pair.image("projected", "region") is None and pair.pixels("projected", "region") is None
        assert pair.patch("input", "rgb", 3, 1) is not None and pair.patch("input", "rgb", 4, 2) is None
        assert [row["region_id"] for row in pair.labels("mirror")] == [2, 3]


def test_the_split_of_a_scene_is_the_strictest_of_its_objects(pile):
    (scene,) = scenes(pile)
    assert set(scene.instances) == {3, 4, 5}
    splits = {row["instance_id"]: row["split"] for row in source_rows(pile.root, "assets")}
    assert scene.split == max(
        (splits[name] for _, name in scene.instances.values()), key=("train", "val", "test").index
    )
    names = [name for _, name in scene.instances.values()]
    scene.assets[names[1]] = {**scene.assets[names[1]], "split": "test"}
    assert scene.split == "test"


def test_files_that_are_committed_and_not_yet_published_are_read(files, tmp_path):
    import shutil

    from workers.store.commit import read_record
    from workers.store.local import LocalStore

    shutil.copytree(files.name, tmp_path / "copy")
    store = LocalStore(tmp_path / "copy")
    category = scenes(store)[0].category
    record = read_record(store, 0)
    staged = tmp_path / "copy" / "_staging" / "0000000000" / record.attempt / category
    staged.mkdir(parents=True)
    (tmp_path / "copy" / category / "RGB00000.png").rename(staged / "RGB00000.png")
    assert scenes(store)[0].pairs[0].image("input", "rgb") == (staged / "RGB00000.png").read_bytes()
