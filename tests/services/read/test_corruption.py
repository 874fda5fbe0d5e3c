"""Flips, cuts and missing files in many places of a finished dataset: all found, with the file and what to do."""

from pathlib import Path

import pytest

from services.read.verdict import COPY
from services.read.verify import verify
from tests.damage import choose_places, damaged, files_by_kind
from workers.store.local import LocalStore


@pytest.fixture(scope="module", params=["tiny", "packed"])
def store(request) -> LocalStore:
    return request.getfixturevalue(request.param)


def missed(store: LocalStore, count: int, seed: int) -> list[str]:
    """Places that verify does not name, or names without a remedy."""
    root, wrong = Path(store.root), []
    for path, how, place in choose_places(root, count, seed):
        with damaged(root, path, how, place):
            faults = verify(store, lambda _: None).faults
        named = [fault for fault in faults if fault.startswith(f"{path}: ")]
        remedies = ("--repair`", COPY, "run the job again")
        if not named or not any(remedy in named[0] for remedy in remedies) or "\n" in "".join(faults):
            wrong.append(f"{path}, {how} {place}: {faults}")
    return wrong


def test_damage_of_every_kind_of_file_is_found_and_named(store, record_figure):
    assert verify(store, lambda _: None).faults == []
    count = int(1.6 * len(files_by_kind(Path(store.root))))
    assert missed(store, count, 5) == []
    record_figure(f"corrupted_places_found[{store.name.rpartition('/')[2]}]", "passed", count)
    assert verify(store, lambda _: None).faults == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_three_hundred_places_are_found(store, record_figure):
    assert missed(store, 320, 6) == []
    record_figure(f"corrupted_places_found[{store.name.rpartition('/')[2]}, all]", "passed", 320)
