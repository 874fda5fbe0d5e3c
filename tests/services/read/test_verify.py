"""`verso verify`: what is done to a stored dataset, and what must be told of it. Wrong rows: tests/services/run."""

import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.dataset.commit import LEDGER_SCHEMA, join_rows
from schemas.dataset.shard import Fingerprint
from schemas.errors import VersoError
from services.cli.main import main
from services.job.record import encode_job, read_success, require_job
from services.merge import merge as merge_module
from services.merge.merge import encode_success
from services.read import verdict as told_of
from services.read.verdict import COPY, Verdict, explain_damage
from services.read.verify import encode_fingerprint, verify
from services.read.verify_files import Success, check_success
from services.read.verify_range import Spans, read_records
from tests.damage import choose_places, damaged, files_by_kind
from tests.datasets import faults_of, in_a_bucket, make_dataset
from tests.kit import many_ranges
from tests.services.read.conftest import spoil
from workers.store.attempt import reopen
from workers.store.ledger import list_commits, save_rows
from workers.store.local import LocalStore
from workers.store.tars import encode_label

COMMIT, RANGE = "manifest/_commits/{:010d}.json".format, "manifest/_ranges/{:010d}".format
VIEWS = "manifest/views/category=box/part-00000.parquet"
FINGERPRINT = "manifest/_fingerprint.json"

Damage = Callable[[Path], object]


def edit(path: str, before: str, after: str) -> Damage:
    def damage(out: Path) -> None:
        text = (out / path).read_text()
        assert before in text
        (out / path).write_text(text.replace(before, after, 1))

    return damage


def remove(path: str) -> Damage:
    return lambda out: (out / path).unlink()


def folder(path: str) -> Damage:
    def damage(out: Path) -> None:
        (out / path).unlink()
        (out / path).mkdir()

    return damage


def job(**changes) -> Damage:
    """Other keys, sealed as if a run had written them."""

    def damage(out: Path) -> None:
        record = require_job(LocalStore(out))
        changed = record.job.model_copy(update=changes)
        LocalStore(out).put("job.yaml", encode_job(dataclasses.replace(record, job=changed)))

    return damage


def success(**changes):
    return lambda out: (out / "_SUCCESS").write_bytes(encode_success({**read_success(LocalStore(out)), **changes}))


def vouch(out, *paths):
    """Makes `_SUCCESS` name the bytes that merged files have now."""
    files = read_success(LocalStore(out))["files"]
    for path in paths:
        data = (out / path).read_bytes()
        files[path] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    success(files=files)(out)


def vouched_rows(out: Path) -> None:
    """Merged files with other values, for which `_SUCCESS` vouches."""
    rows = pq.read_table(out / VIEWS, partitioning=None)
    fx = pa.array([value + 1.0 for value in rows.column("fx").to_pylist()])
    pq.write_table(rows.set_column(rows.column_names.index("fx"), rows.schema.field("fx"), fx), out / VIEWS)
    for path in ("camPoses.csv", "objects.dat"):
        edit(path, "1", "2")(out)
    vouch(out, VIEWS, "camPoses.csv", "objects.dat")


def vouched_bytes(out: Path) -> None:
    """The same rows as another version of pyarrow wrote them, or of ours: without a column, of values that are never missing."""
    views = pq.read_table(out / VIEWS, partitioning=None).drop_columns("capture")
    scenes = pq.read_table(path := next(out.glob("manifest/scenes/*/*")), partitioning=None)
    at = scenes.schema.get_field_index("bodies")
    missing = ("recheck_move_mm", "recheck_turn_deg", "friction")
    body = [field.with_nullable(field.name in missing) for field in scenes.schema.types[at].value_type]
    solid = scenes.schema.set(at, pa.field("bodies", pa.list_(pa.struct(body))))
    pq.write_table(views, out / VIEWS, compression="gzip")
    pq.write_table(scenes.cast(solid), path)
    vouch(out, VIEWS)
    vouch(out, path.relative_to(out).as_posix())


def other_stack(out: Path) -> None:
    stored = Fingerprint.model_validate_json((out / FINGERPRINT).read_bytes())
    (out / FINGERPRINT).write_bytes(encode_fingerprint(stored.model_copy(update={"simd": "other"})))


def drop_range(*starts: int) -> Damage:
    """Ranges are deleted as if they had never been: commits, tables, images."""

    def damage(out: Path) -> None:
        for start in starts:
            (out / COMMIT(start)).unlink()
            shutil.rmtree(out / RANGE(start))
            for path in (path for pose in (2 * start, 2 * start + 1) for path in out.rglob(f"*{pose:05d}.png")):
                path.unlink()

    return damage


