"""Scenes from a table (`scenes_from`): what is kept and measured, what falls, what fails, and in which forms a table comes."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from schemas.errors import AssetSourceError, OutputError, SettleError
from schemas.scene.scene import EffectPlan
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset
from services.dataset.dataset import open_dataset
from services.job.job_file import validate_job
from services.job.record import record_job
from services.read import audit
from services.read.replay import replay_scene
from tests.datasets import SMALL, faults_of, images_of, make_dataset, overlaid
from tests.kit.shapes import asset_of, box, table
from tests.physics.settling import PHYSICS, scene_of, start_at
from tests.services.export.exported import export_to
from tests.workers.assets.libraries import library_of
from workers.assets.scene_tables import read_scene
from workers.capture.results import open_sources
from workers.geometry.frames import invert, pose, rotation_about, transform
from workers.physics.settle import keep_scene
from workers.physics.support import place_table
from workers.store.local import LocalStore

THREE: dict[str, Any] = {
    "scenes": 3,
    "categories": ["box", "can"],
    "objects_per_scene": [1, 3],
    "pairs_per_scene": 2,
    "start": {"offset_m": [-0.15, 0.15]},
}
BOX = "box-0-000005"


def rows_of(store: LocalStore, table: str) -> list[dict[str, Any]]:
    rows = ds.dataset(store.root / "manifest" / table, partitioning="hive").to_table().to_pylist()
    return sorted(rows, key=lambda row: row["scene_id"])


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> LocalStore:
    return make_dataset(tmp_path_factory.mktemp("drawn") / "a", **THREE)[0]


@pytest.fixture(scope="module")
def again(drawn, tmp_path_factory) -> LocalStore:
    """The same dataset made again from its own folder."""
    return make_dataset(tmp_path_factory.mktemp("again") / "b", scenes_from=str(drawn.root), **THREE)[0]


@pytest.fixture(scope="module")
def standing(tmp_path_factory) -> np.ndarray:
    """The pose of `BOX` on a table, without a turn."""
    T = np.eye(4)
    T[2, 3] = 2.0
    fallen = made(tmp_path_factory.mktemp("fallen"), [row(0, T, settle=True)], scenes=1)
    T[:3, :] = np.reshape(rows_of(fallen, "scenes")[0]["T_world_obj"], (4, 4))[:3]
    return T


def row(scene_id: int, T: Any, /, **more: Any) -> dict[str, Any]:
    return {"scene_id": scene_id, "instance_id": BOX, "table_id": "tray-0-000000", "T_world_obj": as_list(T), **more}


def as_list(T: Any) -> Any:
    return T.tolist() if isinstance(T, np.ndarray) else T


def moved(T: np.ndarray, x_mm: float = 0.0, z_mm: float = 0.0) -> np.ndarray:
    T = T.copy()
    T[:3, 3] += x_mm / 1e3, 0.0, z_mm / 1e3
    return T


TRAYS = {"assets": {"tables": [{"source": "procedural", "kind": "tray"}]}}


def made(folder: Path, rows: list[dict[str, Any]], **changes: Any) -> LocalStore:
    (folder / "scenes.json").write_text(json.dumps(rows))
    return make_dataset(folder / "out", **overlaid({"scenes_from": str(folder / "scenes.json"), **TRAYS}, changes))[0]


def test_a_finished_dataset_as_a_table_gives_every_image_byte_for_byte(drawn, again):
    """Its depth and regions, and with the same look its colour; and nothing fell, and everything verifies."""
    assert images_of(again) == images_of(drawn)
    for before, now in zip(rows_of(drawn, "scenes"), rows_of(again, "scenes"), strict=True):
        assert [body["T_world_obj"] for body in now["bodies"]] == [body["T_world_obj"] for body in before["bodies"]]
        why = {skipped["effect"]: skipped["why"] for skipped in now["skipped"]}
        assert now["pose"] == "as_given" and "kept_poses" in now["effects"] and now["settle_s"] == 0.0
        assert why["dynamics"] == "poses of scenes_from are kept: nothing falls or rests"
        assert why["release_again"] == "poses of scenes_from are kept: nothing rests"
        assert now["hover_gap_mm"] <= 0.01 and now["penetration_mm"] <= 0.01 and now["equilibrium_residual"] <= 1e-3
    assert faults_of(again) == []
    independent = audit.verify_independently(again, 3, lambda _: None)
    assert independent.faults == [] and not any("scenes_from" in line for line in independent.underived)
    assert audit.audit(again, 2, lambda _: None).faults == []
    assert replay_scene(again, 1).differences == ()


@pytest.mark.minute
def test_another_tier_and_other_cameras_keep_the_geometry(drawn, tmp_path):
    flat = make_dataset(
        tmp_path / "flat", **overlaid(THREE, {"scenes_from": str(drawn.root), "render": {"tier": "flat"}})
    )[0]
    before, now = images_of(drawn), images_of(flat)
    exact = [path for path in before if "RGB" not in path]
    assert exact and all(now[path] == before[path] for path in exact)
    orbit = {"cameras": {"orbit": {"always": True, "inclination_rad": [1.2, 1.2]}}, "pairs_per_scene": 1}
    above = make_dataset(tmp_path / "above", **overlaid(THREE, {"scenes_from": str(drawn.root), **orbit}))[0]
    assert faults_of(above) == audit.verify_independently(above, 3, lambda _: None).faults == []
    assert {view["inclination_rad"] for view in rows_of(above, "views") if view["role"] == "input"} == {1.2}
    bodies = [
        [(body["instance_id"], body["T_world_obj"]) for body in row["bodies"]] for row in rows_of(above, "scenes")
    ]
    assert bodies == [[(b["instance_id"], b["T_world_obj"]) for b in row["bodies"]] for row in rows_of(drawn, "scenes")]


def test_a_studio_dataset_as_a_table_gives_depth_and_regions_byte_for_byte_in_another_light_and_tier(tmp_path):
    job: dict[str, Any] = {**ALONE, "studio": UNIT, "pairs_per_scene": 2}
    first, _ = make_dataset(tmp_path / "a", **job, start={"pose": "tumbled"})
    changes = {"seed": 12, "render": {"tier": "flat"}, "cameras": {"more": [{"name": "around", "ring": {"count": 3}}]}}
    again, _ = make_dataset(tmp_path / "b", **job, **changes, scenes_from=str(first.root))
    before, now = images_of(first), images_of(again)
    for path, digest in before.items():
        assert (now[path] == digest) == ("RGB" not in path)
    assert (
        len(now) > len(before) and faults_of(again) == audit.verify_independently(again, 2, lambda _: None).faults == []
    )
    (failed, *_) = rows_of(make_dataset(tmp_path / "c", scenes_from=str(first.root))[0], "failures")
    assert failed["reason"] == "no_table" and "has scenes of a studio: set scene: studio" in failed["detail"]


def test_a_studio_shows_the_first_object_of_a_scene_on_a_table_as_its_cameras_saw_it(drawn, tmp_path):
    """Its depth where nothing stood before it, to one unit of what is stored."""
    job = {**ALONE, "scenes_from": str(drawn.root), "scenes": 3, "pairs_per_scene": 2, "categories": ["box", "can"]}
    alone, _ = make_dataset(tmp_path / "a", **job)
    assert faults_of(alone) == audit.verify_independently(alone, 3, lambda _: None).faults == []
    for scene in rows_of(alone, "scenes"):
        assert len(scene["bodies"]) == 1 and scene["T_world_obj"][3:12:4] == [0.0] * 3
    both = ([pair.views["input"] for pair in open_dataset(store.root).pairs()] for store in (drawn, alone))
    for there, here in zip(*both, strict=True):
        seen = there.segment() == REGION_FIRST_OBJECT
        assert seen.any() and (here.segment()[seen] == REGION_FIRST_OBJECT).all()
        assert np.abs(here.depth_m() - there.depth_m())[seen].max() < 2.1e-4


ALONE: dict[str, Any] = {"scene": "studio", "categories": ["box"]}
UNIT = {"scale": "unit_cube"}


@pytest.mark.minute
def test_clutter_falls_over_a_kept_scene_and_moves_nothing(again, tmp_path):
    look = {"look": {"clutter": {"count": [3, 3]}}, "scenes_from": str(again.root)}
    strewn = make_dataset(tmp_path / "out", **overlaid(THREE, look))[0]
    assert faults_of(strewn) == audit.verify_independently(strewn, 3, lambda _: None).faults == []
    assert audit.audit(strewn, 1, lambda _: None).faults == []
    for before, now in zip(rows_of(again, "scenes"), rows_of(strewn, "scenes"), strict=True):
        assert [body["T_world_obj"] for body in now["bodies"]] == [body["T_world_obj"] for body in before["bodies"]]
        assert now["surroundings"]["clutter"] and {"kept_poses", "dynamics"} <= set(now["effects"])


@pytest.mark.minute
def test_a_bop_scene_of_our_shapes_is_rebuilt_to_a_hundredth_of_a_millimetre_and_exported_alike(drawn, tmp_path):
    export_to(drawn, tmp_path / "bop", "bop")
    folders = sorted(path.parent for path in (tmp_path / "bop").glob("*/*/scene_gt.json"))
    assert len(folders) == THREE["scenes"]
    for folder in folders:
        number = int(folder.name)
        one = {**THREE, "scenes": 1, "first_scene": number, "scenes_from": str(folder)}
        rebuilt = make_dataset(tmp_path / f"rebuilt{number}", **one)[0]
        before, now = (
            next(r for r in rows_of(store, "scenes") if r["scene_id"] == number) for store in (drawn, rebuilt)
        )
        for body, other in zip(before["bodies"], now["bodies"], strict=True):
            assert np.abs(np.subtract(body["T_world_obj"], other["T_world_obj"])).max() < 1e-5
        assert faults_of(rebuilt) == audit.verify_independently(rebuilt, 1, lambda _: None).faults == []
        export_to(rebuilt, tmp_path / f"bop{number}", "bop")
        (other,) = (tmp_path / f"bop{number}").glob(f"*/{folder.name}")
        for name in ("scene_gt", "scene_camera", "scene_gt_info"):
            trees = [json.loads((path / f"{name}.json").read_text()) for path in (folder, other)]
            assert trees[0].keys() == trees[1].keys()
            numbers = [np.array(list(numbers_in(tree))) for tree in trees]
            assert numbers[0].shape == numbers[1].shape and np.abs(numbers[0] - numbers[1]).max() < 1e-6


def test_a_bop_scene_of_other_models_stands_where_their_own_frames_say(tmp_path):
    """A model in millimetres whose frame is off its middle, mapped by the user's objects.csv: its corners are where they were."""
    model = box(60.0, 80.0, 120.0, at=(200.0, -30.0, 60.0))
    (tmp_path / "models").mkdir()
    model.export(tmp_path / "models/obj_000005.ply")
    assets = {"objects": [library_of(tmp_path / "models", "carton", units=(("*", 0.001),))], **TRAYS["assets"]}
    job = {"categories": ["carton"], "assets": assets, "check": {"overlap_mm": 1e3}, "scenes": 1, "first_scene": 48}
    catalogue = open_sources(validate_job(overlaid(SMALL, job), "a test"), tmp_path)
    T_world_model, T_cam_world = (
        pose(rotation_about(np.array([0.0, 0.6, 0.8]), 0.7), np.array([0.1, 0.0, 0.9])),
        invert(look_down()),
    )
    T_cam_model = T_cam_world @ T_world_model
    camera = {"cam_K": [140.0, 0, 80.0, 0, 141.0, 60.0, 0, 0, 1], "cam_R_w2c": T_cam_world[:3, :3].ravel().tolist()}
    body = {
        "obj_id": 5,
        "cam_R_m2c": T_cam_model[:3, :3].ravel().tolist(),
        "cam_t_m2c": (1e3 * T_cam_model[:3, 3]).tolist(),
    }
    folder = tmp_path / "bop/test/000048"
    folder.mkdir(parents=True)
    cameras = {n: {**camera, "cam_t_w2c": (1e3 * T_cam_world[:3, 3]).tolist()} for n in (3, 4)}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps({3: [body], 4: [body]}))
    (tmp_path / "bop/camera.json").write_text(json.dumps({"width": 160, "height": 120}))
    (instance,) = (catalogue.refer(0, "carton", 0).instance_id,)
    (tmp_path / "bop/objects.csv").write_text(f"obj_id,instance_id\n5,{instance}\n")
    store = make_dataset(tmp_path / "out", **job, scenes_from=str(folder), pairs_per_scene=2)[0]
    (scene,), (asset, *_) = rows_of(store, "scenes"), (catalogue.load(catalogue.refer(0, "carton", 0)),)
    corners = transform(np.reshape(scene["T_world_obj"], (4, 4)), asset.shape.vertices)
    wanted = transform(T_world_model, 1e-3 * np.array(model.vertices))
    assert np.abs(np.sort(corners @ PLANE) - np.sort(wanted @ PLANE)).max() < 1e-5
    inputs = [view for view in rows_of(store, "views") if view["role"] == "input"]
    assert [(view["fx"], view["cx"], view["cy_opencv"]) for view in inputs] == [(140.0, 80.5, 60.0)] * 2
    assert faults_of(store) == audit.verify_independently(store, 1, lambda _: None).faults == []
    alone, _ = make_dataset(tmp_path / "alone", **job, scenes_from=str(folder), scene="studio", studio=UNIT)
    (turned,), (first,) = rows_of(alone, "scenes"), rows_of(alone, "views")
    pairs = (first["T_world_cam"], turned["T_world_obj"]), (inputs[0]["T_world_cam"], scene["T_world_obj"])
    seen = [invert(np.reshape(camera, (4, 4))) @ np.reshape(body, (4, 4)) for camera, body in pairs]
    assert np.abs(np.subtract(*seen)).max() < 1e-9


