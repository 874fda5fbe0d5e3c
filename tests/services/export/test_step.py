"""Exports of any format: killed, repeated, narrowed, refused, of tars and buckets, or made while the dataset is."""

import contextlib
import hashlib
import itertools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset as ds
import pytest

from schemas.base import set_key
from schemas.errors import CorruptError, InputError, InUseError, OutputError
from schemas.job.assets import SplitShares
from schemas.job.job import Job
from schemas.scene.shape import Material, Part
from services.cli.main import main
from services.dataset import dataset as splits
from services.dataset.dataset import Dataset, Splits, collect_ids, split_by_category
from services.export.folder import ExportFolder
from services.export.shapes import Shapes, vertex_colors
from services.export.source import iter_records, scenes_of
from services.export.table import FORMATS
from services.job.record import require_job
from services.read.scene_geometry import Sources
from tests.datasets import in_a_bucket, make_dataset
from tests.kit.tiers import first_of
from tests.services.export.exported import contents, export_to, source_rows
from workers.store.commit import list_codes, read_record
from workers.store.local import LocalStore

SPLITS = ("train", "val", "test")
OF = dict.fromkeys(("occnet", "nocs"), ("shaped", "shaped_tars"))
OF |= dict.fromkeys(("zero123", "instantmesh", "trellis", "stereo"), ("studio", "studio_tars"))
"""Datasets that formats which need targets are tested on."""
ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def copy(files, tmp_path) -> LocalStore:
    """A dataset that a test may damage."""
    shutil.copytree(files.name, tmp_path / "copy")
    return LocalStore(tmp_path / "copy")


# ------------------------------------------------------------------------------------------------ the same bytes


class Killed(BaseException):
    """Stands for a SIGKILL: nothing of ours catches it."""


@pytest.mark.parametrize(
    ("points", "name"),
    [
        # A file for each thing, shards, a register, and models beside one: every way to keep what was begun
        *((1, name) for name in ("mirror-recon", "webdataset", "occnet")),
        *(pytest.param(6, name, marks=pytest.mark.minute) for name in ("mirror-recon", "webdataset", "occnet", "bop")),
        *(pytest.param(24, name, marks=pytest.mark.slow) for name in FORMATS),
    ],
)
def test_an_export_that_is_killed_anywhere_goes_on_to_the_same_bytes(points, name, request, tmp_path, monkeypatch):
    files = request.getfixturevalue(OF.get(name, ("files", "tars"))[0])
    replace, calls = os.replace, itertools.count()

    def die_at(*numbers):
        nonlocal calls
        calls = itertools.count()

        def replace_or_die(source, target):
            ours = str(target).startswith(str(tmp_path))  # a loop that is compiled meanwhile is kept by a rename too
            if ours and next(calls) in numbers:
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


@pytest.mark.parametrize("key", ["pairs", "left_out", "format", "ranges"])
def test_a_writer_that_describes_what_every_manifest_has_is_refused(key, files, tmp_path, monkeypatch):
    monkeypatch.setattr(FORMATS["gltf"].load(), "describe", lambda _: {key: 1})
    with pytest.raises(ValueError, match=f"the writer of gltf describes {key}: "):
        export_to(files, tmp_path / "out", "gltf", first_scene=0, last_scene=0)
    assert not (tmp_path / "out/export.json").exists()


@pytest.mark.parametrize("name", first_of(FORMATS, 3))
def test_files_tars_and_a_bucket_are_exported_to_the_same_bytes(name, request, tmp_path):
    files, tars = map(request.getfixturevalue, OF.get(name, ("files", "tars")))
    sources = {"files": files, "tars": tars, "bucket": in_a_bucket(tars.root)}
    for place, store in sources.items():
        export_to(store, tmp_path / place, name, shard_mb=0)
    plain, tarred, far = (contents(tmp_path / place) for place in sources)
    assert tarred == far
    differing = {key for key in {*plain, *tarred} if plain.get(key) != tarred.get(key)}
    assert differing == {"export.json"}  # other job digest


