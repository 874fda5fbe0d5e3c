"""Occupancy Networks and PCN, read back as their loaders do it (tests/services/export/shape_loaders.py)."""

import csv
import json

import numpy as np
import pytest
import trimesh

from schemas.errors import InputError
from services.export.objects import NO_POINTS, NO_SAMPLES
from services.export.source import ExportScene
from tests.datasets import make_dataset
from tests.judge.nearest import distances_to_faces, winding_numbers
from tests.services.export.conftest import STUDIO
from tests.services.export.exported import export_to, source_image, source_rows
from tests.services.export.shape_loaders import load_completions, load_models

SPLITS = ("train", "val", "test")


@pytest.fixture(scope="module")
def exported(shaped, tmp_path_factory):
    """(folder, manifest) by format."""
    place = tmp_path_factory.mktemp("shapes")
    return {name: (place / name, export_to(shaped, place / name, name).manifest) for name in ("occnet", "pcn")}


def corners_of(store, category, name):
    """[F, 3, 3], object frame, metres."""
    mesh = trimesh.load_scene(store.root / "assets" / category / f"{name}.glb", process=False).to_mesh()
    return np.asarray(mesh.triangles)


def objects_of(store):
    """Rows of `assets` of objects, by instance."""
    return {row["instance_id"]: row for row in source_rows(store.root, "assets") if row["category"] != "table"}


def shown(store, row, view):
    """[N, 3] what stored depth shows of an object, its frame, metres, and the colours there: written from docs/dataset.md."""
    depth, region, rgb = (
        source_image(store.root, view["category"], word, view["pose_id"]) for word in ("depth", "segment", "RGB")
    )
    v, u = np.nonzero((region == row["region_id"]) & (depth > 0))
    z = depth[v, u] / view["depth_units_per_m"]
    rays = np.stack([(u + 0.5 - view["cx"]) / view["fx"], (v + 0.5 - view["cy"]) / view["fy"], np.ones(len(u))], axis=1)
    T = np.linalg.inv(np.reshape(row["T_cam_obj"], (4, 4)))
    return (rays * z[:, None]) @ T[:3, :3].T + T[:3, 3], rgb[v, u]


def views_of(store, name):
    """(row of `objects`, row of `views`) of an instance's input and mirror views, in order."""
    views = {(row["pose_id"], row["role"]): row for row in source_rows(store.root, "views")}
    rows = [row for row in source_rows(store.root, "objects") if row["instance_id"] == name]
    rows = [row for row in rows if row["role"] in ("input", "mirror")]
    return [(row, views[row["pose_id"], row["role"]]) for row in sorted(rows, key=lambda row: row["pose_id"])]


# ------------------------------------------------------------------------------------------------ Occupancy Networks


def models_of(folder):
    return {model.name: (split, model) for split in SPLITS for model in load_models(folder, split)}


@pytest.mark.minute
def test_every_object_is_in_the_list_of_its_split_with_occupancies_of_its_solid(shaped, exported):
    folder, manifest = exported["occnet"]
    models, objects = models_of(folder), objects_of(shaped)
    assert models.keys() == objects.keys() and sum(manifest["objects"].values()) == len(models)
    assert all((folder / category / f"{split}.lst").exists() for category in ("box", "can") for split in SPLITS)
    for name, (_, model) in models.items():
        corners, extents = corners_of(shaped, model.category, name), np.array(objects[name]["extents_m"])
        assert model.scale == pytest.approx(extents.max()) and np.abs(model.loc).max() < 1e-6
        for points, reach in ((model.points, 0.6), (model.cloud, 0.5 + 1e-6)):
            assert points.dtype == np.float32 and np.abs(points).max() <= reach
        some = slice(0, None, 31)
        inside = winding_numbers(model.points[some] * model.scale + model.loc, corners) > 0.5
        assert (inside == (model.occ[some] > 0.5)).mean() > 0.995 and 0.2 < inside.mean() < 0.8
        metres = model.cloud[some] * model.scale + model.loc
        assert distances_to_faces(metres, corners).max() < 1e-6
        np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1.0, atol=1e-5)


def test_cameras_project_the_cloud_onto_the_object_and_its_colours(shaped, exported):
    folder, manifest = exported["occnet"]
    seen = 0
    for name, (_, model) in models_of(folder).items():
        views = views_of(shaped, name)
        assert len(views) == len(model.shots)
        for (row, view), shot in zip(views, model.shots, strict=True):
            points, colors = shown(shaped, row, view)
            place = (model.seen(shot, (points - model.loc) / model.scale) + 1.0) / 2.0 * 137.0
            cloud = (model.seen(shot, model.cloud) + 1.0) / 2.0 * 137.0
            assert (cloud > 0).all() and (cloud < 137).all()
            apart = np.sqrt(((cloud[::4, None] - place[None]) ** 2).sum(-1)) * view["fx"] / shot.camera[0, 0]
            assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 1.5, (
                "pixels of the image between the silhouettes"
            )
            column, line = np.floor(place).astype(int).clip(0, 136).T
            gap = np.abs(shot.image[line, column].astype(int) - colors).mean(axis=1)
            shifted = np.abs(shot.image[line, (column + 6).clip(max=136)].astype(int) - colors).mean(axis=1)
            assert np.median(gap) < 6.0 and gap.mean() < shifted.mean()
            seen += 1
    assert seen == sum(manifest["images"].values()) == 6