PLANE = np.array([0.3, 0.5, 0.81])
"""A direction along which no two corners of a box are at one place."""


def numbers_in(tree: Any) -> Any:
    """Every number of a tree of JSON, but for the number that an export gives to an instance."""
    if isinstance(tree, dict):
        tree = [value for key, value in tree.items() if key != "obj_id"]
    if not isinstance(tree, list):
        yield float(tree)
        return
    for value in tree:
        yield from numbers_in(value)


def test_what_is_kept_is_measured_where_it_was_put_and_what_settles_falls(standing, tmp_path):
    """Overlap and hover are how far the pose was moved from where the box rests; a camera in each row of an object is one."""
    camera = {
        "T_world_cam": as_list(look_down()),
        "fx": 140.0,
        "fy": 141.0,
        "cx": 80.5,
        "cy": 60.0,
        "width": 160,
        "height": 120,
    }
    rows = [
        row(0, moved(standing, z_mm=0.5)),
        row(1, moved(standing, z_mm=-0.5)),
        row(2, moved(standing, z_mm=300.0)),
        row(3, standing),
        row(4, moved(standing, z_mm=80.0), settle=True),
        row(5, standing, **camera),
        row(5, moved(standing, z_mm=400.0), **camera),
        {**row(6, moved(standing, z_mm=400.0)), "instance_id": None, "category": "can"},
    ]
    orbit = {"orbit": {"radius_m": "fit"}}  # which a camera of a table does not follow
    store = made(tmp_path, rows, scenes=7, categories=["box", "can"], cameras=orbit)
    scenes = rows_of(store, "scenes")
    assert rows_of(store, "failures") == [] and len(scenes) == 7
    found = [(row["hover_gap_mm"], row["penetration_mm"]) for row in scenes[:4]]
    assert np.abs(np.subtract(found, [(0.5, 0.0), (0.0, 0.5), (300.0, 0.0), (0.0, 0.0)])).max() < 0.011
    for number, T in ((0, moved(standing, z_mm=0.5)), (2, moved(standing, z_mm=300.0))):
        assert scenes[number]["T_world_obj"] == T.ravel().tolist() and scenes[number]["equilibrium_residual"] == 1.0
    assert "kept_poses" not in scenes[4]["effects"] and "dynamics" in scenes[4]["effects"]
    assert abs(scenes[4]["T_world_obj"][11] - standing[2, 3]) < 1e-4
    assert [body["hover_gap_mm"] > 19.0 for body in scenes[5]["bodies"]] == [False, True]
    (view,) = (view for view in rows_of(store, "views") if (view["scene_id"], view["role"]) == (5, "input"))
    assert {name: view[name] for name in camera} == {**camera, "T_world_cam": look_down().ravel().tolist()}
    assert scenes[6]["instance_id"].startswith("can-0-")
    assert faults_of(store) == audit.verify_independently(store, 7, lambda _: None).faults == []


