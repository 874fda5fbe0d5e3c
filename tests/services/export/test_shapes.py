import shutil
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import CorruptError
from schemas.scene.shape import Material, Part, Shape
from services.export.shapes import Shapes, color_vertices
from services.export.source import iter_ranges, scenes_of
from services.job.record import require_job
from tests.exported import source_rows
from workers.store.commit import list_codes
from workers.store.local import LocalStore


def load_first(store):
    stored = next(iter_ranges(store, list_codes(store), 0))
    (scene,) = scenes_of(store, stored, [0])
    return Shapes(store, require_job(store)).load(scene, scene.row["instance_id"])


def test_a_stored_shape_is_the_one_that_the_jobs_sources_make(files, tmp_path):
    stored = load_first(files)
    shutil.copytree(files.name, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "assets")
    made = load_first(LocalStore(tmp_path / "copy"))
    assert stored is not None and made is not None
    np.testing.assert_allclose(stored.shape.vertices, made.shape.vertices, atol=1e-7)
    np.testing.assert_array_equal(stored.shape.faces, made.shape.faces)
    assert np.abs(stored.colors.astype(int) - made.colors).max() <= 1
    extents = next(row["extents_m"] for row in source_rows(files.root, "assets") if row["category"] != "table")
    assert np.ptp(stored.shape.vertices, axis=0).max() < 2 * max(extents)


def test_a_shape_that_is_neither_stored_nor_to_be_made_is_none(files, tmp_path):
    shutil.copytree(files.name, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "assets")
    job = tmp_path / "copy" / "job.yaml"
    text = job.read_text()
    catalogue = require_job(files).catalogue
    job.write_text(text.replace(catalogue, "f" * len(catalogue)))
    assert load_first(LocalStore(tmp_path / "copy")) is None


def test_a_damaged_shape_is_named_with_the_remedy(files, tmp_path):
    shutil.copytree(files.name, tmp_path / "copy")
    for path in Path(tmp_path / "copy" / "assets").rglob("*.glb"):
        path.write_bytes(b"glTF")
    with pytest.raises(CorruptError, match="--repair"):
        load_first(LocalStore(tmp_path / "copy"))


def test_a_vertex_has_the_colour_of_its_texel_times_the_base_colour():
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 1], texture[1, 0] = (200, 100, 0), (0, 100, 200)  # upper right, lower left
    uv = np.array([[0.75, 0.75], [0.25, 0.25], [1.75, -0.25]])
    material = Material(base_color=(1.0, 0.5, 1.0, 1.0), texture=texture)
    part = Part("a", np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), material, uv=uv)
    plain = Part("b", np.zeros((1, 3)), np.zeros((0, 3), np.int32), Material((0.2, 0.4, 0.6, 1.0)))
    colors = color_vertices(Shape((part, plain))).colors
    assert colors.tolist() == [[200, 50, 0], [0, 50, 200], [200, 50, 0], [51, 102, 153]]
