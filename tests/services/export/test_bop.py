"""The BOP layout, read back by a reader that knows nothing but its description (tests/services/export/bop_reader.py)."""

import csv
import json
import shutil

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import pdist

from schemas.scene.shape import Part, Shape
from services.export.bop import NO_SHAPE, model_info, ply_lines
from services.export.shapes import box_of, reaches_edge, whole_silhouette
from tests.kit.shapes import shape_of
from tests.services.export.bop_reader import load_model, load_shots, points_in_model
from tests.services.export.exported import export_to, source_image, source_rows, without_sources
from tests.services.export.image_loaders import read_picture

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


def test_every_view_is_there_with_its_pose_camera_depth_colour_and_split(files, exported):
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
    names = instances_of(folder)
    shown = [{names[one.obj_id] for shot in load_shots(part) for one in shot.things} for part in folder.glob("t[re]*")]
    assert sum(map(len, shown)) == len(set().union(*shown)), "an object is in two splits"


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
            x, y, width, height = row[
                "bbox_xywh"
            ]  # bop_toolkit's calc_2d_bbox: last pixel less first, without one more
            assert thing.info["bbox_visib"] == ([x, y, width - 1, height - 1] if row["pixels"] else [-1] * 4)
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
                *(columns_of.max(), rows_of.max()),
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


def test_hidden_objects_without_a_shape_are_left_out(pile, tmp_path):
    bare = without_sources(pile, tmp_path / "copy")
    shutil.rmtree(bare.root / "assets")
    manifest = export_to(bare, tmp_path / "new", "bop").manifest
    assert manifest["left_out"] == {NO_SHAPE: 1} and not (tmp_path / "new" / "train").exists()
    assert manifest["models"] == 0 and any(line.startswith("3 models") for line in manifest["not_exported"])
    assert json.loads((tmp_path / "new" / "models" / "models_info.json").read_text()) == {}


def test_silhouettes_are_those_of_the_target_and_need_no_shape(heap, tmp_path):
    bare = without_sources(heap, tmp_path / "copy")
    shutil.rmtree(bare.root / "assets")
    for name, store in (("whole", heap), ("bare", bare)):
        manifest = export_to(store, tmp_path / name, "bop").manifest
        assert (manifest["pairs"], manifest["models"]) == (1, 3 if name == "whole" else 0)
        shots, views, seen = shots_of(tmp_path / name), views_by_place(store), 0
        rows = [row for row in source_rows(heap.root, "objects") if row["region_id"] >= 3]
        for shot in shots:
            view = views[shot.scene, shot.number]
            own = sorted(
                (one for one in rows if (one["pose_id"], one["role"]) == (view["pose_id"], view["role"])),
                key=lambda one: one["region_id"],
            )
            for number, (thing, row) in enumerate(zip(shot.things, own, strict=True)):
                word = f"amodal{'Aligned' if view['role'] == 'aligned' else ''}{view['pose_id']:05d}obj{number}"
                stored = read_picture(heap.root / view["category"] / f"{word}.png") > 0
                np.testing.assert_array_equal(thing.mask, stored)
                assert not (thing.mask_visib & ~thing.mask).any()
                x, y, width, height = row["amodal_bbox_xywh"]
                assert thing.info["bbox_obj"] == [x, y, width - 1, height - 1]
                assert thing.info["px_count_all"] == row["amodal_pixels"]
                assert thing.info["visib_fract"] == pytest.approx(row["visible_fraction"], abs=0.02)
                seen += row["visible_fraction"] < 0.9
        assert seen >= 2


# ------------------------------------------------------------------------------------------------ models


def test_a_shape_without_normals_gets_those_of_its_faces_and_a_flat_one_has_a_diameter(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.2))
    assert model_info(1000.0 * box.vertices)["diameter"] == pytest.approx(300.0)
    assert model_info(np.array([[0.0, 0, 0], [30, 0, 0], [30, 40, 0], [0, 40, 0]]))["diameter"] == pytest.approx(50.0)
    for seed, sizes in enumerate(((1, 1, 1), (50, 1, 1), (1, 1, 0), (1, 0, 0))):  # of 2,000 points: several blocks
        cloud = np.random.default_rng(seed).normal(size=(2000, 3)) * sizes + 100.0
        assert model_info(cloud)["diameter"] == pytest.approx(pdist(cloud).max(), rel=1e-12)
    ball = trimesh.creation.icosphere(4, 30.0)
    assert model_info(ball.vertices)["diameter"] == pytest.approx(pdist(ball.vertices).max(), rel=1e-12)
    (tmp_path / "box.ply").write_bytes(b"".join(ply_lines(shape_of(box))))
    model = load_model(tmp_path / "box.ply")
    np.testing.assert_allclose(model.vertices, 1000.0 * box.vertices, atol=1e-6)
    np.testing.assert_allclose(model.normals, box.vertex_normals, atol=1e-5)
    assert ((model.normals * model.vertices).sum(axis=1) > 0).all()
    np.testing.assert_allclose(trimesh.load(tmp_path / "box.ply", process=False).vertices, model.vertices, atol=1e-4)


# ------------------------------------------------------------------------------------------------ silhouettes


def square(left, right):
    mask = np.zeros((120, 160), bool)
    mask[40:80, max(left, 0) : max(right, 0)] = True
    return mask


@pytest.mark.parametrize(
    ("x_m", "left", "right", "seen"),
    [(0.001, 60, 100, 70), (-1.599, -20, 20, 20), (1.601, 140, 180, 160), (-4.999, -190, -150, 0)],
)
def test_a_silhouette_holds_what_is_hidden_and_what_lies_outside_the_image(x_m, left, right, seen):
    """A square plate two metres ahead: its silhouette is known in closed form."""
    corners = np.array([[-0.4, -0.4, 0.0], [0.4, -0.4, 0.0], [0.4, 0.4, 0.0], [-0.4, 0.4, 0.0]])
    plate = Shape((Part("plate", corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)),))
    T, lens = np.eye(4), {"width": 160, "height": 120, "fx": 100.0, "fy": 100.0, "cx": 80.0, "cy": 60.0}
    T[:3, 3] = x_m, 0.0, 2.0
    view = {**lens, "T_world_cam": np.eye(4).ravel().tolist()}
    label = {"T_cam_obj": T.ravel().tolist(), "visible_fraction": 0.5}
    found = whole_silhouette(label, view, square(left, seen), plate)
    np.testing.assert_array_equal(found.mask, square(left, right))
    assert (found.pixels, found.box) == (1600, (left, 40, 39, 39))
    assert whole_silhouette(label, view, square(left, seen), None) is None
    all_seen = whole_silhouette({**label, "visible_fraction": 1.0}, view, square(10, 30), None)
    assert (all_seen.pixels, all_seen.box) == (800, (10, 40, 19, 39))
    assert [reaches_edge(square(*ends)) for ends in ((10, 30), (0, 30), (140, 160))] == [False, True, True]
    assert box_of(np.zeros((4, 4), bool)) == (-1, -1, -1, -1)
    assert box_of(np.outer([0, 0, 1], [0, 1, 0]) > 0) == (1, 2, 0, 0)
