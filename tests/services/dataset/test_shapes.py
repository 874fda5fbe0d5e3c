"""Meshes of a dataset's objects lie where its images and its text files say."""

import shutil

import numpy as np
import pyarrow.compute as pc
import pytest
import trimesh

from schemas.errors import CorruptError, InputError
from services.dataset.dataset import open_dataset
from services.job.record import encode_job, read_job
from tests.datasets import make_dataset


def ray_depths(meshes, view, rows, columns) -> np.ndarray:
    """z along the optical axis where rays through pixel centres first meet the meshes, by trimesh's ray caster."""
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    rays = (np.linalg.inv(view.K) @ pixels).T
    found = np.full(len(rays), np.inf)
    for mesh in meshes:
        places, at, _ = mesh.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
        np.minimum.at(found, at, places[:, 2])
    return found


def test_a_posed_mesh_has_the_depth_of_the_image_in_every_camera(dataset):
    (pair, *_) = dataset.pairs()
    for view in (pair.input, pair.aligned, pair.mirror):
        depth, region = view.depth_m(), view.segment()
        for number in (2, 3):
            rows, columns = np.nonzero((region == number) & (depth > 0))
            some = slice(None, None, max(1, len(rows) // 200))
            traced = ray_depths([pair.mesh(number, view)], view, rows[some], columns[some])
            assert np.median(np.abs(traced - depth[rows, columns][some])) < 2e-4
            assert np.isfinite(traced).mean() > 0.95


def test_a_mesh_in_the_world_is_the_glb_at_the_pose_of_objects_dat(files):
    (pair, *_) = open_dataset(files.root).pairs()
    line = next(
        words
        for words in map(str.split, (files.root / "objects.dat").read_text().splitlines())
        if words[0] == str(pair.pose_id) and words[3] == "3"
    )
    T_cam_obj = np.array(line[6:], float).reshape(4, 4)
    glb = trimesh.load_mesh(files.root / "assets" / line[1] / f"{line[2]}.glb", process=False)
    seen = trimesh.transform_points(glb.vertices, T_cam_obj)
    assert pair.mesh(3, pair.input).bounds == pytest.approx(np.stack([seen.min(axis=0), seen.max(axis=0)]), abs=1e-6)
    world = trimesh.transform_points(seen, pair.input.T_world_cam)
    assert pair.mesh().bounds == pytest.approx(np.stack([world.min(axis=0), world.max(axis=0)]), abs=1e-6)


def test_a_mesh_may_be_changed_without_changing_the_next(dataset):
    (pair, *_) = dataset.pairs()
    before = pair.mesh().bounds
    pair.mesh().apply_scale(9.0)
    assert np.array_equal(pair.mesh().bounds, before)


def test_each_of_several_objects_has_its_own_shape(tmp_path):
    store, _ = make_dataset(tmp_path, scenes=1, objects_per_scene=3, categories=["box", "camera", "bottle"])
    (pair,) = open_dataset(store.root).pairs()
    for number in (3, 4, 5):
        (instance,) = [body["instance_id"] for body in pair.scene["bodies"] if body["region_id"] == number]
        (row,) = (
            open_dataset(store.root).table("assets").to_table(filter=pc.field("instance_id") == instance).to_pylist()
        )
        own = trimesh.transform_points(pair.mesh(number).vertices, np.linalg.inv(pair.T_world[number]))
        assert np.ptp(own, axis=0) == pytest.approx(row["extents_m"], abs=1e-6)


@pytest.fixture
def copy(files, tmp_path):
    shutil.copytree(files.root, tmp_path / "copy")
    return tmp_path / "copy"


def test_a_shape_that_is_not_stored_comes_from_the_source(files, copy):
    shutil.rmtree(copy / "assets")
    for stored, made in zip(open_dataset(files.root).pairs(), open_dataset(copy).pairs(), strict=True):
        for number in (2, 3):
            assert made.mesh(number).bounds == pytest.approx(stored.mesh(number).bounds, abs=1e-6)


def test_a_source_that_is_gone_or_another_is_told(copy, files):
    shutil.rmtree(copy / "assets")
    store = type(files)(copy)
    record = read_job(store)
    gone = {"objects": [{"source": "urdf", "folder": "/nowhere", "category_map": {"*": "mug"}}]}
    job = type(record.job).model_validate({**record.job.model_dump(mode="json"), "assets": gone})
    store.put("job.yaml", encode_job(type(record)(job, record.digest, record.catalogue, record.folder)))
    (pair, *_) = open_dataset(copy).pairs()
    with pytest.raises(InputError, match=r"assets/mug/.*\.glb is not in the dataset.*/nowhere"):
        pair.mesh()


def test_a_damaged_shape_is_named(copy):
    for path in (copy / "assets").rglob("*.glb"):
        path.write_bytes(b"glTF and no more")
    (pair, *_) = open_dataset(copy).pairs()
    with pytest.raises(CorruptError, match=r"\.glb cannot be read"):
        pair.mesh()
