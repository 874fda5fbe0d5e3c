"""Samples of shapes in a dataset: listed, checked, compared, put back and exported; and scenes made again, as stored."""

import dataclasses
import io
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from schemas.dataset.layout import FINGERPRINT_FILE
from schemas.errors import CorruptError
from services.job.record import read_success, require_job
from services.read import replay as remake
from services.read.dataset_reader import decode_samples, find_scene
from services.read.replay import compare_files, compare_rows, open_context, replay_scene
from tests.damage import files_by_kind, kind_of
from tests.datasets import faults_of, make_dataset, run_here
from tests.services.export.exported import export_to
from tests.services.read.conftest import TINY, spoil
from workers.assets.samples import encode_samples
from workers.stopwatch import Stopwatch
from workers.store.commit import committed_files, read_record
from workers.store.images import decode_png, encode_png
from workers.store.local import LocalStore

POINTS = 300
TARGETS = {"shape": ["surface", "volume"], "points": POINTS}
SHARED = {"objects": [{"source": "procedural", "instances": 1}], "tables": [{"source": "procedural", "instances": 1}]}


@pytest.fixture(scope="module", params=["files", "tar"])
def sampled(request, tmp_path_factory) -> LocalStore:
    """Two ranges of a scene each, of the same object and table."""
    changes = {**TINY, "scenes": 2, "categories": ["can"], "assets": SHARED, "targets": TARGETS}
    return make_dataset(tmp_path_factory.mktemp("sampled"), output={"layout": request.param}, **changes)[0]


def samples_in(store: LocalStore) -> list[str]:
    return sorted(path.relative_to(store.root).as_posix() for path in store.root.rglob("*.npz"))


def test_scenes_that_share_a_shape_store_its_samples_once_and_its_row_lists_them(sampled):
    rows = find_scene(sampled, 0).rows["assets"]
    assert rows == find_scene(sampled, 1).rows["assets"] and len(rows) == 2
    assert [row["category"] for row in rows if row["samples"] is None] == ["table"]
    row = next(row for row in rows if row["samples"] is not None)
    assert samples_in(sampled) == [row["samples"]["path"]]
    record = read_record(sampled, 0)
    named = {entry.path for entry in committed_files(sampled, record)} - {entry.path for entry in record.files}
    assert set(samples_in(sampled)) <= named, "by the rows alone"
    data, named = sampled.read(row["samples"]["path"]), ("bytes", "points", "open_share")
    assert [row["samples"][name] for name in named] == [len(data), POINTS, 0.0]
    arrays = decode_samples(data, "")
    assert len(arrays["surface_points"]) == len(arrays["volume_distance"]) == POINTS
    assert arrays["scale"] == pytest.approx(max(row["extents_m"]))


def test_a_missing_or_damaged_file_of_samples_is_told(sampled, tmp_path):
    out = tmp_path / "copy"
    shutil.copytree(sampled.root, out)
    (file,) = (out / path for path in samples_in(sampled))
    before = file.read_bytes()
    assert faults_of(LocalStore(out)) == []
    for harm, told in ((spoil, "SHA-256"), (Path.unlink, "is committed and missing")):
        harm(file)
        (fault,) = faults_of(LocalStore(out))
        assert file.name in fault and told in fault
        file.write_bytes(before)


def test_a_replay_compares_samples_to_the_byte_and_on_another_stack_within_a_tolerance(sampled):
    replayed = replay_scene(sampled, 1)
    assert (replayed.same_stack, replayed.differences) == (True, ())
    stored = find_scene(sampled, 0)
    output = remake.run_scene(open_context(require_job(sampled)), 0, Stopwatch())
    number, file = next((n, file) for n, file in enumerate(output.files) if file.path.endswith(".npz"))
    for way_m, too_far in ((1e-8, False), (1e-3, True)):
        arrays = decode_samples(file.data, file.path)
        arrays["volume_distance"] = (arrays["volume_distance"] + way_m).astype(np.float32)
        changed = dataclasses.replace(file, data=encode_samples(arrays), sha256="another")
        now = dataclasses.replace(output, files=(*output.files[:number], changed, *output.files[number + 1 :]))
        assert len(compare_files(sampled, stored, now, same_stack=True)) == 1
        assert len(compare_files(sampled, stored, now, same_stack=False)) == too_far
    less = dataclasses.replace(output, files=(*output.files[:number], *output.files[number + 1 :]))
    assert compare_files(sampled, stored, less, same_stack=False) == [f"{file.path}: only stored"]


def test_an_export_copies_samples_beside_the_shapes(sampled, tmp_path):
    export_to(sampled, tmp_path / "out", "webdataset")
    copies = {path.name: path.read_bytes() for path in (tmp_path / "out").rglob("*.samples.npz")}
    named = {path.rpartition("/")[2].replace(".npz", ".samples.npz"): path for path in samples_in(sampled)}
    assert copies == {name: sampled.read(path) for name, path in named.items()}


def test_a_file_of_samples_that_is_damaged_or_another_is_named_and_nothing_of_it_is_believed(sampled):
    data = sampled.read(samples_in(sampled)[0])
    good = decode_samples(data, "")
    hole, packed, lying = good["loc"].copy(), io.BytesIO(), io.BytesIO()
    hole[1] = np.nan
    np.savez_compressed(packed, **{**good, "surface_colors": np.zeros((10_000_000, 3), np.uint8)})
    with zipfile.ZipFile(lying, "w") as file:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"shape": (10**12, 3), "fortran_order": False, "descr": "<f4"})
        file.writestr("surface_points.npy", header.getvalue())
    files = {
        "not a zip file": data[:-40],
        "CRC-32": data[:1000] + bytes([data[1000] ^ 1]) + data[1001:],
        "would unpack to 30,": packed.getvalue(),
        "(EOF|Unable to allocate)": lying.getvalue(),
        "allow_pickle=False": encode({**good, "scale": np.array(None)}),
        "has loc, not surface_points, .*, scale": encode({"loc": good["loc"]}),
        "has surface_points, .*, not .*scale": encode({name: good[name] for name in good if name != "volume_distance"}),
        f"surface_colors is .u1 .9, 3., not .u1 .{POINTS}, 3": encode(
            {**good, "surface_colors": good["surface_colors"][:9]}
        ),
        "scale is <f4": encode({**good, "scale": good["scale"].astype(np.float32)}),
        "loc has a number that is not finite": encode({**good, "loc": hole}),
    }
    for told, one in files.items():
        with pytest.raises(CorruptError, match=rf"a/b.npz cannot be read: .*{told}.*; `verso verify OUT`"):
            decode_samples(one, "a/b.npz")
    volume = {name: array for name, array in good.items() if not name.startswith("surface")}
    assert decode_samples(encode(volume), "").keys() == volume.keys()


def encode(arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=True, **arrays)
    return stream.getvalue()


# ---------------------------------------------------------------------------------------------- scenes made again


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


@pytest.mark.minute
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
