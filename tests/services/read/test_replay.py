"""Scenes made again: compared with what is stored; and what is lost comes back as the messages say."""

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from schemas.dataset.layout import FINGERPRINT_FILE
from schemas.errors import CorruptError
from services.job.record import read_success, require_job
from services.read import replay as remake
from services.read.dataset_reader import find_scene
from services.read.replay import compare_files, compare_rows, open_context, replay_scene
from tests.damage import files_by_kind, kind_of
from tests.datasets import faults_of, run_here
from tests.services.read.conftest import spoil
from workers.scene.context import Stopwatch
from workers.store.images import decode_png, encode_png
from workers.store.local import LocalStore


def test_a_scene_replays_to_the_byte_and_a_difference_is_told_by_file_table_and_column(pile):
    replayed = replay_scene(pile, 0)
    assert replayed.same_stack and replayed.differences == () and replayed.compared > 15
    stored = find_scene(pile, 0)
    output = remake.run_scene(open_context(require_job(pile)), 0, Stopwatch())
    assert compare_rows(stored, output) == []
    scene = {**stored.rows["scenes"][0], "settle_s": -1.0}
    other = dataclasses.replace(stored, rows={**stored.rows, "scenes": [scene], "objects": []})
    differences = compare_rows(other, output)
    assert differences[0] == "rows of scenes: settle_s" and differences[1].startswith("rows of objects: 0 stored, ")
    assert len(compare_rows(other, output, frozenset({"settle_s"}))) == 1
    views = [{**row, "d_z_m": 9.0} if row["role"] == "mirror" else row for row in stored.rows["views"]]
    for mixed in (views, views[::-1], views[2:] + views[:2]):  # one column, whatever the order of the rows
        assert compare_rows(dataclasses.replace(stored, rows={**stored.rows, "views": mixed}), output) == [
            "rows of views: d_z_m"
        ]
    few = dataclasses.replace(stored, rows={**stored.rows, "views": views[1:]})
    assert compare_rows(few, output) == [f"rows of views: {len(views) - 1} stored, {len(views)} made now, d_z_m"]
    number, depth = next((i, file) for i, file in enumerate(output.files) if "/depth0" in file.path)
    for pixels, too_many in ((4, False), (4000, True)):  # another stack may differ in few pixels, the same in none
        image = decode_png(depth.data)
        image.ravel()[:pixels] += np.uint16(9)
        changed = dataclasses.replace(depth, data=encode_png(image, 1), sha256="another")
        files = (*output.files[:number], changed, *output.files[number + 1 :])
        now = dataclasses.replace(output, files=files)
        assert len(compare_files(pile, stored, now, same_stack=True)) == 1
        assert len(compare_files(pile, stored, now, same_stack=False)) == too_many
        assert compare_files(pile, stored, dataclasses.replace(output, files=files[1:]), True)


def contents(out: Path) -> dict[str, bytes]:
    """Every file of a dataset but what writers keep beside it."""
    return {path: (out / path).read_bytes() for paths in files_by_kind(out).values() for path in paths}


@pytest.mark.parametrize("layout", ["tiny", "packed"])
def test_every_fault_goes_by_its_remedy_and_the_dataset_is_the_same(layout, request, tmp_path):
    """The first file of each kind missing, the last damaged, all at once; then what `verify` says is done."""
    out = tmp_path / "copy"
    shutil.copytree(request.getfixturevalue(layout).root, out)
    store, before = LocalStore(out), contents(out)
    job, digest = require_job(store).job, read_success(store)["digest"]
    for kind, paths in files_by_kind(out).items():
        if kind not in ("job.yaml", kind_of(FINGERPRINT_FILE)):  # of these there is a copy, or none
            spoil(out / paths[-1])
            if len(paths) > 1:
                (out / paths[0]).unlink()
    for _ in range(2):  # a file is judged once its range's record is whole
        for fault in faults_of(store):
            path, remedy = fault.split(": ", 1)[0], fault.rpartition(": ")[2]
            doomed = re.findall(r"manifest/_commits/[0-9*]+\.json|_SUCCESS", remedy)
            for name in [path, *doomed] if "remove it" in remedy else []:
                for file in out.glob(name):
                    if file.is_file():
                        file.unlink()
        store, again = run_here(job, out)
    assert faults_of(store) == [] and again == digest
    after = contents(out)
    changed = {kind_of(path) for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    assert changed <= {"commit record", "range table timings", "merged table timings", "_SUCCESS"}


def test_a_job_that_is_not_the_commits_makes_nothing(copy):
    job = copy / "job.yaml"
    job.write_text(job.read_text().replace("seed: 11\n", "seed: 12\n"))
    with pytest.raises(CorruptError, match=r"job\.yaml is not the job that scene 1 was made from"):
        replay_scene(LocalStore(copy), 1)
