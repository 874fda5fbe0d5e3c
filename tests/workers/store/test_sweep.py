import pytest

from schemas.dataset.layout import STAGING
from schemas.errors import CorruptError
from tests.kit.faults import check_published
from tests.made_up_scenes import attempt_at
from workers.store.attempt import sweep

pytestmark = pytest.mark.usefixtures("unflushed")


def test_sweeping_publishes_winners_drops_losers_and_leaves_the_undecided(store, undecided):
    lost = attempt_at(store, 0, 4)
    open_range = attempt_at(store, 4, 8)
    dead = attempt_at(store, 8, 12)
    assert sweep(store, fenced=[(8, dead.name)]) == [lost.name, dead.name]
    check_published(store, undecided)
    assert {entry.key.split("/")[2] for entry in store.files(STAGING)} == {open_range.name}
    assert open_range.commit().won


def test_a_retry_of_a_committed_range_is_not_swept_as_its_loser(store):
    attempt_at(store, 0, 4).commit()
    retry = attempt_at(store, 0, 4, retry=1, scenes=(2,))
    assert sweep(store) == []
    assert retry.commit().won


def test_sweeping_leaves_what_is_not_ours_and_says_so(store):
    store.put(f"{STAGING}/0000000000/mine/notes.txt", b"")
    with pytest.raises(CorruptError, match=f"{STAGING}/0000000000/mine is not an attempt"):
        sweep(store)


def test_temporary_files_of_the_dead_are_swept(store):
    store.put("manifest/_commits/.probe-1", b"")
    store.put(f"{STAGING}/_tmp/.x", b"")
    sweep(store)
    assert not list(store.files("manifest/_commits"))
    assert not list(store.files(STAGING))