def test_what_settles_falls_onto_what_is_kept_which_stays_and_both_have_the_contact(standing, tmp_path):
    """A box on one that is kept in the air, and beside it one on the table; `physics.friction` is lower for what is kept."""
    held, up, aside = moved(standing, z_mm=50.0), {"settle": True}, moved(standing, z_mm=80.0)
    held[1, 3], aside[1, 3] = -0.06, 0.06
    rows = [
        row(0, moved(held, z_mm=300.0), **up),
        row(0, held),
        row(0, aside, **up),
        {**row(0, moved(aside, z_mm=400.0)), "instance_id": None, "category": "can"},
    ]
    friction = {"box": 0.3, "table": 0.9}
    store = made(
        tmp_path, rows, scenes=1, categories=["box", "can"], physics={"friction": friction}, output={"layout": "tar"}
    )
    assert rows_of(store, "failures") == []
    (scene,), (height_m,) = (
        rows_of(store, "scenes"),
        {
            row["extents_m"][2]
            for row in ds.dataset(store.root / "manifest" / "assets").to_table().to_pylist()
            if row["instance_id"] == BOX
        },
    )
    over, kept, beside, can = scene["bodies"]
    assert kept["T_world_obj"] == held.ravel().tolist() and can["T_world_obj"][11] == aside[2, 3] + 0.4
    assert {"kept_poses", "dynamics", "object_contacts", "table_mesh"} <= set(scene["effects"])
    (why,) = (each["why"] for each in scene["skipped"] if each["effect"] == "restitution")
    assert why == "poses of scenes_from are kept, and what falls does not need it"
    assert abs(over["T_world_obj"][11] - held[2, 3] - height_m) < 1e-5
    assert abs(beside["T_world_obj"][11] - standing[2, 3]) < 1e-5
    assert {contact["with_region"] for contact in over["contacts"]} == {4}
    assert {contact["with_region"] for contact in beside["contacts"]} == {2}
    assert {contact["with_region"] for contact in kept["contacts"]} == {3}
    weight = sum(contact["force"][2] for contact in kept["contacts"])
    assert weight == pytest.approx(-9.81 * over["mass_kg"], rel=1e-6)
    assert audit.audit(store, 1, lambda _: None).faults == []
    assert faults_of(store) == audit.verify_independently(store, 1, lambda _: None).faults == []


