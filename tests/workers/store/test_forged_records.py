"""A dataset from somebody else: whatever its records, names and links say, nothing outside its folder changes."""

import json
import os
from pathlib import Path

import pytest

from schemas.dataset.layout import STAGING, SUCCESS_FILE, commit_path
from schemas.errors import CorruptError, OutputError, RunError
from services.merge.merge import merge, read_success
from tests.made_up_datasets import FIRST, STOP, dataset_at
from tests.made_up_scenes import attempt_at
from workers.store.attempt import sweep
from workers.store.commit import seal_record
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")

PATHS = [
    "../../victim",
    "../victim",
    "/victim",
    "mug/../../victim",
    "mug//RGB00000.png",
    "./mug/RGB00000.png",
    "mug/./RGB00000.png",
    "mug/RGB00000.png/",
    "",
    ".",
    "..",
    "mug/RGB00000.png\0",
    "mug\\RGB00000.png",
    "mug/RGB00000.png\n",
    "mug/\x1b[2JRGB00000.png",
    "mug/RGB00000.png\u2028",
    "job.yaml",
    "_SUCCESS",
    "_lock.json",
    "DATASET.md",
    "camPoses.csv",
    "_staging/0000000004/r0-x/mug/RGB00000.png",
    "_logs/RGB00000.png",
    "manifest/_commits/0000000004.json",
    "manifest/_fingerprint.json",
    "manifest/RGB00000.png",
    "manifest/_ranges/0000000004/views.parquet",
    "manifest/_ranges/0000000000.retry-1/views.parquet",
    "manifest/_ranges/0000000000/../0000000004/views.parquet",
    "manifest/_ranges/0000000000/views.parquet.exe",
    "manifest/views/category=mug/part-00000.parquet",
    "mug/0000000004.tar",
    "mug/0000000000.retry-1.tar",
    "mug/RGB99999.png",
    "mug/RGB00008.png",
    "mug/photo00000.png",
    "mug/RGB0.png",
    "mug/RGB00000.svg",
    "mug/other/RGB00000.png",
    "assets/RGB00000.png",
    "assets/mug/a.sh",
    "assets/mug/b/a.glb",
    "assets/../mug/a.glb",
]
ATTEMPTS = [
    "../x",
    "r0-a/../../x",
    "r0-",
    "x",
    "",
    "r1-a",
    "r0-a.fenced",
    "r0-a\n",
    "r0-\x1b",
    "r0-" + "a" * 300,
    "/r0-a",
]
SPANS = [
    {"start": -1, "stop": 4, "retry": 0, "scenes": []},
    {"start": 0, "stop": 10**30, "retry": 0, "scenes": []},
    {"start": 0, "stop": 10**14, "retry": 0, "scenes": []},
    {"start": 0, "stop": 0, "retry": 0, "scenes": []},
    {"start": 0, "stop": 4, "retry": 0, "scenes": [1]},
    {"start": 0, "stop": 4, "retry": 1, "scenes": []},
    {"start": 0, "stop": 4, "retry": 1, "scenes": [9]},
    {"start": "../0", "stop": 4, "retry": 0, "scenes": []},
]


def forge(store: LocalStore, undecided, **changes) -> None:
    """Replaces the record of the first range by another, and puts a file wherever its paths point to in its staging."""
    raw = undecided.model_dump(mode="json") | {"schema_version": 1} | changes
    raw["terms"]["pairs_per_scene"] = 1
    (store.root / commit_path(0)).write_bytes(seal_record(raw))


def everything(folder: Path) -> dict[str, bytes | str]:
    """All files and links below a folder."""
    found = [path for path in folder.rglob("*") if path.is_symlink() or path.is_file()]
    return {str(path): os.readlink(path) if path.is_symlink() else path.read_bytes() for path in found}


@pytest.fixture
def store(tmp_path):
    """A dataset inside a folder with a victim, which must stay as it is."""
    (tmp_path / "victim").write_text("precious")
    store = LocalStore(tmp_path / "work" / "out")
    store.prepare()
    return store


@pytest.mark.parametrize("path", PATHS)
def test_a_path_that_is_not_one_of_the_range_is_refused_with_the_records_name(store, undecided, path, tmp_path):
    entry = undecided.files[0].model_dump() | {"path": path}
    staging = store.root / STAGING / "0000000000" / undecided.attempt
    target = Path(os.path.normpath(staging / path.replace("\0", "").lstrip("/")))
    if not target.is_dir():
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(bytes(entry["bytes"]))
    forge(store, undecided, files=[entry])
    before = everything(tmp_path)
    with pytest.raises(CorruptError, match=r"manifest/_commits/0000000000\.json is not a commit record: ") as told:
        sweep(store, fenced=None)
    assert len(str(told.value).splitlines()) == 1
    assert str(told.value).isprintable()
    assert everything(tmp_path) == before


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_an_attempt_with_another_name_is_refused(store, undecided, attempt):
    forge(store, undecided, attempt=attempt)
    with pytest.raises(CorruptError, match=r"0000000000\.json is not a commit record: "):
        sweep(store, fenced=None)


