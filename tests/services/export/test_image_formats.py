"""NOCS and nerfstudio, read back as their loaders do it (tests/services/export/image_loaders.py)."""

import json

import numpy as np
import pytest

from tests.datasets import make_dataset
from tests.judge.nearest import distances_to_faces
from tests.services.export.exported import export_to, source_image, source_rows
from tests.services.export.image_loaders import load_frames, load_pictures, umeyama

SPLITS = ("train", "val", "test")
ALIGNED = {"aligned": "Aligned"}
Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Takes our object frame to that of NOCS."""
TO_THEIR_CAMERA = np.diag([-1, -1, 1])
"""Takes an optical frame to that of `backproject`."""


def rows_by(store, table, *keys):
    return {tuple(row[key] for key in keys): row for row in source_rows(store.root, table)}


# ------------------------------------------------------------------------------------------------ NOCS


@pytest.fixture(scope="module")
def nocs(shaped, heap, tmp_path_factory):
    """(dataset, folder, manifest) of single objects, and of a pile."""
    place = tmp_path_factory.mktemp("nocs")
    stores = {"shaped": shaped, "heap": heap}
    return {
        name: (store, place / name, export_to(store, place / name, "nocs").manifest) for name, store in stores.items()
    }


def pictures_of(folder):
    return [picture for split in SPLITS if (folder / split).is_dir() for picture in load_pictures(folder, split)]


@pytest.mark.minute
@pytest.mark.parametrize("name", ["shaped", "heap"])
def test_coordinates_and_depth_give_the_pose_and_the_size_of_every_object(name, nocs):
    """What their evaluation does: the similarity from coordinates to back-projected depth is pose and diagonal."""
    store, folder, manifest = nocs[name]
    pictures, assets = pictures_of(folder), rows_by(store, "assets", "instance_id")
    labels, objects = rows_by(store, "objects", "pose_id", "role", "instance_id"), 0
    assert len(pictures) == sum(manifest["images"].values()) == 3 * len(rows_by(store, "scenes", "scene_id"))
    for picture in pictures:
        row = picture.row
        word = ALIGNED.get(row["role"], "")
        category = rows_by(store, "views", "pose_id", "role")[int(row["pose_id"]), row["role"]]["category"]
        np.testing.assert_array_equal(
            picture.color, source_image(store.root, category, f"RGB{word.lower()}", int(row["pose_id"]))
        )
        region = source_image(store.root, category, f"segment{word}", int(row["pose_id"]))
        for one in picture.instances:
            label, asset = labels[int(row["pose_id"]), row["role"], one.name], assets[one.name,]
            np.testing.assert_array_equal(one.mask, region == label["region_id"])
            assert one.class_id == manifest["classes"][asset["category"]]
            extents = np.array(asset["extents_m"])
            diagonal = np.linalg.norm(extents)
            np.testing.assert_allclose(one.scales, extents[[0, 2, 1]] / diagonal, atol=1e-9)
            np.testing.assert_allclose(np.ptp(one.vertices, axis=0), one.scales, atol=1e-6)
            seen = one.mask & (picture.depth_mm > 0)
            coords, points = one.coords[seen] - 0.5, picture.points_mm(one.mask)
            off = distances_to_faces(coords[::5], one.vertices[one.faces])
            assert off.max() < 0.005, "half a step of 8 bits is 0.002, along each axis"
            T = np.reshape(label["T_cam_obj"], (4, 4))
            R = TO_THEIR_CAMERA @ T[:3, :3] @ Y_UP.T
            expected = 1000.0 * (diagonal * coords @ R.T + TO_THEIR_CAMERA @ T[:3, 3])
            assert np.abs(points - expected).max() < 2.5, "a step of 8 bits is 1 mm, half a unit of depth 0.5 mm"
            if seen.sum() > 300:
                scale, found, at = umeyama(coords, points)
                assert np.linalg.det(found) > 0 and scale == pytest.approx(1000.0 * diagonal, rel=0.02)
                assert np.degrees(np.arccos(np.clip((np.trace(found.T @ R) - 1) / 2, -1, 1))) < 1.0
                np.testing.assert_allclose(at, TO_THEIR_CAMERA @ T[:3, 3] * 1000.0, atol=3.0)
                objects += 1
    assert objects >= 3


def test_models_stay_right_way_out_and_classes_have_the_numbers_of_nocs(nocs):
    _, folder, manifest = nocs["heap"]
    assert {"bottle": 1, "camera": 3, "box": 7}.items() <= manifest["classes"].items()
    for path in folder.glob("obj_models/*/*/*/model.obj"):
        words = [line.split() for line in path.read_text().splitlines()]
        vertices = np.array([one[1:] for one in words if one[0] == "v"], float)
        a, b, c = vertices[np.array([one[1:] for one in words if one[0] == "f"], int).T - 1]
        assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0, "the volume of the stored model"


def test_a_folder_that_is_full_is_followed_by_the_next(heap, tmp_path, monkeypatch):
    monkeypatch.setattr("services.export.articles.IN_FOLDER", 2)
    export_to(heap, tmp_path / "new", "nocs")
    files = sorted(
        path.relative_to(tmp_path / "new").as_posix() for path in (tmp_path / "new").glob("*/0*/*_color.png")
    )
    assert [file.partition("/")[2] for file in files] == [
        f"{name}_color.png" for name in ("00000/0000", "00000/0001", "00001/0000")
    ]


# ------------------------------------------------------------------------------------------------ nerfstudio


@pytest.fixture(scope="module")
def nerf(shaped, tmp_path_factory):
    folder = tmp_path_factory.mktemp("nerf") / "new"
    return folder, export_to(shaped, folder, "nerf").manifest


def test_input_and_mirror_views_are_trained_on_and_the_depth_cameras_are_held_out(nerf):
    folder, manifest = nerf
    paths = sorted(folder.glob("*/*/transforms.json"))
    assert len(paths) == sum(manifest["nerf_scenes"].values()) == manifest["scenes"] == 3 and manifest["frames"] == 9
    for path in paths:
        names = {key: [frame.path.rpartition("_")[2] for frame in frames] for key, frames in load_frames(path).items()}
        beside = ["aligned.png"]
        assert names == {"train": ["input.png", "mirror.png"], "val": beside, "test": beside}
    first = load_frames(paths[0])["train"][0]
    assert first.T_world_cam[2, 3] > 1.5 and first.T_world_cam[2, 2] > 0, "z is up, and a camera looks along -z"


def test_the_floor_is_flat_and_an_object_fills_its_box_in_every_frame(nerf, shaped):
    """A half pixel would move the floor by 4 mm."""
    folder, _ = nerf
    assets = rows_by(shaped, "assets", "instance_id")
    for path in folder.glob("*/*/transforms_objects.json"):
        (thing,) = json.loads(path.read_text())["objects"]
        T, half = np.linalg.inv(thing["transform_matrix"]), np.array(assets[thing["instance_id"],]["extents_m"]) / 2
        for frame in (frame for frames in load_frames(path).values() for frame in frames):
            points, pixels = frame.points()
            floor = points[np.abs(points[:, 2]) < 0.02]
            assert np.percentile(np.abs(floor[:, 2]), 98) < 0.001, "the table's legs come down to it"
            own = points[frame.mask[tuple(pixels.T)] > 0] @ T[:3, :3].T + T[:3, 3]
            assert (np.abs(own) < half + 0.001).all()


def test_a_scene_with_masks_counts_its_objects_alone(nerf, shaped):
    folder, _ = nerf
    for path in folder.glob("*/*/transforms_objects.json"):
        for frame in (frame for frames in load_frames(path).values() for frame in frames):
            number, _, role = frame.path.removeprefix("images/").removesuffix(".png").partition("_")
            word, pose_id = ALIGNED.get(role, ""), int(number) + (role == "mirror")
            category = next(iter(shaped.root.glob(f"*/segment{pose_id:05d}.png")), None)
            category = category or next(iter(shaped.root.glob(f"*/segment{word}{pose_id:05d}.png")))
            region = source_image(shaped.root, category.parent.name, f"segment{word}", pose_id)
            np.testing.assert_array_equal(frame.mask, np.where(region >= 3, 255, 0))


def test_without_a_depth_camera_all_views_are_trained_on_and_a_lens_leaves_depth_and_masks_out(tmp_path):
    lens = {"distortion": {"k1": 0.05}}
    changes = {"scenes": 1, "categories": ["can"], "cameras": {"depth": {"enabled": False}}, "sensor": lens}
    store, _ = make_dataset(tmp_path / "out", **changes)
    manifest = export_to(store, tmp_path / "new", "nerf").manifest
    (path,) = (tmp_path / "new").glob("*/*/transforms.json")
    text = path.read_text()
    assert json.loads(text)["val_filenames"] == ["images/00000_input.png", "images/00000_mirror.png"]
    assert '"k1": 0.05' in text and "depth_file_path" not in text and not (path.parent / "masks").exists()
    assert manifest["frames"] == 2 and any("lens" in line for line in manifest["not_exported"])