def unpublish(out: Path) -> None:
    """The files of a range lie where an attempt committed them."""
    (record,) = read_records(LocalStore(out), 2, [0], Verdict())
    staging = out / "_staging/0000000002" / record.attempt
    for entry in record.files:
        if not entry.path.startswith("assets/"):
            (staging / entry.path).parent.mkdir(parents=True, exist_ok=True)
            (out / entry.path).rename(staging / entry.path)


STRAYS = (
    *("notes.txt", ".hidden", "box/RGB00099.png", "box/patches/x", "box/0000000009.tar", "new/a/b.txt", "_SUCCESS~"),
    *("assets/x.glb", "assets/box/x.glb", "manifest/x", "manifest/_commits/x.json", "manifest/_commits/00.json"),
    *(f"{RANGE(0)}/more.parquet", "manifest/_ranges/x", "manifest/views/x.parquet", "_staged", "odd\n\udcff"),
    "manifest/views/category=box/part-00001.parquet",
)


def strays(out: Path) -> None:
    for path in (*STRAYS, "_logs/a/b.jsonl", "_staging/0000000000/r0-x/y", "_lock.json"):  # writers keep the last three
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        (out / path).write_bytes(b"x")


def special_files(out: Path) -> None:
    (out / "empty/inner").mkdir(parents=True)
    shutil.move(out / "can/RGB00000.png", out.parent / "elsewhere.png")
    (out / "can/RGB00000.png").symlink_to(out.parent / "elsewhere.png")
    (out / "linked").symlink_to(out.parent)
    os.mkfifo(out / "pipe")


NO_SEAL = "was altered after a run wrote it: its seal does not match: "
NOT_JOB = f"are not those of {COMMIT(0)}"
NOT_FINISHED = "_SUCCESS: is missing, not finished: "
DIFFERS = "does not match the SHA-256 in"
MISSING = "is committed and missing: restore it from a copy, or remove it, manifest/_commits/000000000"
AGAIN = "run the job again"

FILES: dict[str, tuple[tuple[Damage, ...], tuple[str, ...]]] = {
    "changed": (
        (
            lambda out: spoil(out / "can/depth00000.png"),
            lambda out: (out / "can/RGB00000.png").rename(out / "can/stray.png"),
            edit("cameras.csv", "\n", "\nmore\n"),
            edit("DATASET.md", "pairs", "Pairs"),
            edit(FINGERPRINT, "\n", "\n\n"),
            edit("job.yaml", "workers: null", "workers: 7"),
        ),
        (
            *(f"job.yaml: {NO_SEAL}", f"can/RGB00000.png: {MISSING}", f"{FINGERPRINT}: was altered"),
            *(
                f"can/depth00000.png: {DIFFERS} its commit: restore it from a copy, or remove it",
                "can/stray.png: is in no commit: move it",
            ),
            *(f"cameras.csv: {DIFFERS} _SUCCESS", f"DATASET.md: {NO_SEAL}"),
        ),
    ),
    "lost, and a table cut": (
        (
            lambda out: (out / f"{RANGE(1)}/views.parquet").write_bytes(b"PAR1"),
            *map(
                remove,
                ("can/RGB00000.png", "can/depth_around_00000_001.png", "DATASET.md", FINGERPRINT, "camPoses.csv"),
            ),
        ),
        (
            *(f"can/{name}.png: {MISSING}" for name in ("RGB00000", "depth_around_00000_001")),
            *(f"{RANGE(1)}/views.parquet: {DIFFERS}", "DATASET.md: is missing"),
            *(f"{FINGERPRINT}: is missing", "camPoses.csv: is merged and missing"),
        ),
    ),
    "strays": ((strays,), tuple(f"{path}: is in no commit".encode("unicode_escape").decode() for path in STRAYS)),
    "no plain files": (
        (special_files, folder(f"{RANGE(1)}/timings.parquet")),
        (
            *("can/RGB00000.png: is a symbolic link", "linked: is a symbolic link", "empty/inner: is an empty folder"),
            *(
                "pipe: is neither a file nor a folder",
                f"{RANGE(1)}/timings.parquet: is committed and is a folder, where",
            ),
        ),
    ),
    "a file where a folder was": (
        (lambda out: shutil.rmtree(out / "can/patches"), lambda out: (out / "can/patches").write_bytes(b"")),
        (
            *("can/patches/*.png: is committed and is missing: restore it from a copy, or",) * 11,
            "can/patches: is in no commit",
        ),
    ),
    "the merge undone": ((remove("_SUCCESS"),), (f"{NOT_FINISHED}every scene is committed, and they were not merged",)),
    "an empty _SUCCESS": ((lambda out: (out / "_SUCCESS").write_bytes(b""),), ("_SUCCESS: is empty: remove it",)),
    "another digest": ((success(digest="0" * 64),), ("_SUCCESS: its digest is not what the commits give",)),
    "merged bytes of another version": ((vouched_bytes,), ()),
    "merged rows of another dataset": (
        (vouched_rows,),
        (
            *(f"{path}: does not hold the rows of the commits" for path in (VIEWS, "camPoses.csv", "objects.dat")),
            "_SUCCESS: its files is not what the commits give",
        ),
    ),
}
"""What is done, and how each fault begins that must be told: all of them, in any order, and no other."""

