import os

import pytest

from schemas.errors import MachineError
from workers.store.disk_errors import explain_disk_errors
from workers.store.local import LocalStore


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


def test_a_full_disk_is_told_with_what_to_do(store, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    store.open_staging("_staging/0/a")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(MachineError, match=r"manifest/_commits/a.json.*disk is full.*free some space"):
        store.put_if_absent("manifest/_commits/a.json", b"x")


def test_an_error_that_nobody_can_mend_stays_as_it_is():
    with pytest.raises(FileExistsError), explain_disk_errors("a file could not be written"):
        raise FileExistsError(17, "File exists")
