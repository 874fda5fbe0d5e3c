"""Meshes of a dataset's objects lie where its images and text files say; a scene made in memory is the stored one."""

import shutil

import numpy as np
import pytest
import trimesh
import yaml

from schemas.errors import CorruptError, InputError, JobError, SceneError
from schemas.job.assets import CATEGORIES
from services.dataset.dataset import make_scene, open_dataset
from services.job.job_file import validate_job
from services.job.record import encode_job, read_job
from tests.datasets import SMALL, make_dataset, overlaid
from tests.services.conftest import TWO_PAIRS
from tests.workers.assets.libraries import library_of
from workers.store.local import LocalStore

KEYS = overlaid(SMALL, TWO_PAIRS) | {"look": {"recolour": "as_made"}}


def test_a_mesh_is_the_same_in_every_form_and_may_be_changed(dataset, files):
    for pair, plain in zip(dataset.pairs(), open_dataset(files.root).pairs(), strict=True):
        assert np.array_equal(pair.mesh(2).vertices, plain.mesh(2).vertices)
        before = pair.mesh().bounds
        pair.mesh().apply_scale(9.0)
        assert np.array_equal(pair.mesh().bounds, before) and np.array_equal(before, plain.mesh().bounds)


def test_a_welded_mesh_is_watertight_where_the_asset_is_and_is_the_same_surface(tmp_path):
    make_dataset(
        tmp_path, scenes=8, categories={**dict.fromkeys(CATEGORIES, 1.0)}, images={"projection": {"enabled": False}}
    )
    closed = {row["instance_id"]: row for row in open_dataset(tmp_path).table("assets").to_table().to_pylist()}
    split = 0
    for pair in open_dataset(tmp_path).pairs():
        for region, name in ((2, pair.scene["table_id"]), (3, pair.instance_id)):
            plain, welded = pair.mesh(region), pair.mesh(region, welded=True)
            assert welded.is_watertight == closed[name]["watertight"], name
            assert welded.bounds == pytest.approx(plain.bounds) and welded.area == pytest.approx(plain.area)
            if welded.is_watertight:
                assert welded.is_winding_consistent and welded.volume == pytest.approx(
                    closed[name]["volume_m3"], rel=1e-4
                )
            split += not plain.is_watertight
    assert split > 4, "no mesh is split at seams: the test would see nothing"
    (pair, *_) = open_dataset(tmp_path).pairs()
    seen = pair.mesh(3, pair.input, welded=True)
    assert seen.bounds == pytest.approx(pair.mesh(3, pair.input).bounds)
    assert trimesh.proximity.closest_point(seen, seen.triangles_center[:5])[1].max() < 1e-9  # which asks rtree


@pytest.mark.minute
def test_colours_of_vertices_are_shown_by_a_mesh_and_by_a_stored_file_read_as_the_page_says(
    tmp_path,
):
    """A ball, red below and green above; the colours of a GLB are linear: of 200 in sRGB, 0.5776 (IEC 61966-2-1)."""
    ball = trimesh.creation.icosphere(2, 0.05)
    ball.visual.vertex_colors = np.where(ball.vertices[:, 2:] < 0, [200, 0, 0, 255], [0, 200, 0, 255])
    (tmp_path / "ply").mkdir()
    ball.export(tmp_path / "ply/a.ply")
    source = {**library_of(tmp_path / "ply"), "copy_assets": True}
    folder = tmp_path / "out"
    make_dataset(folder, scenes=1, categories={"mug": 1.0}, assets={"objects": [source]})
    (pair,) = open_dataset(folder).pairs()
    (path,) = (folder / "assets/mug").glob("*.glb")
    level = round(255 * ((200 / 255 + 0.055) / 1.055) ** 2.4)
    posed = pair.mesh().apply_transform(np.linalg.inv(pair.T_world[3]))
    for mesh in (posed, trimesh.load_mesh(path, process=False, skip_materials=True)):
        wanted = np.where(mesh.vertices[:, 2:] < -1e-6, [level, 0, 0, 255], [0, level, 0, 255])
        assert np.abs(mesh.visual.vertex_colors.astype(int) - wanted).max() <= 1


def test_a_shape_that_is_not_stored_comes_from_the_source_and_one_that_is_gone_is_told(files, copy):
    for path in (copy / "assets").rglob("*.glb"):
        path.write_bytes(b"glTF and no more")
    (pair, *_) = open_dataset(copy).pairs()
    with pytest.raises(CorruptError, match=r"\.glb cannot be read"):
        pair.mesh()
    shutil.rmtree(copy / "assets")
    for stored, made in zip(open_dataset(files.root).pairs(), open_dataset(copy).pairs(), strict=True):
        for number in (2, 3):
            assert made.mesh(number).bounds == pytest.approx(stored.mesh(number).bounds, abs=1e-6)
    record = read_job(files)
    gone = {"objects": [{"source": "library", "folder": "/nowhere"}]}
    job = type(record.job).model_validate({**record.job.model_dump(mode="json"), "assets": gone})
    LocalStore(copy).put("job.yaml", encode_job(type(record)(job, record.digest, record.catalogue, record.folder)))
    (pair, *_) = open_dataset(copy).pairs()
    with pytest.raises(InputError, match=r"assets/box/.*\.glb is not in the dataset.*/nowhere"):
        pair.mesh()


def test_a_scene_in_memory_is_the_stored_one(files, tmp_path):
    path = tmp_path / "job.yaml"
    path.write_text(yaml.safe_dump(KEYS))
    stored = open_dataset(files.root).scene(2)
    for job in (KEYS, path, str(path), validate_job(KEYS, "test")):
        made = make_scene(job, 2)
        assert [pair.pose_id for pair in made] == [pair.pose_id for pair in stored] == [8, 10]
        for mine, theirs in zip(made, stored, strict=True):
            assert mine.scene == theirs.scene and mine.input.row == theirs.input.row
            for role in ("input", "aligned", "mirror", "projected"):
                a, b = getattr(mine, role), getattr(theirs, role)
                assert np.array_equal(a.rgb(), b.rgb()) and np.array_equal(a.depth(), b.depth())
            assert np.array_equal(mine.input.patch().segment(), theirs.input.patch().segment())
            assert mine.mesh().bounds == pytest.approx(theirs.mesh().bounds, abs=1e-12)
    for job in (KEYS, path, validate_job(KEYS, "test")):
        (pair,) = make_scene(job, 0, ["pairs_per_scene=1", "start.pose=placed"])
        assert pair.scene["pose"] == "placed"
    with pytest.raises(JobError, match="there is no such key"):
        make_scene(path, 0, ["start.poze=placed"])
    with pytest.raises(SceneError, match="scene 0 cannot be made"):
        make_scene(overlaid(KEYS, {"cameras": {"sensor": {"fx": 90_000.0, "fy": 90_000.0}}}), 0)