COMMITS: dict[str, tuple[tuple[Damage, ...], tuple[str, ...]]] = {
    "other keys": (
        (job(seed=12),),
        ("job.yaml: its digest is not that of its keys", f"job.yaml: its keys or asset files * {NOT_JOB}"),
    ),
    "fewer scenes": ((job(scenes=2),), (f"{COMMIT(2)}: scenes 2 to 2 are committed, outside of those asked",)),
    "more scenes": ((job(scenes=4),), (f"{COMMIT(3)}: is missing: scenes 3 to 3 are not committed",)),
    "another stack": ((other_stack,), (f"{FINGERPRINT}: is the fingerprint * which no commit has",)),
    "a damaged record": ((edit(COMMIT(1), "span", "spin"),), (f"{COMMIT(1)}: was altered after it was written",)),
    "records in wrong places": (
        (
            lambda out: shutil.copy(out / COMMIT(1), out / COMMIT(4)),
            lambda out: (out / COMMIT(2)).rename(out / "manifest/_commits/0000000002.retry-1.json"),
        ),
        (
            f"{COMMIT(4)}: holds the record of another range",
            f"{COMMIT(3)}: is missing: scenes 3 to 3 are not committed",
            f"{COMMIT(2)}: is missing, and later tries of its range are there",
            "manifest/_commits/0000000002.retry-1.json: holds the record of another range",
        ),
    ),
    "the first two ranges dropped": (
        (drop_range(0, 1),),
        (
            *(f"{COMMIT(n)}: is missing: scenes {n} to {n} are not committed: {AGAIN}" for n in (0, 1)),
            "can/patches: is an empty folder",
        ),
    ),
    "the last range dropped": (
        (drop_range(2),),
        (f"{COMMIT(2)}: is missing: scenes 2 to 2 are not committed: {AGAIN}",),
    ),
    "a commit lost, and its files there": (
        (remove(COMMIT(1)),),
        (f"{COMMIT(1)}: is missing: scenes 1 to 1 are not committed",),
    ),
    "a range dropped before the merge": (
        (lambda out: reopen(LocalStore(out)), drop_range(1)),
        (f"scenes 1 to 1 are not committed: {AGAIN}", f"{NOT_FINISHED}2 of 3 scenes are committed: {AGAIN}"),
    ),
    "a range not yet published": (
        (unpublish,),
        (" committed files are in _staging, and not in their places: run", f"{RANGE(2)}: is an empty folder"),
    ),
    "tables of a retry without its commit": (
        (lambda out: shutil.copytree(out / RANGE(0), out / "manifest/_ranges/0000000000.retry-1"),),
        ("*: is in no commit, and manifest/_commits/0000000000.retry-1.json is missing",) * 6,
    ),
}


def mismatch(faults: list[str], told: tuple[str, ...]) -> list[str]:
    """Of faults and what must be told, those without a partner."""
    left = list(faults)
    missed = []
    for words in told:
        parts = words.split("*")
        found = next((one for one in left if all(part in one for part in parts)), None)
        missed.append(words) if found is None else left.remove(found)
    return [*missed, *left]


@pytest.mark.parametrize("table", [FILES, COMMITS], ids=["files", "commits"])
def test_each_damage_is_told_once_with_its_file_and_what_to_do(tiny, tmp_path, table):
    wrong = {}
    for name, (damages, told) in table.items():
        out = tmp_path / name
        shutil.copytree(tiny.root, out)
        for damage in damages:
            damage(out)
        faults = faults_of(LocalStore(out))
        if off := mismatch(faults, told):
            wrong[name] = off
        assert all("\n" not in fault and fault.isprintable() for fault in faults)
    assert wrong == {}