CUBE, OPEN = asset_of(box(0.1, 0.1, 0.1)), box(0.1, 0.1, 0.1)
OPEN.update_faces(OPEN.face_normals[:, 2] < 0.5)
SMALL_CUBE, ON = asset_of(box(0.02, 0.02, 0.02)), place_table(table())
KEPT: dict[str, tuple[list[tuple[Asset, float, float]], list[tuple[float, float]] | str]] = {
    "beside another, in the air": ([(CUBE, 0.0, 0.0), (CUBE, 0.105, 0.2)], [(0.0, 0.0), (200.0, 0.0)]),
    "above another": ([(CUBE, 0.0, 0.0), (CUBE, 0.0, 0.107)], [(0.0, 0.0), (7.0, 0.0)]),
    "on the floor": ([(CUBE, 2.0, -0.7)], [(0.0, 0.0)]),
    "in the floor": ([(CUBE, 2.0, -0.7003)], [(0.0, 0.3)]),
    "under the table": ([(CUBE, 0.0, -0.3)], [(400.0, 0.0)]),
    "in an open shell": ([(asset_of(OPEN), 0.0, 0.0), (SMALL_CUBE, 0.0, 0.04)], [(0.0, 0.0), (40.0, 0.0)]),
    "an open shell in the table": ([(asset_of(OPEN), 0.0, -0.015)], "region 3 (box-test) is 15.00 mm inside the table"),
    "whole in another": (
        [(CUBE, 0.0, 0.0), (SMALL_CUBE, 0.0, 0.04)],
        "region 3 (box-test) is 20.00 mm inside region 4",
    ),
}


