"""A dataset from somebody else: whatever its records, names and links say, nothing outside its folder changes."""

import contextlib
import json
import os
import random
import shutil
from collections import Counter
from pathlib import Path

import pytest

from schemas.dataset.layout import STAGING, SUCCESS_FILE, commit_path
from schemas.errors import CommitConflict, CorruptError, OutputError, RunError
from services.job.record import read_success
from services.merge.merge import merge
from tests.made_up_scenes import attempt_at, small_scene
from tests.mutations import mutated_bytes, mutated_tree
from workers.store.attempt import sweep
from workers.store.commit import decode_record, encode_record, publish, read_record, seal_record
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")

KEY = commit_path(0)
FIELDS = ("start", "stop", "retry", "scenes")
OUTSIDE = (
    *("../../victim", "../victim", "/victim", "mug/../../victim", "mug//RGB00000.png", "./mug/RGB00000.png", "", "."),
    *("mug/./RGB00000.png", "mug/RGB00000.png/", "..", "mug/RGB00000.png\0", "mug\\RGB00000.png"),
)
UNPRINTABLE = ("mug/RGB00000.png\n", "mug/\x1b[2JRGB00000.png", "mug/RGB00000.png\u2028")
OF_THE_DATASET = (
    *("job.yaml", "_SUCCESS", "_lock.json", "DATASET.md", "camPoses.csv", "_logs/RGB00000.png"),
    *("_staging/0000000004/r0-x/mug/RGB00000.png", "manifest/_commits/0000000004.json", "manifest/_fingerprint.json"),
    *("manifest/RGB00000.png", "manifest/views/category=mug/part-00000.parquet"),
)
OF_ANOTHER_RANGE = (
    *("manifest/_ranges/0000000004/views.parquet", "manifest/_ranges/0000000000.retry-1/views.parquet"),
    *("manifest/_ranges/0000000000/../0000000004/views.parquet", "mug/0000000004.tar"),
    *("mug/0000000000.retry-1.tar", "mug/RGB99999.png", "mug/RGB00008.png"),
)
OF_NO_KIND = (
    *("manifest/_ranges/0000000000/views.parquet.exe", "mug/photo00000.png", "mug/RGB0.png", "mug/RGB00000.svg"),
    *("mug/other/RGB00000.png", "assets/RGB00000.png", "assets/mug/a.sh", "assets/mug/b/a.glb", "assets/../mug/a.glb"),
)
PATHS = OUTSIDE + UNPRINTABLE + OF_THE_DATASET + OF_ANOTHER_RANGE + OF_NO_KIND
ATTEMPTS = (
    *("../x", "r0-a/../../x", "r0-", "x", "", "r1-a", "r0-a.fenced", "r0-a\n", "r0-\x1b", "/r0-a"),
    "r0-" + "a" * 300,
)
SPANS: tuple = (
    *((-1, 4, 0, []), (0, 10**30, 0, []), (0, 10**14, 0, []), (0, 0, 0, [])),
    *((0, 4, 0, [1]), (0, 4, 1, []), (0, 4, 1, [9]), ("../0", 4, 0, [])),
)


@pytest.fixture
def store(tmp_path):
    """A dataset inside a folder with a victim, which must stay as it is."""
    (tmp_path / "victim").write_text("precious")
    store = LocalStore(tmp_path / "work" / "out")
    store.prepare()
    return store


def everything(folder: Path) -> dict[str, bytes | str]:
    """All files and links below a folder."""
    seen = [path for path in folder.rglob("*") if path.is_symlink() or path.is_file()]
    return {str(path): os.readlink(path) if path.is_symlink() else path.read_bytes() for path in seen}


