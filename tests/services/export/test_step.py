"""Exports that are killed, repeated, narrowed, refused, or made while the dataset is."""

import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from obstore.store import MemoryStore

from schemas.errors import CorruptError, InputError, OutputError
from services.export.table import FORMATS
from tests.exported import contents, export_to
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

ROOT = Path(__file__).resolve().parents[3]


class Killed(BaseException):
    """Stands for a SIGKILL: nothing of ours catches it."""


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("points", [2, pytest.param(24, marks=pytest.mark.minute)])
def test_an_export_that_is_killed_anywhere_goes_on_to_the_same_bytes(points, name, files, tmp_path, monkeypatch):
    replace, calls = os.replace, itertools.count()

    def die_at(*numbers):
        nonlocal calls
        calls = itertools.count()

        def replace_or_die(source, target):
            if next(calls) in numbers:
                raise Killed
            replace(source, target)

        monkeypatch.setattr(os, "replace", replace_or_die)

    die_at()
    export_to(files, tmp_path / "whole", name, shard_mb=0)
    steps = next(calls)
    spread = {round((i + 0.5) * steps / points) for i in range(points)}
    for kill in sorted({*spread, steps - 2, steps - 1} & set(range(steps))):  # the manifest is last
        target = tmp_path / f"killed-{kill}"
        die_at(kill)
        with pytest.raises(Killed):
            export_to(files, target, name, shard_mb=0)
        assert not (target / "export.json").exists() or (target / "_export").exists()
        die_at(kill // 2)
        with contextlib.suppress(Killed):  # it may have less left than that
            export_to(files, target, name, shard_mb=0)
        die_at()
        export_to(files, target, name, shard_mb=0)
        assert contents(target) == contents(tmp_path / "whole")
        shutil.rmtree(target)


def test_a_process_that_is_killed_is_gone_on_with(files, tmp_path):
    export_to(files, tmp_path / "whole", "mirror-recon")
    command = [sys.executable, "-m", "services.cli.main", "export", files.name, str(tmp_path / "killed")]
    command += ["--format", "mirror-recon"]
    for delay in (0.0, 0.02):
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and not (tmp_path / "killed" / "_export" / "progress.json").exists():
            time.sleep(0.001)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        process.wait()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "8 pairs of 4 scenes" in done.stdout
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")


def test_a_finished_export_is_left_as_it_is_and_another_one_refused(files, tmp_path):
    assert export_to(files, tmp_path / "new", "mirror-recon").pairs_now == 8
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "new").rglob("*")}
    again = export_to(files, tmp_path / "new", "mirror-recon")
    assert (again.pairs_now, again.manifest["pairs"]) == (0, 8)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "new").rglob("*")} == before
    with pytest.raises(OutputError, match=r"choice: \{\} there, \{'categories': \['can'\]\} here"):
        export_to(files, tmp_path / "new", "mirror-recon", categories=("can",))


def test_a_folder_that_is_not_an_exports_is_refused(files, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(OutputError, match=r"holds thesis\.tex: .* choose another DIR"):
        export_to(files, tmp_path / "mine", "mirror-recon")
    assert contents(tmp_path / "mine") == {"thesis.tex": b""}
    with pytest.raises(OutputError, match="lies in the dataset"):
        export_to(files, Path(files.name) / "export", "mirror-recon")


def test_only_the_chosen_scenes_are_exported(files, tmp_path):
    def scenes(name, **asked):
        export_to(files, tmp_path / name, "mirror-recon", **asked)
        lines = (tmp_path / name / "pairs.csv").read_text().splitlines()[1:]
        return {int(line.split(",")[2]) for line in lines}

    assert scenes("span", first_scene=1, last_scene=2) == {1, 2}
    cans, boxes = scenes("cans", categories=("can",)), scenes("boxes", categories=("box",))
    assert cans and boxes and cans | boxes == {0, 1, 2, 3} and not cans & boxes
    assert scenes("where", where="category = 'can' -- mine") == cans
    seen = "exists (select 1 from views v where v.scene_id = scenes.scene_id and v.role = 'mirror')"
    assert scenes("views", where=seen) == {0, 1, 2, 3}
    with pytest.raises(InputError, match="nosuch"):
        scenes("wrong", where="nosuch > 3")
    assert not (tmp_path / "wrong").exists()


def test_a_dataset_that_is_being_made_is_exported_as_far_as_it_is_committed(files, tmp_path):
    shutil.copytree(files.name, tmp_path / "making")
    for path in ("_SUCCESS", "manifest/_commits/0000000002.json"):
        (tmp_path / "making" / path).unlink()
    manifest = export_to(LocalStore(tmp_path / "making"), tmp_path / "new", "mirror-recon").manifest
    assert (manifest["scenes"], manifest["dataset_digest"]) == (2, None)


def test_an_image_that_is_lost_is_an_error_and_never_left_out(files, tmp_path):
    shutil.copytree(files.name, tmp_path / "copy")
    next((tmp_path / "copy").glob("*/depth00003.png")).unlink()
    with pytest.raises(CorruptError, match=r"depth00003\.png is committed and missing"):
        export_to(LocalStore(tmp_path / "copy"), tmp_path / "new", "mirror-recon")


@pytest.mark.parametrize("name", FORMATS)
def test_a_bucket_is_exported_to_the_same_bytes_as_a_folder(name, tars, tmp_path):
    bucket = MemoryStore()
    for path, data in contents(Path(tars.name)).items():
        bucket.put(path, data)
    export_to(ObjectStore(bucket, "memory://dataset"), tmp_path / "far", name)
    export_to(tars, tmp_path / "near", name)
    assert contents(tmp_path / "far") == contents(tmp_path / "near")