# ------------------------------------------------------------------------------------------------ the folder


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
    (tmp_path / "file").touch()
    for target, told in (
        (tmp_path / "mine", r"holds thesis\.tex: .* choose another DIR"),
        (Path(files.name) / "export", "lies in the dataset"),
        (tmp_path / "file", "cannot be written"),
        (tmp_path / "file" / "below", "cannot be written"),
    ):
        with pytest.raises(OutputError, match=told):
            export_to(files, target, "mirror-recon")
    assert contents(tmp_path / "mine") == {"thesis.tex": b""}


def test_an_unfinished_export_that_is_anothers_or_damaged_is_refused(tmp_path):
    place = tmp_path / "new"
    folder = ExportFolder(place)
    with folder.claimed({"format": "x"}):
        folder.append("list.txt", b"one\n")
        folder.checkpoint({})

    def refused(error, told, **plan):
        with pytest.raises(error, match=told), ExportFolder(place).claimed({"format": "x", **plan}):
            pass

    refused(OutputError, "format: x there, y here", format="y")
    (place / "_export" / "parts" / "list.txt").write_bytes(b"o")
    refused(CorruptError, "shorter than the export left it")
    (place / "_export" / "plan.json").write_text("{")
    refused(CorruptError, "remove the folder")


def test_two_processes_do_not_write_one_export(tmp_path):
    holder = (
        "import sys\nfrom pathlib import Path\nfrom services.export.folder import ExportFolder\n"
        f"with ExportFolder(Path({str(tmp_path / 'new')!r})).claimed({{}}):\n    print('held', flush=True)\n    sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", holder], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"held\n"
        with (
            pytest.raises(InUseError, match="another `verso export` writes"),
            ExportFolder(tmp_path / "new").claimed({}),
        ):
            pass
        process.kill()
    with ExportFolder(tmp_path / "new").claimed({}):
        pass


# ------------------------------------------------------------------------------------------------ which scenes


def test_only_the_chosen_scenes_are_exported(files, captures, tmp_path):
    def scenes(store=files, **asked):
        target = tmp_path / str(len(list(tmp_path.iterdir())))
        export_to(store, target, "mirror-recon", **asked)
        lines = (target / "pairs.csv").read_text().splitlines()[1:]
        return {int(line.split(",")[2]) for line in lines}

    assert scenes(first_scene=1, last_scene=2) == {1, 2}
    cans, boxes = scenes(categories=("can",)), scenes(categories=("box",))
    assert cans and boxes and cans | boxes == {0, 1, 2, 3} and not cans & boxes
    assert scenes(where="category = 'can' -- mine") == cans
    assert scenes(categories=("can",), where=f"scene_id >= {max(cans)}") == {max(cans)}
    assert scenes(where="scene_id in (select scene_id from views where role = 'input' and pose_id >= 8)") == {2, 3}
    assert scenes(captures, where="capture.views > 1")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        *(
            ({"where": where}, "cannot be asked")
            for where in ("nosuch = 1", "category =", "exists (select 1 from read_text('/etc/passwd'))")
        ),
        ({"categories": ("can", "boxs")}, r"--category boxs: .* did you mean 'box'\? Its are box, can$"),
        ({"categories": ("table",)}, "--category table: .* no such object"),  # no scene is of tables
        ({"held_out": ("mugs",)}, "--held-out mugs: .* Its are box, can, table$"),
        ({"first_scene": 900}, "no scene of .*files0 is what was asked for: `verso query .* lists what is there"),
        ({"categories": ("can",), "where": "settle_s < 0"}, "no scene of"),
    ],
)
def test_what_no_scene_can_be_is_refused_before_anything_is_written(asked, message, files, tmp_path):
    with pytest.raises(InputError, match=message):
        export_to(files, tmp_path / "wrong", "mirror-recon", **asked)
    assert not (tmp_path / "wrong").exists()


