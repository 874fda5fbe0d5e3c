import numpy as np
import pyarrow as pa

from services.look.pictures import choose_scenes, show_scenes


class Rows:
    """Scenes in two batches."""

    def __init__(self, categories: list[str]) -> None:
        self.rows = pa.table({"scene_id": range(10, 10 + len(categories)), "category": categories})

    def batches(self, table, columns):
        half = self.rows.num_rows // 2
        yield from (self.rows.slice(0, half), self.rows.slice(half))


def test_each_category_has_as_many_scenes_evenly_over_its_ids():
    names = ["mug", "box"] * 50
    chosen = choose_scenes(Rows(names), {"box": 50, "mug": 50}, 4)
    assert chosen == [10 + 2 * 12 + 1, 10 + 2 * 37 + 1, 10 + 2 * 12, 10 + 2 * 37]


def test_a_rare_category_gives_its_place_to_others_and_each_has_one():
    names = ["mug"] * 30 + ["box"]
    chosen = choose_scenes(Rows(names), {"box": 1, "mug": 30}, 6)
    assert len(chosen) == 6 and 40 in chosen
    assert len(choose_scenes(Rows(names), {"box": 1, "mug": 30}, 1)) == 2
    assert choose_scenes(Rows([]), {}, 4) == []


def test_a_scene_has_its_pictures_and_what_is_told_of_it(shown):
    sample = show_scenes(shown, [0, 3])
    assert [scene.scene_id for scene in sample.scenes] == [0, 3]
    first = sample.scenes[0]
    roles = {f"{role} {kind}" for role in ("input", "mirror") for kind in ("rgb", "depth", "mask")}
    assert set(first.pictures) == roles | {"over"}
    assert all(picture.data for picture in first.pictures.values())
    assert 0.0 < first.visible["input"] <= 1.0 and 1.9 < first.d_z_m < 3.0


def test_depth_is_counted_of_objects_alone(shown):
    sample = show_scenes(shown, [0])
    depth = sample.depth["input"]
    assert 0 < depth.count < 160 * 120 / 10
    assert abs(depth.percentile(0.02) - sample.scenes[0].d_z_m) < 0.05
    assert np.isfinite(sample.depth["mirror"].mean)
