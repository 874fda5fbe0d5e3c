"""Fixtures that tests in this folder may ask for."""

import pytest

from tests.kit.faults import unflushed
from tests.made_up_scenes import attempt_at
from workers.store.local import LocalStore

__all__ = ["unflushed"]


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


@pytest.fixture
def undecided(store, monkeypatch):
    """A commit that was decided and not published: its worker died in between."""
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        return attempt_at(store, 0, 4).commit().record
