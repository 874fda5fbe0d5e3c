"""Scenes of several objects from the job file to the merged files: ids, patches, rows, and every way to read them back."""

import contextlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import trimesh

import services.read.verify_range
from schemas.dataset.codec import Row
from services.job.job_file import validate_job
from services.read.query import query
from services.read.replay import replay_scene
from services.read.scene_geometry import export_scene
from services.read.verify import verify
from services.run.ray_cluster import Slots, private_ray
from services.run.run_job import RunRequest, run_job
from tests.datasets import SMALL, faults_of, images_of, make_dataset, overlaid
from workers.store.images import decode_png
from workers.store.local import LocalStore
from workers.store.tars import read_tar

pytestmark = pytest.mark.minute

THREE: dict[str, Any] = {
    "objects_per_scene": 3,
    "scenes": 3,
    "check": {"raycast_share": 1.0},
    "categories": ["box", "camera", "bottle"],  # of few convex parts: Bullet's time goes with their number
}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[LocalStore, str]:
    """Three scenes of three objects, each checked against cast rays and released again."""
    return make_dataset(tmp_path_factory.mktemp("three"), **THREE)


def rows(store: LocalStore, sql: str) -> list[Row]:
    return query(store, sql).to_pylist()


def masks(store: LocalStore) -> list[tuple[Row, np.ndarray]]:
    """Every rendered view with its mask."""
    views = rows(store, "select * from views where role != 'projected' order by pose_id, role")
    return [
        (
            view,
            decode_png(store.read(next(f["path"] for f in view["files"] if f["path"].split("/")[1][:7] == "segment"))),
        )
        for view in views
    ]


def test_it_verifies_and_replays_to_the_byte(made):
    store, _ = made
    assert faults_of(store) == []
    for scene_id in range(3):
        replayed = replay_scene(store, scene_id)
        assert replayed.same_stack and replayed.differences == ()


def test_every_region_of_a_mask_is_an_object_of_the_scene_and_every_row_counts_its_pixels(made):
    store, _ = made
    objects = {(o["pose_id"], o["role"], o["region_id"]): o for o in rows(store, "select * from objects")}
    assert len(objects) == 3 * 3 * 4  # scenes, rendered views, the table and three objects
    for view, mask in masks(store):
        assert mask.dtype == np.uint8
        assert set(np.unique(mask)) <= {0, 1, 2, 3, 4, 5}
        own = [objects[view["pose_id"], view["role"], region] for region in (3, 4, 5)]
        assert [row["pixels"] for row in own] == [int((mask == region).sum()) for region in (3, 4, 5)]
        assert view["object_pixels"] == int((mask >= 3).sum()) > 0
        assert view["visible_fraction"] == own[0]["visible_fraction"]
        assert view["patch_object_fraction"] == own[0]["patch_object_fraction"]


def test_every_seen_object_has_its_own_patch_about_itself_and_its_row_says_so(made):
    store, _ = made
    k, half = 0, np.array([16, 12])
    for view, mask in masks(store):
        listed = {file["path"] for file in view["files"]}
        number = view["parent_id"] + (view["role"] == "mirror")
        content = "segmentAligned" if view["role"] == "aligned" else "segment"
        where = f"pose_id = {view['pose_id']} and role = '{view['role']}' and region_id > 2"
        for row in rows(store, f"select * from objects where {where}"):
            path = f"{view['category']}/patches/{content}{number:05d}obj{row['region_id'] - 3}.png"
            middle = np.array([row["u"], row["v"]])
            fits = (middle >= half).all() and (middle + half <= [160, 120]).all()
            assert (path in listed) == bool(fits and row["pixels"] > 0) == (row["patch_object_fraction"] is not None)
            if path in listed:
                left, top = middle - half
                crop = mask[top : top + 24, left : left + 32]
                assert np.array_equal(decode_png(store.read(path)), crop)
                assert row["patch_object_fraction"] == (crop == row["region_id"]).mean()
                k += 1
    assert k > 15