def test_an_object_that_is_stored_with_alpha_has_images_without(tmp_path):
    far = {"sensor": STUDIO["cameras"]["sensor"], "more": [{"name": "far", "ring": {"count": 2, "radius_m": 6.0}}]}
    asked = {"shape": ["surface", "volume"], "points": 300}
    store, _ = make_dataset(tmp_path / "out", **{**STUDIO, "scenes": 1, "cameras": far, "targets": asked})
    assert sum(export_to(store, tmp_path / "new", "occnet").manifest["images"].values()) >= 2
    (model,) = (model for split in SPLITS for model in load_models(tmp_path / "new", split))
    assert len(model.shots) >= 2


def test_an_object_whose_shape_has_no_samples_is_left_out(shaped, tmp_path, monkeypatch):
    read, without = ExportScene.samples, min(objects_of(shaped))
    monkeypatch.setattr(ExportScene, "samples", lambda self, name: {} if name == without else read(self, name))
    manifest = export_to(shaped, tmp_path / "new", "occnet").manifest
    assert manifest["left_out"] == {NO_SAMPLES: 1} and manifest["pairs"] == 2
    assert models_of(tmp_path / "new").keys() == objects_of(shaped).keys() - {without}


def test_an_object_of_train_has_no_image_of_a_scene_that_shows_one_of_test(heap, tmp_path):
    manifest = export_to(heap, tmp_path / "new", "occnet", held_out=("camera",)).manifest
    models = models_of(tmp_path / "new")
    assert manifest["pairs"] == 1 and manifest["objects"] == {"test": len(models)}
    assert {split for split, _ in models.values()} == {"test"} and len(models) < len(objects_of(heap)) == 3
    assert {path.name for path in (tmp_path / "new").glob("*/*-*")} == models.keys()


# ------------------------------------------------------------------------------------------------ PCN


@pytest.mark.minute
def test_partial_clouds_lie_on_the_complete_one_and_show_what_the_depth_shows(shaped, exported):
    folder, manifest = exported["pcn"]
    samples = {one.name: (split, one) for split in SPLITS for one in load_completions(folder, split)}
    objects = objects_of(shaped)
    assert samples.keys() == objects.keys() and sum(manifest["partial"].values()) == 6
    with (folder / "views.csv").open() as file:
        listed = list(csv.DictReader(file))
    for name, (split, one) in samples.items():
        diagonal, corners = np.linalg.norm(objects[name]["extents_m"]), corners_of(shaped, one.category, name)
        assert np.linalg.norm(np.ptp(one.complete, axis=0)) == pytest.approx(1.0, abs=0.02)
        assert distances_to_faces(one.complete[::50], corners / diagonal).max() < 1e-6
        views = views_of(shaped, name)
        mine = [row for row in listed if row["instance_id"] == name]
        assert [(int(row["pose_id"]), row["role"], row["split"]) for row in mine] == [
            (view["pose_id"], view["role"], split) for _, view in views
        ]
        assert len(one.partial) == (8 if split == "train" else 1)
        for number, partial in enumerate(one.partial):
            points, _ = shown(shaped, *views[number % len(views)])
            np.testing.assert_allclose(partial * diagonal, points, atol=1e-6)
            assert (
                distances_to_faces(partial[::5], corners / diagonal).max() < 2e-4 / diagonal
            )  # half a unit of depth: 0.1 mm


def test_a_dataset_without_samples_has_complete_clouds_of_its_stored_shapes(pile, tmp_path):
    manifest = export_to(pile, tmp_path / "new", "pcn").manifest
    samples = [one for split in SPLITS for one in load_completions(tmp_path / "new", split)]
    assert len(samples) >= 2 and manifest["pairs"] == 1
    for one in samples:
        extents = np.array(objects_of(pile)[one.name]["extents_m"])
        corners = corners_of(pile, one.category, one.name) / np.linalg.norm(extents)
        assert distances_to_faces(one.complete[::100], corners).max() < 1e-6
    store, _ = make_dataset(tmp_path / "small", scenes=1, categories=["can"], cameras={"sensor": TINY})
    assert export_to(store, tmp_path / "none", "pcn").manifest["left_out"] == {NO_POINTS: 1}
    assert json.loads((tmp_path / "none" / "PCN.json").read_text()) == []


TINY = {"width": 40, "height": 30, "fx": 32.8125, "fy": 32.8125, "cx": 20.0, "cy": 15.0}


@pytest.mark.parametrize(
    ("name", "told"), [("occnet", r"targets\.shape: \[surface, volume\]"), ("nocs", r"targets\.views: \[coordinates\]")]
)
def test_a_dataset_without_the_targets_is_refused_before_anything_is_written(name, told, files, tmp_path):
    with pytest.raises(InputError, match=told):
        export_to(files, tmp_path / "new", name)
    assert not (tmp_path / "new").exists()