def refused(store: LocalStore, record, **changes) -> str:
    """What a sweep says of the record with these keys changed, in its own form and with a whole seal."""
    raw = json.loads(encode_record(record))
    del raw["seal"]
    (store.root / KEY).write_bytes(seal_record(raw | changes))
    with pytest.raises(CorruptError, match=r"manifest/_commits/0000000000\.json is not a commit record: ") as error:
        sweep(store, fenced=None)
    assert len(str(error.value).splitlines()) == 1 and str(error.value).isprintable()
    return str(error.value)


def test_a_path_that_is_not_one_of_the_range_is_refused_with_the_records_name(store, undecided, tmp_path):
    entry = undecided.files[0]
    staging = store.root / STAGING / "0000000000" / undecided.attempt
    (store.root / KEY).write_bytes(encode_record(undecided.model_copy(update={"files": (entry,)})))
    assert read_record(store, 0).files == (entry,)  # the forger's form is read, where its paths are the range's own
    for path in PATHS:
        target = Path(os.path.normpath(staging / path.replace("\0", "").lstrip("/")))
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(bytes(entry.bytes))
        before = everything(tmp_path)
        assert "is not a file of the range" in refused(store, undecided, files=[[path, entry.bytes, entry.sha256]]), (
            path
        )
        assert everything(tmp_path) == before | {str(store.root / KEY): (store.root / KEY).read_bytes()}, path


def test_a_name_or_a_span_that_is_none_is_refused_at_once(store, undecided):
    for attempt in ATTEMPTS:
        message = refused(store, undecided, attempt=attempt)
        assert "is not the name of an attempt" in message or len(attempt) > 200  # the message is cut there
    for span in SPANS:
        refused(store, undecided, span=dict(zip(FIELDS, span, strict=True)))


def link_into(store: LocalStore, key: str, outside: Path) -> dict[str, bytes | str]:
    """A link at `key` that leads to a folder of the user's own, whose contents come back."""
    outside.mkdir()
    (outside / "RGB00000.png").write_bytes(b"a holiday")
    (outside / "part-00000.parquet").write_bytes(b"a thesis")
    place = store.root / key
    if place.exists():
        place.rename(outside.parent / f"was-{place.name}")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(outside, target_is_directory=True)
    return everything(outside)


@pytest.mark.parametrize("key", ["mug", "mug/patches", "assets/mug", "manifest/_ranges", "manifest/views"])
def test_nothing_is_published_or_merged_through_a_link_that_leads_out(store, undecided, key, tmp_path):
    def publish_and_merge():
        for start in (0, 4, 8):
            attempt_at(store, start, start + 4).commit()
            sweep(store, fenced=None)
        merge(store, 0, 12)

    before = link_into(store, key, tmp_path / "home")
    with pytest.raises(
        OutputError, match=f"{key} is a symbolic link that leads out of .*: nothing is written"
    ) as error:
        publish_and_merge()
    assert len(str(error.value).splitlines()) == 1
    assert everything(tmp_path / "home") == before


@pytest.mark.parametrize("key", ["_staging/_tmp", "manifest", "manifest/_commits"])
def test_a_run_does_not_begin_where_a_link_leads_out(tmp_path, key):
    store = LocalStore(tmp_path / "out")
    before = link_into(store, key, tmp_path / "home")
    (tmp_path / "a").touch()
    with pytest.raises(OutputError, match=f"{key} is a symbolic link that leads out of "):
        store.prepare()
    for write in (
        lambda: store.put(f"{key}/x", b""),
        lambda: store.put_if_absent(f"{key}/x", b""),
        lambda: store.stage(f"{key}/x"),
        lambda: store.move("a", f"{key}/x"),
        lambda: store.move(f"{key}/RGB00000.png", "a"),
        lambda: store.replace(tmp_path / "a", f"{key}/x"),
        lambda: store.withdraw(f"{key}/RGB00000.png", tmp_path),
        lambda: store.revoke(f"{key}/x"),
        lambda: store.remove(f"{key}/RGB00000.png"),
        lambda: store.remove_tree(key),
    ):
        with pytest.raises(OutputError, match="is a symbolic link that leads out of "):
            write()
    assert everything(tmp_path / "home") == before