def test_the_scenes_own_columns_are_the_first_objects_and_the_worst_of_all(made):
    store, _ = made
    for row in rows(store, "select * from scenes"):
        bodies = row["bodies"]
        assert [body["region_id"] for body in bodies] == [3, 4, 5]
        first = bodies[0]
        assert (row["category"], row["instance_id"], row["T_world_obj"]) == (
            first["category"], first["instance_id"], first["T_world_obj"],
        )  # fmt: skip
        for name in ("penetration_mm", "hover_gap_mm", "residual_speed_mm_s", "recheck_move_mm"):
            assert row[name] == max(body[name] for body in bodies)
        assert row["support_margin_mm"] == min(body["support_margin_mm"] for body in bodies)
        assert len({body["T_world_obj"][3] for body in bodies}) == 3


def test_each_objects_pose_is_where_its_camera_rows_put_it(made):
    store, _ = made
    scenes = {row["scene_id"]: row for row in rows(store, "select * from scenes")}
    views = {(v["pose_id"], v["role"]): v for v in rows(store, "select * from views")}
    for row in rows(store, "select * from objects where region_id > 2"):
        body = scenes[row["scene_id"]]["bodies"][row["region_id"] - 3]
        assert (row["category"], row["instance_id"]) == (body["category"], body["instance_id"])
        T_world_cam = np.reshape(views[row["pose_id"], row["role"]]["T_world_cam"], (4, 4))
        T_world_obj = T_world_cam @ np.reshape(row["T_cam_obj"], (4, 4))
        np.testing.assert_allclose(T_world_obj, np.reshape(body["T_world_obj"], (4, 4)), atol=1e-12)


def test_d_z_is_the_distance_to_the_front_of_the_whole_group(made):
    """As many of its depth pixels lie nearer as the percentile of 2 says: of all objects together, and not of the first."""
    store, _ = made
    apart = 0
    for view, mask in masks(store):
        if view["role"] != "input":
            continue
        path = f"{view['category']}/depth{view['pose_id']:05d}.png"
        depth = decode_png(store.read(path)) / view["depth_units_per_m"]
        group, first = depth[(mask >= 3) & (depth > 0)], depth[(mask == 3) & (depth > 0)]
        rank = 0.02 * (len(group) - 1)
        assert (group < view["d_z_m"] - 1e-9).sum() - 1 <= rank <= (group < view["d_z_m"] + 1e-9).sum() + 1
        apart += abs(np.percentile(first, 2.0) - view["d_z_m"]) > 1e-3
    assert apart > 0


def test_objects_dat_has_a_line_for_every_object_and_cam_poses_two_a_pair(made):
    store, _ = made
    lines = [line.split() for line in (store.root / "objects.dat").read_text().splitlines()]
    assert {len(words) for words in lines} == {22}
    assert [(int(words[0]), int(words[3])) for words in lines] == [(p, r) for p in range(6) for r in (2, 3, 4, 5)]
    assert len((store.root / "camPoses.csv").read_text().splitlines()) == 1 + 6


def test_assets_are_listed_once_each(made):
    store, _ = made
    told = {body["instance_id"] for row in rows(store, "select bodies from scenes") for body in row["bodies"]}
    listed = [row["instance_id"] for row in rows(store, "select instance_id from assets where category != 'table'")]
    assert sorted(listed) == sorted(told)
    files = {path.stem for path in (store.root / "assets").rglob("*.glb") if path.parent.name != "table"}
    assert files == told


def test_two_objects_of_one_instance_share_its_row_and_its_file(tmp_path):
    one = {"objects": [{"source": "procedural", "instances": 1}]}
    store, _ = make_dataset(tmp_path, scenes=1, objects_per_scene=3, categories=["mug"], assets=one)
    assert faults_of(store) == []
    (row,) = rows(store, "select bodies from scenes")
    assert len({body["instance_id"] for body in row["bodies"]}) == 1
    assert rows(store, "select count(*) as n from assets where category = 'mug'") == [{"n": 1}]
    assert export_scene(store, 0, tmp_path / "scene.glb") > 0
    names = trimesh.load(tmp_path / "scene.glb").graph.nodes_geometry
    assert len({name.partition("/")[0] for name in names if name.startswith("mug ")}) == 3


def test_tars_hold_the_same_images(made, tmp_path):
    store, _ = make_dataset(tmp_path, **THREE, output={"layout": "tar"})
    assert faults_of(store) == []
    packed = {}
    for path in tmp_path.glob("*/*.tar"):
        packed.update(read_tar(path.parent.name, path.read_bytes(), path.name))
    assert packed == images_of(made[0])
    assert replay_scene(store, 2).differences == ()


