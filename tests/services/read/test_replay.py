"""Scenes made again: compared with what is stored, or put back to the byte; what cannot be is said and left as it was."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import CorruptError
from schemas.scene.scene import encoded_file
from services.cli.main import main
from services.job.record import read_success, require_job
from services.read import replay as remake
from services.read.dataset_reader import find_scene
from services.read.repair import Repair, repair
from services.read.replay import Maker, compare_files, compare_rows, open_context, replay_scene
from tests.damage import files_by_kind, kind_of
from tests.datasets import faults_of, run_here
from tests.services.read.conftest import spoil
from workers.scene.context import Stopwatch
from workers.store.attempt import reopen
from workers.store.commit import committed_files, read_record
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


@pytest.fixture
def made(monkeypatch) -> list[int]:
    """The scenes that are made again."""
    scenes: list[int] = []
    original = remake.run_scene

    def counted(context, scene_id, total):
        scenes.append(scene_id)
        return original(context, scene_id, total)

    monkeypatch.setattr(remake, "run_scene", counted)
    return scenes


@pytest.mark.parametrize("layout", ["tiny", "packed"])
def test_a_scene_is_made_once_for_all_files_of_its_range_and_measured_times_without_it(layout, request, made):
    store = request.getfixturevalue(layout)
    record, maker = read_record(store, 1), Maker(store, require_job(store))
    lost = committed_files(store, record)
    times = [entry for entry in lost if entry.path.endswith(("timings.parquet", "failures.parquet"))]
    assert {path for path, _ in maker.make_files(record, times)} == {entry.path for entry in times} and made == []
    assert dict(maker.make_files(record, lost)) == {entry.path: store.read(entry.path) for entry in lost}
    assert made == [1]
    others = [entry.model_copy(update={"sha256": "0" * 64}) for entry in lost]
    assert list(maker.make_files(record, others)) == []


def repaired(out: Path, *scenes: int) -> Repair:
    return repair(LocalStore(out), scenes, lambda _: None)


def contents(out: Path) -> dict[str, bytes]:
    """Every file of a dataset but what writers keep beside it."""
    return {path: (out / path).read_bytes() for paths in files_by_kind(out).values() for path in paths}


@pytest.mark.parametrize("layout", ["tiny", "packed"])
def test_every_kind_of_file_but_records_is_put_back_and_the_dataset_is_the_same(layout, request, tmp_path):
    """The first file of each kind missing, the last damaged, all at once; of measured times only one of two copies."""
    out = tmp_path / "copy"
    shutil.copytree(request.getfixturevalue(layout).root, out)
    before = contents(out)
    kept = ("commit record", "job.yaml", "_SUCCESS", "merged table timings")
    for paths in (paths for kind, paths in files_by_kind(out).items() if kind not in kept):
        spoil(out / paths[-1])
        (out / paths[0]).unlink()
    (out / "job.yaml").write_bytes(before["job.yaml"].replace(b"# The job", b"# The dog"))
    assert len(faults_of(LocalStore(out))) > 12
    found = repaired(out)
    assert (found.verdict.faults, found.left) == ([], [])
    assert contents(out) == before


def test_one_damaged_file_is_put_back_alone(copy):
    before = contents(copy)
    for kind in ("merged table views", "camPoses.csv", "_SUCCESS", "DATASET.md", "range table timings"):
        spoil(copy / next(path for path in before if kind_of(path) == kind))
        assert faults_of(LocalStore(copy))
        found = repaired(copy)
        assert found.verdict.faults == [] and len(found.done) == 1, kind
        assert contents(copy) == before


def test_only_the_ranges_of_the_scenes_named_are_touched(copy):
    for start in (0, 2):
        (copy / f"manifest/_ranges/{start:010d}/scenes.parquet").unlink()
    found = repaired(copy, 2)
    assert found.done == ["manifest/_ranges/0000000002/scenes.parquet: put back"]
    assert any("0000000000/scenes.parquet" in fault for fault in found.verdict.faults)


def test_a_file_that_comes_out_otherwise_is_not_written(copy, monkeypatch):
    (copy / "can/RGB00000.png").unlink()
    before, original = contents(copy), remake.run_scene

    def other_bytes(*arguments):
        output = original(*arguments)
        files = tuple(encoded_file(file.path, file.data + b" ") for file in output.files)
        return dataclasses.replace(output, files=files)

    monkeypatch.setattr(remake, "run_scene", other_bytes)
    found = repaired(copy)
    assert found.left[0].startswith("can/RGB00000.png: does not come out as it was")
    assert len(found.verdict.faults) == 1 and found.done == [] and contents(copy) == before


def test_a_job_that_is_not_the_commits_makes_nothing(copy):
    job = copy / "job.yaml"
    job.write_text(job.read_text().replace("seed: 11\n", "seed: 12\n"))
    (copy / "can/RGB00000.png").unlink()
    before = contents(copy)
    found = repaired(copy)
    assert found.left == ["job.yaml: is not the job of the commits: no scene can be made again from it"]
    assert contents(copy) == before and len(found.verdict.faults) >= 2
    with pytest.raises(CorruptError, match=r"job\.yaml is not the job that scene 1 was made from"):
        replay_scene(LocalStore(copy), 1)


def test_a_damaged_record_is_dropped_and_a_run_makes_the_same_dataset_again(copy):
    before, job = contents(copy), require_job(LocalStore(copy)).job
    digest = read_success(LocalStore(copy))["digest"]
    record = "manifest/_commits/0000000001.json"
    spoil(copy / record)
    found = repaired(copy)
    why = "dropped, because a record of it is damaged or missing: run the job again to make its scenes"
    assert found.left == [f"{record}: {why}"]
    assert not (copy / "_SUCCESS").exists() and "scenes 1 to 1 are not committed" in found.verdict.faults[0]
    store, again = run_here(job, copy)
    assert again == digest and faults_of(store) == []
    others = {kind_of(path) for path, data in contents(copy).items() if before.get(path) != data}
    assert others <= {"commit record", "range table timings", "merged table timings", "_SUCCESS"}
    assert contents(copy).keys() >= before.keys()


def test_measured_times_that_nothing_tells_any_more_cost_their_range(copy):
    reopen(LocalStore(copy))
    shutil.rmtree(copy / "manifest/timings")
    (copy / "manifest/_ranges/0000000002/timings.parquet").unlink()
    found = repaired(copy)
    assert "manifest/_commits/0000000002.json: dropped, because its measured times are lost" in found.left[0]
    assert not (copy / "manifest/_commits/0000000002.json").exists()


def test_the_command_says_what_it_did_and_exits_by_what_verify_says(copy, capsys):
    (copy / "can/RGB00000.png").unlink()
    assert main(["replay", str(copy), "--repair"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith(".png: put back") and lines[-1].endswith("1 file put back or written again; nothing off")
    (copy / "stray").touch()
    assert main(["replay", str(copy), "--repair"]) == 1
    assert "stray: is in no commit: move it away" in capsys.readouterr().out
    assert main(["replay", str(copy)]) == 2