def test_a_link_that_stays_inside_is_followed(store, undecided):
    (store.root / "big").mkdir()
    for name in ("mug", "camera", "bottle"):
        (store.root / name).symlink_to("big", target_is_directory=True)
    sweep(store, fenced=None)
    assert list((store.root / "big").glob("*.png"))


def test_a_success_file_that_names_other_files_is_not_whole(store):
    attempt_at(store, 0, 4).commit()
    merge(store, 0, 4)
    success = json.loads(store.read(SUCCESS_FILE))
    assert read_success(store) == success
    for path in ("../victim", "job.yaml", "mug/RGB00000.png", "manifest/views/category=a/../x.parquet", ""):
        forged = success | {"files": success["files"] | {path: {"bytes": 8, "sha256": "0" * 64}}}
        store.put(SUCCESS_FILE, json.dumps(forged).encode())
        assert read_success(store) is None


def test_folders_of_staging_with_another_name_are_left_alone_and_an_attempts_is_told(store):
    digits = "".join(map(chr, range(0x661, 0x66A))) + "\u0660"  # which Python takes for digits
    for folder in ("\u00b2", digits, "9" * 30, "00"):
        (store.root / STAGING / folder / "r0-a").mkdir(parents=True)
        assert sweep(store, fenced=None) == []
    (store.root / STAGING / "0000000000" / f"r{'9' * 5000}-a"[:200]).mkdir(parents=True)
    with pytest.raises((CorruptError, RunError), match="is not an attempt of this program"):
        sweep(store, fenced=None)


def mutated_record(number: int, data: bytes) -> bytes:
    """A record, mutated as bytes, or as a tree whose seal is whole again."""
    dice = random.Random(number)
    raw = json.loads(data)
    del raw["seal"]
    if dice.random() < 0.3:
        return mutated_bytes(dice, seal_record(raw))
    return seal_record(json.loads(json.dumps(mutated_tree(dice, raw))))  # a key of JSON is text


def outcome(data: bytes, store: LocalStore) -> str:
    """`refused` or `read`; fails where anything else is raised than what is for damage, or in more than a line."""
    try:
        record = decode_record(data, KEY)
        assert decode_record(encode_record(record), KEY).span == record.span
        with contextlib.suppress(CorruptError, CommitConflict):  # a file that it names is not there
            sweep(store, fenced=None)
        seen = read_record(store, 0)
        assert seen is not None
        publish(store, seen)
    except (CorruptError, CommitConflict, OutputError) as error:
        return "refused" if str(error).isprintable() and len(str(error)) < 1000 else "told badly"
    return "read"


@pytest.mark.parametrize(
    "numbers", [range(50), pytest.param(range(50, 550), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_mutated_records_touch_nothing_but_their_own_range(store, tmp_path, monkeypatch, numbers):
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        attempt_at(store, 0, 2, make=small_scene).commit()
    canaries = [tmp_path / "victim", tmp_path / "work" / "victim", store.root / "job.yaml"]
    for canary in canaries:
        canary.write_text("precious")
    outcomes, data, kept = Counter[str](), store.read(KEY), tmp_path / "kept"
    shutil.copytree(store.root, kept)
    for number in numbers:
        shutil.rmtree(store.root)
        shutil.copytree(kept, store.root)
        (store.root / KEY).write_bytes(mutated := mutated_record(number, data))
        outcomes[outcome(mutated, store)] += 1
        assert [path.read_text() for path in canaries] == ["precious"] * 3, number
        assert {path.name for path in tmp_path.iterdir()} == {"kept", "victim", "work"}, number
        assert {path.name for path in (tmp_path / "work").iterdir()} == {"out", "victim"}, number
    assert (
        outcomes["refused"] > len(numbers) // 2 and not outcomes["told badly"] and outcomes["read"] > 0
    )  # the mutations reach both