def test_a_scene_that_has_one_object_by_chance_is_the_scene_of_a_job_with_one(tmp_path):
    """Of a range of counts: the same images, under names without `obj`."""
    ranged, _ = make_dataset(tmp_path / "ranged", scenes=6, objects_per_scene=[1, 3])
    single, _ = make_dataset(tmp_path / "single", scenes=6)
    counts = [len(row["bodies"]) for row in rows(ranged, "select bodies from scenes order by scene_id")]
    assert set(counts) == {1, 2, 3}
    assert faults_of(ranged) == []
    before, after = images_of(single), images_of(ranged)
    for scene_id, count in enumerate(counts):
        ids = {f"{2 * scene_id:05d}", f"{2 * scene_id + 1:05d}"}
        own = {path: data for path, data in after.items() if re.search(r"\d{5}", path)[0] in ids}
        assert any("obj" in path for path in own) == (count > 1)
        if count == 1:
            assert own == {path: data for path, data in before.items() if re.search(r"\d{5}", path)[0] in ids}


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        ("bodies[1].T_world_obj", "T_cam_obj does not follow"),
        ("bodies[1].penetration_mm", "penetration_mm is"),
        ("bodies[0].instance_id", "instance_id is"),
        ("bodies[2].region_id", "bodies have the regions"),
        ("objects.patch_object_fraction", "of its patch"),
    ],
)
def test_rows_that_disagree_are_found(made, monkeypatch, damage, told):
    """Rows are changed on their way from the file, so that checksums still hold."""
    original = services.read.verify_range.range_rows

    def damaged(store, records, table):
        rows = original(store, records, table)
        if table not in ("scenes", "objects"):
            return rows
        changed = rows.to_pylist()
        if damage == f"{table}.patch_object_fraction":
            row = next(row for row in changed if row["patch_object_fraction"])
            row["patch_object_fraction"] += 0.01
        elif table == "scenes":
            change_bodies(changed[0]["bodies"], damage)
        return pa.Table.from_pylist(changed, rows.schema)

    monkeypatch.setattr(services.read.verify_range, "range_rows", damaged)
    assert any(told in fault for fault in verify(made[0], lambda _: None).faults)


def change_bodies(bodies: list[dict], damage: str) -> None:
    """Changes one value of a scene's bodies."""
    if damage.endswith("T_world_obj"):
        bodies[1]["T_world_obj"][3] += 1e-6
    elif damage.endswith("penetration_mm"):
        bodies[1]["penetration_mm"] += 1.0
    elif damage.endswith("instance_id"):
        bodies[0]["instance_id"] = "another"
    elif damage.endswith("region_id"):
        bodies[2]["region_id"] = 9


def test_a_mask_with_two_objects_swapped_is_found(made, monkeypatch):
    """The mask is changed on its way from the file, so that its checksum still holds."""
    original = services.read.verify_range.read_image

    def swapped(read, path):
        mask = original(read, path)
        if not path.endswith("/segment00000.png") or "patches" in path:
            return mask
        return np.where(mask == 3, 4, np.where(mask == 4, 3, mask)).astype(np.uint8)

    monkeypatch.setattr(services.read.verify_range, "read_image", swapped)
    faults = "\n".join(faults_of(made[0]))
    assert "region 3: the mask has" in faults and "region 4: the mask has" in faults


@pytest.mark.ray
def test_workers_shards_ranges_and_an_extension_do_not_change_the_dataset(tmp_path):
    changes = {"objects_per_scene": [2, 4], "scenes": 6, "categories": THREE["categories"]}

    def run(name: str, slots: int, **more: Any) -> str:
        job = validate_job(overlaid(SMALL, {**changes, **more}), "test")
        request = RunRequest(job, Path(), str(tmp_path / name))
        return run_job(request, contextlib.nullcontext(Slots(slots, slots))).merged.digest

    with private_ray(2):
        digests = {
            run("whole", 1, run={"shard_size": 6, "range_size": 6}),
            run("split", 2, run={"shard_size": 1, "range_size": 2}),
        }
        assert run("grown", 2, scenes=3, run={"range_size": 2}) not in digests
        digests.add(run("grown", 2, run={"range_size": 4}))
    plain = make_dataset(tmp_path / "plain", **changes)
    assert digests == {plain[1]}
    success = json.loads((tmp_path / "grown" / "_SUCCESS").read_text())
    assert success["scenes"] == {"made": 6, "intrinsic": 0, "environmental": 0}
