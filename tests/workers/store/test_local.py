import os
import subprocess
import sys
import threading

import pytest

from schemas.dataset.layout import TEMPORARY
from schemas.errors import OutputError
from workers.store.local import LocalStore, open_store
from workers.store.objects import ObjectStore


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path / "out")
    store.prepare()
    return store


def test_the_first_put_stands_and_the_second_is_refused(store):
    assert store.put_if_absent("manifest/_commits/a.json", b"first")
    assert not store.put_if_absent("manifest/_commits/a.json", b"second")
    assert store.read("manifest/_commits/a.json") == b"first"
    assert not list(store.files(TEMPORARY))


def test_of_many_threads_that_put_one_key_exactly_one_wins(store):
    won = []
    gate = threading.Barrier(8)

    def put(number):
        gate.wait()
        for key in range(20):
            if store.put_if_absent(f"manifest/_commits/{key}", str(number).encode()):
                won.append((key, number))

    threads = [threading.Thread(target=put, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(key for key, _ in won) == list(range(20))
    assert all(store.read(f"manifest/_commits/{key}") == str(number).encode() for key, number in won)


def test_a_temporary_file_that_is_swept_away_is_written_again(store, monkeypatch):
    real = os.link
    swept = []

    def link(source, target):
        if not swept:
            swept.append(source)
            os.unlink(source)
        real(source, target)

    monkeypatch.setattr(os, "link", link)
    assert store.put_if_absent("manifest/_commits/a.json", b"data")
    assert store.read("manifest/_commits/a.json") == b"data"


def test_a_swept_attempt_can_neither_write_nor_put(store):
    store.open_staging("_staging/0/a")
    store.write_staged("_staging/0/a", "mug/x.png", b"x")
    store.fence("_staging/0/nobody")
    store.fence("_staging/0/a")
    for path in ("y.png", "mug/y.png", "deep/er/y.png"):
        with pytest.raises(FileNotFoundError):
            store.write_staged("_staging/0/a", path, b"y")
    with pytest.raises(FileNotFoundError):
        store.put_if_absent("manifest/_commits/a.json", b"record", "_staging/0/a")
    assert store.children("_staging/0") == ["a.fenced"]
    assert store.size("manifest/_commits/a.json") is None


def test_files_are_listed_with_sizes_in_order_and_folders_one_level_deep(store):
    for key in ("mug/b.png", "mug/a.png", "mug/patches/a.png"):
        store.write_whole(key, b"12")
    assert list(store.files("mug")) == [("mug/a.png", 2), ("mug/b.png", 2), ("mug/patches/a.png", 2)]
    assert store.children("mug") == ["patches"]
    assert list(store.files("nothing")) == []
    assert store.children("nothing") == []


def test_a_rename_makes_the_folder_it_needs_and_says_when_its_source_is_gone(store):
    store.write_whole("a", b"1")
    store.rename("a", "new/folder/b")
    assert store.read("new/folder/b") == b"1"
    with pytest.raises(FileNotFoundError):
        store.rename("a", "new/folder/b")
    assert store.read("new/folder/b") == b"1"


def test_a_folder_that_cannot_be_made_is_an_error_of_the_command_line(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="file/out cannot be written"):
        LocalStore(tmp_path / "file" / "out").prepare()


def test_opening_a_folder_loads_no_object_store(tmp_path):
    code = (
        "import sys; from workers.store.local import open_store; "
        f"open_store({str(tmp_path)!r}); sys.exit('obstore' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert isinstance(open_store(str(tmp_path)), LocalStore)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("url", ["s3://", "ftp://host/x", "az://c/x"])
def test_a_url_that_names_no_store_is_an_error_of_the_command_line(url):
    with pytest.raises(OutputError, match="is not an object store that can be opened"):
        open_store(url)


def test_a_url_that_names_a_store_is_opened_with_its_prefix():
    store = open_store("s3://bucket/a/dataset")
    assert isinstance(store, ObjectStore)
    assert store.name == "s3://bucket/a/dataset"
    assert store._bucket.prefix == "a/dataset"
