"""What is told about a file before a job is made of it."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.job.assets import Assets, FolderSource
from tests.workers.assets.oracles import textured_cube, write
from workers.assets.external.listing import Entry, hash_files
from workers.assets.external.placement import read_measured
from workers.assets.external.reader_tasks import ANSWER, Request, Task, answer_task

SETTINGS = FolderSource(source="urdf", folder=".")


def measured(folder, path):
    entry = Entry("id", hash_files([path], folder), "MIT")
    letter, blocks = answer_task(Request(SETTINGS, folder, Assets(), (Task("measure", path, "mug", entry),)), 0)
    assert letter == ANSWER
    return read_measured(bytes(blocks[0]))


def test_a_lying_can_tells_its_size_and_the_axis_that_it_stands_on(tmp_path):
    can = trimesh.creation.cylinder(0.04, 0.1, sections=48)
    can.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    found = measured(tmp_path, write(tmp_path / "can.stl", can.export(file_type="stl")))
    assert found.extents == pytest.approx((0.08, 0.1, 0.08), abs=1e-6)
    assert (found.faces, found.watertight, found.up, found.confidence) == (len(can.faces), True, "y", "sure")
    assert found.vertices >= len(can.vertices) and found.textures == 0 and found.notes == ()


@pytest.mark.parametrize("there", [True, False])
def test_pictures_are_counted_and_missing_ones_are_named(tmp_path, there):
    path = textured_cube(tmp_path)
    if there:
        Image.new("RGB", (4, 4)).save(tmp_path / "skin.png")
    found = measured(tmp_path, path)
    assert found.textures == there
    assert found.notes == (() if there else ("skin.png is missing: plain base colour used",))
    assert found.up is None
