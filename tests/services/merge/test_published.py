import contextlib

import pytest
from obstore.store import MemoryStore

from schemas.errors import CorruptError
from services.merge.reading import PublishedFiles, read_blocks
from tests.made_up_scenes import attempt_at, made_scene, terms
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")


@pytest.fixture(params=["files", "tar", "object store"])
def store(request, tmp_path):
    """A place with two ranges, and its layout."""
    far = request.param == "object store"
    store = ObjectStore(MemoryStore(), "memory://") if far else LocalStore(tmp_path / "out")
    store.prepare()
    for start in (0, 4):
        layout = "files" if request.param == "files" else "tar"
        attempt_at(store, start, start + 4, terms(layout=layout), made_scene).commit()
    return store


def check_all(store, tmp_path):
    with contextlib.closing(PublishedFiles(store, tmp_path)) as published:
        for block in read_blocks(store, 0, 8):
            published.check(block)


def test_what_is_all_there_is_accepted(store, tmp_path):
    check_all(store, tmp_path)


@pytest.mark.parametrize("kind", [".png", ".tar", ".glb", "failures.parquet"])
@pytest.mark.parametrize("cut", [False, True], ids=["missing", "cut"])
def test_a_file_that_is_missing_or_cut_is_told_by_name(store, tmp_path, kind, cut):
    keys = [entry.key for entry in store.files("") if entry.key.endswith(kind)]
    if not keys:
        pytest.skip("not in this layout")
    if cut:
        store.put(keys[-1], b"cut")
    else:
        store.remove(keys[-1])
    with pytest.raises(CorruptError, match=f"{keys[-1]} {'has 3 bytes' if cut else 'is named by a commit'}"):
        check_all(store, tmp_path)