@pytest.mark.parametrize("name", KEPT)
def test_overlap_and_hover_are_distances_of_the_true_bodies(name):
    """Of cubes over a table of 0.7 m: (asset, x, height of its underside over the table, metres), and (hover, overlap) in mm."""
    things, figures = KEPT[name]
    poses = [pose(np.eye(3), np.array([x, 0.0, 0.7 + z_m + asset.extents_m[2] / 2])) for asset, x, z_m in things]
    starts = [
        start_at(asset, T, 3 + n, placed=True) for n, ((asset, _, _), T) in enumerate(zip(things, poses, strict=True))
    ]
    if isinstance(figures, str):
        with pytest.raises(SettleError, match=re.escape(figures)):
            keep_scene(scene_of(starts, ON), PHYSICS, EffectPlan((), {}), 1.0)
        return
    kept = keep_scene(scene_of(starts, ON), PHYSICS, EffectPlan((), {}), 1.0).settled
    assert np.abs(np.subtract([(each.hover_gap_mm, each.penetration_mm) for each in kept], figures)).max() < 1e-6


def look_down() -> np.ndarray:
    """A camera 2.5 m up that looks straight down."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 2.5
    return T


def test_a_row_that_cannot_be_fails_its_scene_alone_with_the_figure(standing, tmp_path):
    mirrored, scaled, lost = standing.copy(), standing.copy(), standing.copy()
    mirrored[:3, 0] *= -1.0
    scaled[:3, :3] *= 1.1
    lost[0, 3] = math.nan
    below = look_down()
    below[2, 3] = -0.1
    scenes: list[tuple[list[dict[str, Any]], str]] = [
        ([row(0, standing)], ""),
        ([row(0, moved(standing, z_mm=-3.0))], "is 3.00 mm inside the table, and check.overlap_mm is 1"),
        ([row(0, standing), row(0, moved(standing, x_mm=5.0))], "inside region 4 (box-0-000005)"),
        ([row(0, moved(standing, z_mm=-2000.0))], "inside the floor"),
        (
            [{**row(0, standing), "instance_id": "box-9-000001"}],
            "object 0 of scene 4: no source in assets.objects has 'box-9-000001'",
        ),
        (
            [{**row(0, standing), "instance_id": None, "category": "zebra"}],
            "no source in assets.objects offers 'zebra'",
        ),
        ([{**row(0, standing), "category": "can"}], "box-0-000005 is a box, and category is 'can'"),
        ([{**row(0, standing), "table_id": "tray-7-000000"}], "no source in assets.tables has 'tray-7-000000'"),
        ([row(0, lost)], "row 0 of scene 8 in"),
        ([row(0, mirrored)], "T_world_obj mirrors: its determinant is -1"),
        ([row(0, scaled)], "T_world_obj is no rotation"),
        ([row(0, standing), row(0, standing)], "rows 0 and 1 of scene 11 in"),
        (
            [row(0, standing, settle=True), row(0, moved(standing, x_mm=5.0))],
            "regions 4 and 3 begin ",
        ),
        ([row(0, standing, sha256="0" * 64)], "had 000000000000: its source, or Verso, is of another version"),
        (
            [row(0, standing, T_world_cam=as_list(below))],
            "camera input, number 0, at (0.000, 0.000, -0.100) m is below the floor: move",
        ),
        ([row(0, standing, T_world_cam=as_list(look_down()), fx=100.0)], "width is None, and must be from 1 to 4096"),
        ([row(0, None, T_world_cam=as_list(look_down()))], "has 0 objects, and must have 1 to 50"),
    ]
    rows = [{**each, "scene_id": number} for number, (some, _) in enumerate(scenes) for each in some]
    store = made(tmp_path, rows, scenes=len(scenes))
    failures = {failure["scene_id"]: failure for failure in rows_of(store, "failures")}
    assert [scene["scene_id"] for scene in rows_of(store, "scenes")] == [0]
    for number, (_, words) in enumerate(scenes):
        assert not words or (words in failures[number]["detail"] and failures[number]["kind"] == "intrinsic"), failures[
            number
        ]


def test_a_table_is_read_alike_in_every_form_and_by_the_rows_of_its_scene(tmp_path):
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (200, 1, 1))
    T[:, :3, 3] = rng.uniform(-1.0, 1.0, (200, 3))
    ids = rng.permutation(np.repeat(np.arange(100), 2)).tolist()
    names = [f"box-0-{number:06d}" for number in range(200)]
    elements = {f"T{i}{j}": T[:, i, j].tolist() for i in range(4) for j in range(4)}
    flat = pa.table({"scene_id": ids, "instance_id": names, "settle": [None] * 199 + [True], **elements})
    pq.write_table(flat, tmp_path / "a.parquet", row_group_size=30)
    pa.csv.write_csv(flat, tmp_path / "a.csv")
    (tmp_path / "flat.json").write_text(json.dumps(flat.to_pylist()))
    nested = [
        {"scene_id": s, "instance_id": n, "T_world_obj": t.tolist()} for s, n, t in zip(ids, names, T, strict=True)
    ]
    (tmp_path / "nested.json").write_text(json.dumps([*nested[:199], {**nested[199], "settle": True}]))
    for name in ("a.parquet", "a.csv", "flat.json", "nested.json"):
        file = open_sources(job_of(tmp_path / name, scenes=100), tmp_path).scenes
        for scene_id in (0, 63, 64, 99, ids[199]):
            there = read_scene(file, scene_id).objects
            wanted = [n for n in range(200) if ids[n] == scene_id]
            assert [each.instance_id for each in there] == [names[n] for n in wanted], name
            assert all((each.T_world_obj == T[n]).all() for each, n in zip(there, wanted, strict=True))
            assert [each.settle for each in there] == [n == 199 for n in wanted]


def job_of(path: Path, **changes: Any) -> Any:
    return validate_job(overlaid(SMALL, {"scenes_from": str(path), **changes}), "a test")


BAD: dict[str, tuple[Any, str]] = {
    "few.json": (
        [row(4, np.eye(4)), row(5, np.eye(4))],
        "2 of 2 scenes have no row, the first is 0: its ids are 4 to 5: set",
    ),
    "none.json": ([], "has no column instance_id or category"),
    "columns.csv": (
        "scene_id,x\n0,1\n",
        "has no column instance_id or category; no T_world_obj, nor T00 to T33; its columns are",
    ),
    "ids.csv": ("scene_id,category,T_world_obj\nx,box,1\n", "scene_id is string, and must be whole numbers"),
    "half.json": ([{**row(0, np.eye(4)), "scene_id": 0.5}], "scene_id is no whole number after row 0"),
    "scenes.txt": ("1", "its name ends in .txt: .csv, .parquet and .json are read"),
    "absent.csv": (None, "absent.csv cannot be read: No such file"),
    "many.json": ([row(0, None)] * 10_001 + [row(1, None)], "scene 0 has 10001 rows, and must have 1 to 10000"),
    "folder": ({}, "holds no manifest of a finished dataset, and no scene_gt.json of a scene in the BOP layout"),
    "running": ({"manifest/x": ""}, "is no finished dataset, it has no _SUCCESS"),
    "newer": ({"manifest/x": "", "_SUCCESS": '{"schema_version": 9}'}, "has schema_version 9, and up to 1 can be read"),
    "000000": ({"scene_gt.json": "{}"}, "no objects.csv beside it says which shapes these are"),
    "000001": ({"scene_gt.json": "{}", "objects.csv": ""}, "has no camera.json beside"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_table_of_scenes_that_cannot_be_used_is_refused_in_one_line(tmp_path, name):
    content, words = BAD[name]
    path = tmp_path / name
    if isinstance(content, dict):
        path.mkdir()
        for file, text in content.items():
            (path / file).parent.mkdir(exist_ok=True)
            (path / file).write_text(text)
    elif content is not None:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(AssetSourceError) as caught:
        open_sources(job_of(path), tmp_path)
    line = str(caught.value)
    assert line.startswith("scenes_from: ") and words in line and "\n" not in line, line


def test_the_content_of_a_table_decides_and_not_its_place_and_more_of_its_scenes_extend_a_dataset(standing, tmp_path):
    rows = [row(number, moved(standing, x_mm=number)) for number in range(4)]
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
    whole = make_dataset(tmp_path / "whole", **table_in(tmp_path / "here", rows), scenes=4)[1]
    make_dataset(tmp_path / "grown", **table_in(tmp_path / "there", rows), scenes=2)
    assert make_dataset(tmp_path / "grown", **table_in(tmp_path / "there", rows), scenes=4)[1] == whole
    table_in(tmp_path / "here", [row(number, moved(standing, x_mm=number + 1.0)) for number in range(4)])
    job = job_of(tmp_path / "here/scenes.json", scenes=4, **TRAYS)
    with pytest.raises(OutputError, match="belongs to another job"):
        record_job(job, open_sources(job, tmp_path).digest, tmp_path, out=LocalStore(tmp_path / "whole"))


def table_in(folder: Path, rows: list[dict[str, Any]]) -> dict[str, Any]:
    (folder / "scenes.json").write_text(json.dumps(rows))
    return {"scenes_from": str(folder / "scenes.json"), **TRAYS}


def test_the_independent_check_finds_an_object_and_a_camera_that_are_not_the_tables(again, monkeypatch):
    def elsewhere(file: Any, scene_id: int) -> Any:
        given = read_scene(file, scene_id)
        for T in (given.objects[0].T_world_obj, given.cameras[0][0]):
            T[0, 3] += 1e-6
        return given

    monkeypatch.setattr(audit, "read_scene", elsewhere)
    faults = "; ".join(audit.verify_independently(again, 1, lambda _: None).faults)
    assert "T_world_obj of region 3 is not what scenes_from has" in faults
    assert "T_world_cam of the input view is not what scenes_from has" in faults


READ = """
import sys
from pathlib import Path
from workers.assets.poses import PoseFile
from workers.assets.scene_tables import read_scene
for scene_id in (0, 70, int(sys.argv[2])):
    read_scene(PoseFile(Path(sys.argv[1]), ""), scene_id)
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.minute
def test_a_worker_holds_a_few_scenes_of_a_million_rows(tmp_path):
    """Its memory is that of a thousand rows and a few blocks, though all rows are in one group."""
    peaks = []
    for count in (1_000, 1_000_000):
        T = np.tile(np.eye(4).ravel(), (count, 1))
        T[:, 3] = np.random.default_rng(0).random(count)
        columns = {f"T{n // 4}{n % 4}": T[:, n] for n in range(16)}
        million = pa.table(
            {"scene_id": np.arange(count), "instance_id": pa.array([BOX]).take(pa.array([0] * count)), **columns}
        )
        pq.write_table(million, tmp_path / "a.parquet", row_group_size=count)
        command = [sys.executable, "-c", READ, str(tmp_path / "a.parquet"), str(count - 1)]
        peaks.append(int(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    assert peaks[1] - peaks[0] < 60 * 1024, peaks
