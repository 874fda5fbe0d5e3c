"""A scene made again: equal to what is stored, and told by file and column where it is not."""

import dataclasses

import numpy as np
import pytest

from schemas.errors import CorruptError
from services.job.record import require_job
from services.read.dataset_reader import find_scene
from services.read.replay import compare_files, compare_rows, open_context, replay_scene
from workers.scene.context import Stopwatch
from workers.shard.run_shard import run_scene
from workers.store.images import decode_png, encode_png
from workers.store.local import LocalStore


@pytest.fixture(scope="module")
def again(three_objects):
    return find_scene(three_objects, 0), run_scene(open_context(require_job(three_objects)), 0, Stopwatch())


def test_a_scene_replays_to_the_byte(three_objects):
    replayed = replay_scene(three_objects, 0)
    assert replayed.same_stack and replayed.differences == ()
    assert replayed.compared > 15


def test_a_row_that_differs_is_told_by_table_and_column(again):
    stored, output = again
    assert compare_rows(stored, output) == []
    scene = {**stored.rows["scenes"][0], "settle_s": -1.0}
    other = dataclasses.replace(stored, rows={**stored.rows, "scenes": [scene], "objects": []})
    differences = compare_rows(other, output)
    assert differences[0] == "rows of scenes: settle_s"
    assert differences[1].startswith("rows of objects: 0 stored, ")
    assert len(compare_rows(other, output, frozenset({"settle_s"}))) == 1


@pytest.mark.parametrize(("pixels", "told"), [(4, False), (4000, True)])
def test_another_stack_may_differ_in_few_pixels_and_the_same_in_none(three_objects, again, pixels, told):
    stored, output = again
    number, depth = next((i, file) for i, file in enumerate(output.files) if "/depth0" in file.path)
    image = decode_png(depth.data)
    image.ravel()[:pixels] += np.uint16(9)
    changed = dataclasses.replace(depth, data=encode_png(image, 1), sha256="another")
    files = (*output.files[:number], changed, *output.files[number + 1 :])
    now = dataclasses.replace(output, files=files)
    assert len(compare_files(three_objects, stored, now, same_stack=True)) == 1
    assert len(compare_files(three_objects, stored, now, same_stack=False)) == told
    assert compare_files(three_objects, stored, dataclasses.replace(output, files=files[1:]), True)


def test_a_job_that_was_changed_is_told_and_no_scene_is_made_from_it(copy):
    job = copy / "job.yaml"
    job.write_text(job.read_text().replace("seed: 11\n", "seed: 12\n"))
    with pytest.raises(CorruptError, match=r"job\.yaml is not the job that scene 1 was made from"):
        replay_scene(LocalStore(copy), 1)