@pytest.mark.parametrize("layout", ["tiny", "packed"])
def test_a_whole_dataset_has_no_fault_and_each_file_is_read_once(layout, request, monkeypatch):
    store, reads, original = request.getfixturevalue(layout), Counter(), LocalStore.read

    def counted(self, key):
        reads[key] += 1
        return original(self, key)

    monkeypatch.setattr(LocalStore, "read", counted)
    found = verify(store, lambda _: None)
    assert (found.faults, found.scenes, found.pairs) == ([], 3, 3)
    files = {path for path in reads if path.endswith((".png", ".tar", ".glb"))}
    assert len(files) > 3 and {reads[path] for path in files} == {1}
    assert found.files >= len(files) and found.bytes >= sum((store.root / path).stat().st_size for path in files)
    monkeypatch.setattr(merge_module, "RANGES_PER_BLOCK", 2)
    assert faults_of(store) == []


def test_every_key_of_success_counts(tiny):
    """Compared without the rest of verify: the keys of a whole one, each with another value, or gone."""
    stored = read_success(tiny)
    assert len(stored) > 8
    changed = [({**stored, key: other}, key) for key in stored for other in ({"x": 1}, 5, "f" * 64, None)]
    changed += [({k: stored[k] for k in stored if k != key}, key) for key in stored]
    cases = [(encode_success(tree), tree, f"its {key} is not what") for tree, key in changed if tree != stored]
    cases += [(encode_success({**stored, "more": 1}), {**stored, "more": 1}, "its more is not what")]
    cases += [(json.dumps(stored).encode(), stored, "was altered after the merge wrote it")]
    for data, tree, told in cases:
        found = Verdict()
        check_success(Success(data, tree), stored, found)
        assert len(found.faults) == 1 and told in found.faults[0]


def test_the_range_size_of_the_commits_and_their_kept_summary_are_checked(copy):
    store = LocalStore(copy)
    rows = list_commits(store).rows
    save_rows(store, rows)
    assert faults_of(store) == []
    retry = {**rows.to_pylist()[1], "retry": 1, "scenes": [1]}
    save_rows(store, join_rows([rows, pa.Table.from_pylist([retry], LEDGER_SCHEMA)]))
    job(run=require_job(store).job.run.model_copy(update={"range_size": 4}))(copy)
    faults = faults_of(store)
    assert any("run.range_size is 4, that of the commits 1" in fault for fault in faults)
    assert any("0000000001.retry-1.json: is missing, manifest/_ledger names it: restore" in fault for fault in faults)
    (copy / "manifest/_ledger").write_bytes(store.read("manifest/_ledger")[:-1])
    assert "manifest/_ledger is damaged: remove it, the next run writes it again" in faults_of(store)


def test_labels_in_an_archive_that_differ_from_the_tables_are_told_although_every_digest_holds(tmp_path, monkeypatch):
    def wrong(label: dict) -> bytes:
        return encode_label(label).replace(b'"split":"', b'"split":"no ')

    with monkeypatch.context() as patch:
        patch.setattr("workers.store.tars.encode_label", wrong)
        store, _ = make_dataset(tmp_path, scenes=1, output={"layout": "tar"})
    told = faults_of(store)
    assert len(told) == 2 and ".tar: 00000.json differs from the tables at assets." in told[0]
    assert "verso replay" in told[0]


def test_a_dataset_in_an_object_store_is_read_back_as_on_a_disk(packed):
    store = in_a_bucket(packed.root)
    assert faults_of(store) == []
    store.put("box/stray.png", b"x")
    store.remove("camPoses.csv")
    store.remove(f"{RANGE(1)}/objects.parquet")
    told = (f"{RANGE(1)}/objects.parquet: {MISSING}", "camPoses.csv: is merged and", "box/stray.png: is in no commit")
    assert mismatch(faults_of(store), told) == []


def test_a_gap_of_a_billion_scenes_is_one_line_and_more_faults_than_anybody_reads_are_counted(monkeypatch):
    found = Verdict()
    spans = Spans((0, 10**9), 16, True, found)
    spans.finish()
    assert len(found.faults) == 1 and spans.gaps == [(0, 10**9)]
    monkeypatch.setattr(told_of, "MOST_FAULTS", 3)
    found = Verdict()
    for number in range(5):
        found.tell(str(number), COPY, "file")
    found.tell("_SUCCESS: is missing", COPY, "merge")
    assert (len(found.faults), found.untold) == (4, 2) and found.faults[-1].startswith("_SUCCESS")