@pytest.mark.parametrize("span", SPANS)
def test_a_span_that_is_none_is_refused_at_once(store, undecided, span):
    forge(store, undecided, span=span)
    with pytest.raises(CorruptError, match=r"0000000000\.json is not a commit record: "):
        sweep(store, fenced=None)


def link_into(store: LocalStore, key: str, outside: Path) -> None:
    """A link at `key` that leads to a folder of the user's own."""
    outside.mkdir()
    (outside / "RGB00000.png").write_bytes(b"a holiday")
    (outside / "part-00000.parquet").write_bytes(b"a thesis")
    place = store.root / key
    if place.exists():
        place.rename(outside.parent / f"was-{place.name}")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(outside, target_is_directory=True)


@pytest.mark.parametrize("key", ["bottle", "camera", "mug", "mug/patches", "assets", "assets/mug", "manifest/_ranges"])
def test_nothing_is_published_through_a_link_that_leads_out(store, undecided, key, tmp_path):
    link_into(store, key, tmp_path / "home")
    before = everything(tmp_path / "home")

    def make_three_ranges():
        for start in (0, 4, 8):
            attempt_at(store, start, start + 4).commit()
            sweep(store, fenced=None)

    with pytest.raises(OutputError, match=f"{key} is a symbolic link that leads out of .*: nothing is written") as told:
        make_three_ranges()
    assert len(str(told.value).splitlines()) == 1
    assert everything(tmp_path / "home") == before


@pytest.mark.parametrize("key", ["_staging", "_staging/_tmp", "manifest", "manifest/_commits"])
def test_a_run_does_not_begin_where_a_link_leads_out(tmp_path, key):
    store = LocalStore(tmp_path / "out")
    link_into(store, key, tmp_path / "home")
    before = everything(tmp_path / "home")
    with pytest.raises(OutputError, match=f"{key} is a symbolic link that leads out of "):
        store.prepare()
    for write in (
        lambda: store.put(f"{key}/x", b""),
        lambda: store.put_if_absent(f"{key}/x", b""),
        lambda: store.stage(f"{key}/x"),
        lambda: store.remove(f"{key}/RGB00000.png"),
        lambda: store.remove_tree(key),
    ):
        with pytest.raises(OutputError, match="is a symbolic link that leads out of "):
            write()
    assert everything(tmp_path / "home") == before


def test_a_merge_removes_and_writes_nothing_behind_a_link(tmp_path):
    store = dataset_at(tmp_path / "out")
    link_into(store, "manifest/views", tmp_path / "home")
    before = everything(tmp_path / "home")
    with pytest.raises(OutputError, match="manifest/views is a symbolic link that leads out of "):
        merge(store, FIRST, STOP)
    assert everything(tmp_path / "home") == before


def test_a_link_that_stays_inside_is_followed(store, undecided):
    (store.root / "big").mkdir()
    for name in ("mug", "camera", "bottle"):
        (store.root / name).symlink_to("big", target_is_directory=True)
    sweep(store, fenced=None)
    assert list((store.root / "big").glob("*.png"))


def test_a_success_file_that_names_other_files_is_not_whole(tmp_path):
    store = dataset_at(tmp_path / "out", stop=FIRST + 4)
    merge(store, FIRST, FIRST + 4)
    success = json.loads(store.read(SUCCESS_FILE))
    assert read_success(store) == success
    for path in ("../victim", "job.yaml", "mug/RGB00000.png", "manifest/views/category=a/../x.parquet", ""):
        forged = success | {"files": success["files"] | {path: {"bytes": 8, "sha256": "0" * 64}}}
        store.put(SUCCESS_FILE, json.dumps(forged).encode())
        assert read_success(store) is None


@pytest.mark.parametrize(
    "folder", ["\u00b2", "\u0661\u0662\u0663\u0664\u0665\u0666\u0667\u0668\u0669\u0660", "9" * 30, "00"]
)
def test_a_folder_of_staging_with_another_name_is_left_alone(store, folder):
    (store.root / STAGING / folder / "r0-a").mkdir(parents=True)
    assert sweep(store, fenced=None) == []


def test_an_attempts_folder_with_another_name_is_told(store):
    (store.root / STAGING / "0000000000" / f"r{'9' * 5000}-a"[:200]).mkdir(parents=True)
    with pytest.raises((CorruptError, RunError), match="is not an attempt of this program"):
        sweep(store, fenced=None)
