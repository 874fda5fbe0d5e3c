"""Images from tars: a tar is read once, and what is kept is bounded."""

from collections import Counter

import pytest

from schemas.errors import CorruptError
from services.dataset import shapes as stored_files
from services.dataset.dataset import Dataset
from workers.store.local import LocalStore


class Counting(LocalStore):
    """Counts what is read of each key."""

    def __init__(self, root) -> None:
        super().__init__(root)
        self.reads: Counter[str] = Counter()

    def read(self, key: str) -> bytes:
        self.reads[key] += 1
        return super().read(key)


def read_all(store: LocalStore) -> int:
    views = [view for pair in Dataset(store).pairs() for view in (pair.input, pair.mirror) if view is not None]
    return sum(int(view.depth().sum()) for view in views)


def test_a_tar_is_read_once_while_it_is_used(tars):
    store = Counting(tars.root)
    read_all(store)
    read = {key: count for key, count in store.reads.items() if key.endswith(".tar")}
    assert read and set(read.values()) == {1}


def test_images_are_read_of_the_pairs_that_are_asked_alone(tars, files):
    store = Counting(tars.root)
    (first, *_) = Dataset(store).pairs()
    assert not any(key.endswith((".tar", ".png")) for key in store.reads)
    first.input.rgb()
    assert [key for key in store.reads if key.endswith(".tar")] == [f"{first.category}/0000000000.tar"]


def test_what_is_kept_of_tars_is_bounded_by_its_bytes(tars, monkeypatch):
    monkeypatch.setattr(stored_files, "TAR_BYTES", 1)
    store = Counting(tars.root)
    whole = read_all(LocalStore(tars.root))
    assert read_all(store) == whole
    assert max(count for key, count in store.reads.items() if key.endswith(".tar")) > 1


def test_an_image_that_no_tar_holds_is_named(tars):
    (pair, *_) = Dataset(LocalStore(tars.root)).pairs()
    with pytest.raises(CorruptError, match=r"mug/RGB99999\.png is committed and in no tar: `verso verify"):
        pair._files.image(0, "mug/RGB99999.png")
