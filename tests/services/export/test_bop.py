"""The BOP layout, read back by a reader that knows nothing but its description (tests/bop_reader.py)."""

import csv
import json

import numpy as np
import pytest
import trimesh

from tests.bop_reader import load_model, load_shots, points_in_model
from tests.datasets import make_dataset
from tests.exported import contents, export_to, source_image, source_rows

PLACES = {"input": 0, "aligned": 1, "mirror": 2}
WORDS = {"input": ("RGB", "depth", "segment"), "aligned": ("RGBaligned", "depthAligned", "segmentAligned")}


@pytest.fixture(scope="module")
def exported(files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bop") / "new"
    return folder, export_to(files, folder, "bop").manifest


@pytest.fixture(scope="module")
def heaped(pile, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bop") / "heap"
    export_to(pile, folder, "bop")
    return folder


def shots_of(folder):
    splits = [folder / name for name in ("train", "val", "test") if (folder / name).is_dir()]
    return [shot for split in splits for shot in load_shots(split)]


def instances_of(folder):
    with (folder / "objects.csv").open() as file:
        return {int(row["obj_id"]): row["instance_id"] for row in csv.DictReader(file)}


def views_by_place(store):
    """Rows of `views` by (scene, number of the image)."""
    rows = source_rows(store.root, "views")
    firsts = {row["scene_id"]: row["parent_id"] for row in sorted(rows, key=lambda row: -row["parent_id"])}
    return {
        (row["scene_id"], 3 * ((row["parent_id"] - firsts[row["scene_id"]]) // 2) + PLACES[row["role"]]): row
        for row in rows
        if row["role"] in PLACES
    }


def test_every_view_is_there_with_its_pose_camera_depth_and_colour(files, exported):
    folder, manifest = exported
    shots, views = {(shot.scene, shot.number): shot for shot in shots_of(folder)}, views_by_place(files)
    assert shots.keys() == views.keys() and len(shots) == manifest["images"] == 24
    assert (manifest["pairs"], manifest["pairs_left_out"]) == (8, 0)
    for key, row in views.items():
        shot, T = shots[key], np.reshape(row["T_world_cam"], (4, 4))
        T_world_cam = np.linalg.inv(shot.T_cam_world)
        np.testing.assert_allclose(T_world_cam[:3, :3], T[:3, :3], atol=1e-6)
        np.testing.assert_allclose(T_world_cam[:3, 3] / 1000.0, T[:3, 3], atol=1e-6)
        K = [[row["fx"], 0, row["cx_opencv"]], [0, row["fy"], row["cy_opencv"]], [0, 0, 1]]
        np.testing.assert_allclose(shot.K, K, atol=1e-9)
        rgb, depth, _ = WORDS["aligned" if row["role"] == "aligned" else "input"]
        stored = source_image(files.root, row["category"], depth, row["pose_id"])
        assert np.abs(shot.depth_mm - stored / 5.0).max() < 1e-9
        np.testing.assert_array_equal(shot.rgb, source_image(files.root, row["category"], rgb, row["pose_id"]))


@pytest.mark.parametrize("name", ["files", "pile"])
def test_every_object_has_its_pose_and_its_visible_mask(name, exported, heaped, request):
    store, folder = request.getfixturevalue(name), exported[0] if name == "files" else heaped
    names, views = instances_of(folder), views_by_place(store)
    labels = [row for row in source_rows(store.root, "objects") if row["region_id"] >= 3]
    seen = 0
    for shot in shots_of(folder):
        view = views[shot.scene, shot.number]
        own = [row for row in labels if (row["pose_id"], row["role"]) == (view["pose_id"], view["role"])]
        own.sort(key=lambda row: row["region_id"])
        assert [names[thing.obj_id] for thing in shot.things] == [row["instance_id"] for row in own]
        word = WORDS["aligned" if view["role"] == "aligned" else "input"][2]
        segment = source_image(store.root, view["category"], word, view["pose_id"])
        for thing, row in zip(shot.things, own, strict=True):
            T = np.reshape(row["T_cam_obj"], (4, 4))
            np.testing.assert_allclose(thing.T_cam_model[:3, :3], T[:3, :3], atol=1e-6)
            np.testing.assert_allclose(thing.T_cam_model[:3, 3] / 1000.0, T[:3, 3], atol=1e-6)
            np.testing.assert_array_equal(thing.mask_visib, segment == row["region_id"])
            assert thing.info["bbox_visib"] == row["bbox_xywh"]
            assert thing.info["px_count_visib"] == row["pixels"]
            seen += 1
    assert seen == len(labels)


def test_what_others_hide_is_in_the_mask_and_counted(heaped, pile):
    """The renderer counted the unhidden pixels of each object when the scene was made: rays must find as many."""
    rows = {
        (row["role"], row["instance_id"]): row for row in source_rows(pile.root, "objects") if row["region_id"] >= 3
    }
    names, hidden = instances_of(heaped), 0
    for shot, role in zip(shots_of(heaped), PLACES, strict=True):
        for thing in shot.things:
            row, info = rows[role, names[thing.obj_id]], thing.info
            assert not (thing.mask_visib & ~thing.mask).any()
            assert info["px_count_all"] == pytest.approx(row["pixels"] / row["visible_fraction"], abs=2.5)
            assert info["px_count_valid"] == (thing.mask & (shot.depth_mm > 0)).sum()
            assert info["visib_fract"] == pytest.approx(row["visible_fraction"], abs=0.03)
            x, y, width, height = info["bbox_obj"]
            rows_of, columns_of = np.nonzero(thing.mask)
            assert (x, y, x + width, y + height) == (
                *(columns_of.min(), rows_of.min()),
                *(columns_of.max() + 1, rows_of.max() + 1),
            )
            hidden += row["visible_fraction"] < 0.8
    assert hidden >= 3


def test_what_the_depth_shows_of_an_object_lies_on_its_model(files, exported):
    """Poses, K, depth scale and models in one: a wrong pixel convention or unit would show."""
    folder, _ = exported
    worst = []
    for shot in shots_of(folder):
        for thing in shot.things:
            model = load_model(folder / "models" / f"obj_{thing.obj_id:06d}.ply")
            points = points_in_model(shot, thing, thing.mask_visib)[::7]
            corners = np.tile(model.vertices[model.faces], (len(points), 1, 1))
            repeated = np.repeat(points, len(model.faces), axis=0)
            nearest = trimesh.triangles.closest_point(corners, repeated)
            distance = np.linalg.norm(nearest - repeated, axis=1).reshape(len(points), -1)
            worst.append(distance.min(axis=1).max())
    assert max(worst) < 0.15  # half a unit of depth is 0.1 mm along the ray


def test_models_are_described_in_millimetres(files, exported):
    folder, manifest = exported
    infos = json.loads((folder / "models" / "models_info.json").read_text())
    assets = {row["instance_id"]: row for row in source_rows(files.root, "assets")}
    names = instances_of(folder)
    assert set(map(int, infos)) == set(names) == set(range(1, manifest["models"] + 1))
    for number, name in names.items():
        model, info = load_model(folder / "models" / f"obj_{number:06d}.ply"), infos[str(number)]
        extents = 1000.0 * np.array(assets[name]["extents_m"])
        np.testing.assert_allclose(np.ptp(model.vertices, axis=0), extents, atol=1e-3)
        np.testing.assert_allclose([info[f"size_{axis}"] for axis in "xyz"], extents, atol=1e-3)
        np.testing.assert_allclose([info[f"min_{axis}"] for axis in "xyz"], model.vertices.min(axis=0), atol=1e-3)
        some = model.vertices[:: max(1, len(model.vertices) // 400)]
        farthest = np.linalg.norm(some[:, None] - some, axis=2).max()
        assert farthest - 1e-3 <= info["diameter"] <= np.linalg.norm(extents) + 1e-3
        np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1.0, atol=1e-3)
        assert len(np.unique(model.colors, axis=0)) >= 1 and model.colors.max() > 0


def test_no_scene_of_train_shows_an_object_of_test(files, exported):
    folder, _ = exported
    split = {row["instance_id"]: row["split"] for row in source_rows(files.root, "assets")}
    names = instances_of(folder)
    for name in ("train", "val", "test"):
        if (folder / name).is_dir():
            shown = {split[names[thing.obj_id]] for shot in load_shots(folder / name) for thing in shot.things}
            assert shown == {name}


def test_tars_export_the_same_bytes_as_files(files, tars, exported, tmp_path):
    export_to(tars, tmp_path / "new", "bop")
    theirs, ours = contents(tmp_path / "new"), contents(exported[0])
    assert theirs.keys() == ours.keys()
    assert {key for key in ours if ours[key] != theirs[key]} == {"export.json"}


def test_captures_are_scenes_too(captures, tmp_path):
    manifest = export_to(captures, tmp_path / "new", "bop").manifest
    shots = shots_of(tmp_path / "new")
    assert manifest["pairs"] == 4 and len(shots) == 8  # there is no aligned view of a capture
    for shot in shots:
        (thing,) = shot.things
        assert (thing.mask | thing.mask_visib == thing.mask).all() and thing.mask_visib.any()
        points = points_in_model(shot, thing, thing.mask_visib)
        model = load_model(tmp_path / "new" / "models" / f"obj_{thing.obj_id:06d}.ply")
        low, high = model.vertices.min(axis=0) - 10.0, model.vertices.max(axis=0) + 10.0
        assert ((points > low) & (points < high)).all(axis=1).mean() > 0.9


def test_scenes_without_colour_are_left_out(tmp_path):
    store, _ = make_dataset(tmp_path / "out", scenes=1, categories=["can"], render={"rgb": False})
    manifest = export_to(store, tmp_path / "new", "bop").manifest
    assert manifest["left_out"] == {"no rgb of the input view": 1}
    assert json.loads((tmp_path / "new" / "camera.json").read_text()) == {}