def missed(store: LocalStore, count: int, seed: int) -> list[str]:
    """Places of random damage that verify does not name, or names without a remedy."""
    wrong = []
    for path, how, place in choose_places(store.root, count, seed):
        with damaged(store.root, path, how, place):
            faults = faults_of(store)
        named = [fault for fault in faults if fault.startswith(f"{path}: ")]
        remedies = (COPY, AGAIN)
        if not named or not any(remedy in named[0] for remedy in remedies) or "\n" in "".join(faults):
            wrong.append(f"{path}, {how} {place}: {faults}")
    return wrong


SOME = pytest.param(0, id="each kind", marks=pytest.mark.minute)
MANY = pytest.param(320, id="320", marks=[pytest.mark.slow, pytest.mark.timeout(1800)])


@pytest.mark.parametrize("layout", ["tiny", "packed"])
@pytest.mark.parametrize("count", [SOME, MANY])
def test_flips_cuts_and_losses_in_many_places_are_all_found(layout, count, request, tmp_path, record_figure):
    store = LocalStore(tmp_path / "copy")
    shutil.copytree(request.getfixturevalue(layout).root, store.root)
    count = count or int(1.6 * len(files_by_kind(store.root)))
    assert missed(store, count, 5) == []
    record_figure(f"corrupted_places_found[{layout}, {count}]", "passed", count)
    assert faults_of(store) == []


SQL = "select * from views join scenes using (scene_id), objects, assets, failures, timings"
COMMANDS = (("verify", "{out}"), ("status", "{out}"), ("query", "{out}", SQL), ("replay", "{out}", "1"))


def outcomes(copy: Path, capsys, places, commands) -> list[str]:
    """What commands said of damage that is no line of words: tracebacks raise by themselves."""
    wrong = []
    for path, how, place in places:
        with damaged(copy, path, how, place):
            for command in commands:
                code = main([word.format(out=copy) for word in command])
                told = capsys.readouterr().err
                # `status` and `replay` may find a difference, and tell it on standard output.
                lines = {1} if code and command[0] not in ("verify", "status", "replay") else {0, 1}
                if code not in (0, 1, 2) or told.count("\n") not in lines:
                    wrong.append(f"{path}, {how} {place}: {command[0]} {code}: {told}")
    return wrong


@pytest.mark.minute
def test_no_command_ends_in_a_traceback(copy, capsys):
    places = list(choose_places(copy, 300, 9))
    assert outcomes(copy, capsys, places[::12], COMMANDS[1:3]) == []
    assert outcomes(copy, capsys, places[::80], COMMANDS[:3]) == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_command_ends_in_a_traceback_in_any_of_300_places(copy, capsys):
    assert outcomes(copy, capsys, choose_places(copy, 300, 10), COMMANDS) == []


def test_a_folder_in_the_place_of_a_file_is_told_in_a_line(copy, capsys):
    for name in ("job.yaml", "_SUCCESS", FINGERPRINT, COMMIT(1), "camPoses.csv"):
        data = (copy / name).read_bytes()
        folder(name)(copy)
        codes = [main([word.format(out=copy) for word in command]) for command in COMMANDS[:3]]
        assert codes[0] == 1 and f"{name}: " in capsys.readouterr().out and set(codes[1:]) <= {0, 1, 2}
        (copy / name).rmdir()
        (copy / name).write_bytes(data)
    for raised in (IsADirectoryError(21, "Is a directory", "a"), ValueError("two\nlines"), OSError(5, "broken")):
        with pytest.raises(VersoError, match="`verso verify") as told, explain_damage(LocalStore(copy)):
            raise raised
        assert "\n" not in str(told.value)


VERIFY = """
import json, sys
from services.read.verify import verify
from tests.kit.memory import peak_mib
from workers.store.local import LocalStore
found = verify(LocalStore(sys.argv[1]), lambda now: None)
print(json.dumps({"parts": dict(found.parts), "scenes": found.scenes, "peak_mib": peak_mib()}))
"""


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_ten_thousand_ranges_take_little_more_memory_than_a_thousand(tmp_path, record_figure):
    """Ranges of one scene, six tables and a damaged tar, all merged again; without job.yaml, so without labels."""
    peaks = []
    for ranges in (1_000, 10_000):
        many_ranges.write_ranges(tmp_path / str(ranges), ranges)
        command = [sys.executable, "-c", VERIFY, str(tmp_path / str(ranges))]
        found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        assert found["scenes"] == ranges
        assert found["parts"] == {"job": 2, "file": ranges - (ranges + 499) // 1000, "merge": 1}
        record_figure(f"verify_peak_mib[{ranges} ranges]", "passed", found["peak_mib"], 1024.0)
        peaks.append(found["peak_mib"])
    assert peaks[1] - peaks[0] < 128 and peaks[1] < 1024
