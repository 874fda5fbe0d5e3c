"""What was lost is put back to the byte, and nothing else is changed; what cannot be is said and left as it was."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from schemas.scene.scene import encoded_file
from services.cli.main import main
from services.job.record import require_job
from services.merge.merge import read_success
from services.read import replay as remake
from services.read.repair import Repair, repair
from tests.damage import files_by_kind, kind_of
from tests.datasets import faults_of, run_here
from workers.store.attempt import reopen
from workers.store.local import LocalStore


def repaired(out: Path, *scenes: int) -> Repair:
    return repair(LocalStore(out), scenes, lambda _: None)


def contents(out: Path) -> dict[str, bytes]:
    """Every file of a dataset but what writers keep beside it."""
    return {path: (out / path).read_bytes() for paths in files_by_kind(out).values() for path in paths}


def spoil(path: Path) -> None:
    """Turns a bit in the middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


@pytest.fixture(params=["tiny", "packed"])
def whole(request, tmp_path) -> Path:
    """A copy of each layout."""
    shutil.copytree(request.getfixturevalue(request.param).root, tmp_path / "copy")
    return tmp_path / "copy"


def test_every_kind_of_file_but_records_is_put_back_and_the_dataset_is_the_same(whole):
    """The first file of each kind missing, the last damaged, all at once; of measured times only one of two copies."""
    before = contents(whole)
    kept = ("commit record", "job.yaml", "_SUCCESS", "merged table timings")
    for paths in (paths for kind, paths in files_by_kind(whole).items() if kind not in kept):
        spoil(whole / paths[-1])
        (whole / paths[0]).unlink()
    job = whole / "job.yaml"
    job.write_text(job.read_text().replace("# The job", "# The dog"))
    assert len(faults_of(LocalStore(whole))) > 12
    found = repaired(whole)
    assert (found.verdict.faults, found.left) == ([], [])
    assert contents(whole) == before


@pytest.mark.parametrize(
    "kind", ["merged table views", "camPoses.csv", "_SUCCESS", "DATASET.md", "range table timings"]
)
def test_one_damaged_file_is_put_back_alone(copy, kind):
    before = contents(copy)
    path = next(path for path in before if kind_of(path) == kind)
    spoil(copy / path)
    assert faults_of(LocalStore(copy))
    found = repaired(copy)
    assert found.verdict.faults == [] and len(found.done) == 1
    assert contents(copy) == before


def test_only_the_ranges_of_the_scenes_named_are_touched(copy):
    for start in (0, 2):
        (copy / f"manifest/_ranges/{start:010d}/scenes.parquet").unlink()
    found = repaired(copy, 2)
    assert found.done == ["manifest/_ranges/0000000002/scenes.parquet: put back"]
    assert any("0000000000/scenes.parquet" in fault for fault in found.verdict.faults)


def test_a_file_that_comes_out_otherwise_is_not_written(copy, monkeypatch):
    image = next(copy.glob("*/RGB0*.png"))
    image.unlink()
    before, original = contents(copy), remake.run_scene

    def other_bytes(*arguments):
        output = original(*arguments)
        files = tuple(encoded_file(file.path, file.data + b" ") for file in output.files)
        return dataclasses.replace(output, files=files)

    monkeypatch.setattr(remake, "run_scene", other_bytes)
    found = repaired(copy)
    assert found.left[0].startswith(f"{image.parent.name}/{image.name}: does not come out as it was")
    assert len(found.verdict.faults) == 1 and found.done == []
    assert contents(copy) == before


def test_a_job_that_is_not_the_commits_makes_nothing(copy):
    job = copy / "job.yaml"
    job.write_text(job.read_text().replace("seed: 11\n", "seed: 12\n"))
    next(copy.glob("*/RGB0*.png")).unlink()
    before = contents(copy)
    found = repaired(copy)
    assert found.left == ["job.yaml: is not the job of the commits: no scene can be made again from it"]
    assert contents(copy) == before and len(found.verdict.faults) >= 2


def test_a_damaged_record_is_dropped_and_a_run_makes_the_same_dataset_again(copy):
    before, job = contents(copy), require_job(LocalStore(copy)).job
    digest = read_success(LocalStore(copy))["digest"]
    spoil(copy / "manifest/_commits/0000000001.json")
    found = repaired(copy)
    assert found.left == [
        "manifest/_commits/0000000001.json: dropped, because a record of it is damaged or missing: run the job again to "
        "make its scenes"
    ]
    assert not (copy / "_SUCCESS").exists()
    assert "scenes 1 to 1 are not committed" in found.verdict.faults[0]
    store, again = run_here(job, copy)
    assert again == digest and faults_of(store) == []
    same = {path for path, data in contents(copy).items() if before[path] == data}
    assert {kind_of(path) for path in before.keys() - same} <= {
        *("commit record", "range table timings", "merged table timings", "_SUCCESS")
    }


def test_measured_times_that_nothing_tells_any_more_cost_their_range(copy):
    reopen(LocalStore(copy))
    shutil.rmtree(copy / "manifest/timings")
    (copy / "manifest/_ranges/0000000002/timings.parquet").unlink()
    found = repaired(copy)
    assert "manifest/_commits/0000000002.json: dropped, because its measured times are lost" in found.left[0]
    assert not (copy / "manifest/_commits/0000000002.json").exists()


def test_the_command_says_what_it_did_and_exits_by_what_verify_says(copy, capsys):
    next(copy.glob("*/RGB0*.png")).unlink()
    assert main(["replay", str(copy), "--repair"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith(".png: put back") and lines[-1].endswith("1 files put back or written again; nothing off")
    (copy / "stray").touch()
    assert main(["replay", str(copy), "--repair"]) == 1
    assert "stray: is in no commit: move it away" in capsys.readouterr().out
    assert main(["replay", str(copy)]) == 2