def test_a_dataset_that_is_being_made_is_exported_as_far_as_it_is_committed(copy, tmp_path):
    for path in ("_SUCCESS", "manifest/_commits/0000000002.json"):
        (tmp_path / "copy" / path).unlink()
    (image,) = (tmp_path / "copy").glob("*/RGB00000.png")  # committed, and not yet published
    staged = tmp_path / "copy" / "_staging" / "0000000000" / read_record(copy, 0).attempt / image.parent.name
    staged.mkdir(parents=True)
    image.rename(staged / image.name)
    manifest = export_to(copy, tmp_path / "new", "mirror-recon").manifest
    assert (manifest["scenes"], manifest["pairs_left_out"], manifest["dataset_digest"]) == (2, 0, None)


def test_an_image_that_is_lost_is_an_error_and_never_left_out(copy, tmp_path):
    next((tmp_path / "copy").glob("*/depth00003.png")).unlink()
    with pytest.raises(CorruptError, match=r"depth00003\.png is committed and missing"):
        export_to(copy, tmp_path / "new", "mirror-recon")


def first_scene(store):
    (scene,) = scenes_of(Dataset(store), next(iter_records(store, list_codes(store))), {0}, Splits({}))
    return scene


def test_each_split_has_its_share_of_every_category_and_what_is_held_out_is_test_alone(files, tmp_path, monkeypatch):
    ids = {
        "laptop": [f"laptop-{k}" for k in range(30)],
        "jar": ["jar-1", "jar-2", "jar-3"],
        "box": ["box-1"],
        "can": [],
    }
    shares = SplitShares(train=0.8, val=0.1, test=0.1)
    found = split_by_category(ids, shares)
    counts = {key: [[found[name] for name in names].count(one) for one in SPLITS] for key, names in ids.items()}
    assert counts == {"laptop": [24, 3, 3], "jar": [1, 1, 1], "box": [1, 0, 0], "can": [0, 0, 0]}
    assert found == split_by_category({key: names[::-1] for key, names in ids.items()}, shares)
    place = {name: int(hashlib.sha256(name.encode()).hexdigest(), 16) for name in ids["laptop"]}
    order = sorted(place, key=place.get)  # as the column has them: by their hash
    assert [found[name] for name in order] == ["train"] * 24 + ["val"] * 3 + ["test"] * 3
    rows = [{"category": "mug", "instance_id": f"mug-{k}", "split": "val"} for k in range(9)]
    assert collect_ids([rows, rows]) == {"mug": {f"mug-{k}" for k in range(9)}}
    monkeypatch.setattr(splits, "MOST_INSTANCES", 8)
    assert collect_ids([rows[:5], rows]) == {"mug": None} and split_by_category({"mug": None}, shares) == {}
    assert Splits({}).of(rows[0]) == "val" and Splits({"mug-0": "train"}, frozenset({"mug"})).of(rows[0]) == "test"
    assert set(split_by_category(ids, SplitShares(train=0.0, val=0.5, test=0.5)).values()) == {"val", "test"}

    def exported(name, **asked):
        export_to(files, tmp_path / name, "huggingface", **asked)
        rows = ds.dataset(tmp_path / name / "data").to_table(columns=["instance_id", "split"]).to_pylist()
        return {row["instance_id"]: row["split"].replace("validation", "val") for row in rows}

    column = {row["instance_id"]: row["split"] for row in source_rows(files.root, "assets")}
    assert exported("column", split="instance").items() <= column.items()
    for split in ("instance", "category"):
        rows = exported(split + "-held", split=split, held_out=("can",))
        assert {split for name, split in rows.items() if name.startswith("can")} == {"test"}
    boxes = sorted(name for name in column if name.startswith("box"))
    assert {name: exported("new")[name] for name in boxes} == split_by_category({"box": boxes}, shares)


# ------------------------------------------------------------------------------------------------ shapes


def test_a_stored_shape_is_the_one_that_the_jobs_sources_make(files, copy, tmp_path):
    def load(store):
        scene = first_scene(store)
        return Shapes(Sources(require_job(store))).load(scene, scene.row["instance_id"])

    for path in (tmp_path / "copy" / "assets").rglob("*.glb"):
        path.write_bytes(b"glTF")
    with pytest.raises(CorruptError, match="verso verify"):
        load(copy)
    shutil.rmtree(tmp_path / "copy" / "assets")
    stored, made = load(files), load(copy)
    assert stored is not None and made is not None
    np.testing.assert_allclose(stored.vertices, made.vertices, atol=1e-7)
    np.testing.assert_array_equal(stored.faces, made.faces)
    colors = [np.concatenate([vertex_colors(part) for part in shape.parts]) for shape in (stored, made)]
    assert np.abs(colors[0].astype(int) - colors[1]).max() <= 1
    extents = next(row["extents_m"] for row in source_rows(files.root, "assets") if row["category"] != "table")
    assert np.ptp(stored.vertices, axis=0).max() < 2 * max(extents)


def test_a_vertex_has_the_colour_of_its_texel_times_the_base_colour():
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 1], texture[1, 0] = (200, 100, 0), (0, 100, 200)  # upper right, lower left
    uv = np.array([[0.75, 0.75], [0.25, 0.25], [1.75, -0.25]])
    material = Material(base_color=(1.0, 0.5, 1.0, 1.0), texture=texture)
    part = Part("a", np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), material, uv=uv)
    plain = Part("b", np.zeros((1, 3)), np.zeros((0, 3), np.int32), Material((0.2, 0.4, 0.6, 1.0)))
    assert [*vertex_colors(part).tolist(), *vertex_colors(plain).tolist()] == [
        [200, 50, 0],
        [0, 50, 200],
        [200, 50, 0],
        [51, 102, 153],
    ]


# ------------------------------------------------------------------------------------------------ the command


def test_the_command_says_what_is_there_and_what_was_left_out(files, tmp_path, capsys):
    asked = ["export", files.name, str(tmp_path / "new"), "--format", "mirror-recon"]
    assert main([*asked, "--scenes", "0-1", "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{tmp_path / 'new'}: mirror-recon, 4 pairs of 2 scenes (4 now, in ")
    answer = json.loads(lines[-1])
    assert (answer["ok"], answer["pairs"], answer["pairs_now"]) == (True, 4, 4)
    assert answer["choice"] == {"first_scene": 0, "last_scene": 1}
    bare, _ = make_dataset(
        tmp_path / "bare", scenes=1, categories=["can"], images={"patch": {"width": 120, "height": 110}}
    )
    assert main(["export", bare.name, str(tmp_path / "none"), *asked[3:]]) == 1
    told = capsys.readouterr()
    assert "left out: 1 pair, no patch of the " in told.out and "left_out.csv" in told.out
    assert "holds no pair: every pair was left out" in told.err


@pytest.mark.parametrize(("name", "key"), [(name, key) for name, row in FORMATS.items() for key in row.load().KEYS])
def test_a_job_that_has_switched_off_what_a_format_is_made_of_is_refused_before_anything_is_written(name, key):
    keys: dict[str, Any] = {"name": "t", "assets": {"objects": [{"source": "procedural"}]}}
    set_key(keys, key, False)
    if "mirror" in key:  # without such a view nothing is projected
        set_key(keys, "images.projection.enabled", False)
    job = Job.model_validate(keys)
    with pytest.raises(InputError, match=f"{name} needs a dataset whose job has {key}: true"):
        FORMATS[name].load().check(name, job)


def test_what_cannot_be_exported_is_refused_in_a_line_with_exit_code_2(files, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for place, target, told in (("empty", "new", "job.yaml"), (files.name, "s3://bucket/new", "on this machine")):
        assert main(["export", place, target, "--format", "mirror-recon"]) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1 and told in line
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
