"""Mutated commit records: each is refused by name or names only its own files, and nothing beside the folder changes."""

import contextlib
import json
import random
import shutil
from collections import Counter
from pathlib import Path

import pytest

from schemas.dataset.layout import commit_path
from schemas.errors import CommitConflict, CorruptError, OutputError
from tests.made_up_scenes import attempt_at, small_scene
from tests.mutations import mutated_bytes, mutated_tree
from workers.store.attempt import sweep
from workers.store.commit import decode_record, encode_record, publish, read_record, seal_record
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")

KEY = commit_path(0)


def mutated_record(number: int, data: bytes) -> bytes:
    """A record of version 2 or 1, mutated as bytes, or as a tree whose seal is whole again."""
    dice = random.Random(number)
    raw = json.loads(data)
    del raw["seal"]
    if number % 3 == 0:
        raw = json.loads(decode_record(data, KEY).model_dump_json()) | {"schema_version": 1}
    if dice.random() < 0.3:
        return mutated_bytes(dice, seal_record(raw))
    return seal_record(json.loads(json.dumps(mutated_tree(dice, raw))))  # a key of JSON is text


@pytest.fixture
def undecided(tmp_path, monkeypatch):
    """A dataset in work/out whose only commit is not published, and canaries where a path may lead that leaves it."""
    store = LocalStore(tmp_path / "work" / "out")
    store.prepare()
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        attempt_at(store, 0, 2, make=small_scene).commit()
    for place in ("victim", "work/victim", "work/out/job.yaml"):
        (tmp_path / place).write_text("precious")
    return store


def try_records(numbers: range, store: LocalStore, tmp_path: Path) -> Counter[str]:
    """Decodes, sweeps and publishes with every mutated record in place of the range's; counts what came of them."""
    outcomes: Counter[str] = Counter()
    data = store.read(KEY)
    kept = tmp_path / "kept"
    shutil.copytree(store.root, kept)
    canaries = [tmp_path / "victim", tmp_path / "work" / "victim", store.root / "job.yaml"]
    for number in numbers:
        mutated = mutated_record(number, data)
        shutil.rmtree(store.root)
        shutil.copytree(kept, store.root)
        (store.root / KEY).write_bytes(mutated)
        outcomes[outcome(mutated, store)] += 1
        assert [path.read_text() for path in canaries] == ["precious"] * 3, number
        assert {path.name for path in tmp_path.iterdir()} == {"kept", "victim", "work"}, number
        assert {path.name for path in (tmp_path / "work").iterdir()} == {"out", "victim"}, number
    return outcomes


def check_line(told: str) -> None:
    """One short line that a terminal can show."""
    assert told.isprintable(), told
    assert len(told) < 1000, told


def outcome(data: bytes, store: LocalStore) -> str:
    """`refused` or `read`; fails where anything else is raised than what is for damage, or in more than a line."""
    try:
        record = decode_record(data, KEY)
        assert decode_record(encode_record(record), KEY).span == record.span
        with contextlib.suppress(CorruptError, CommitConflict):  # a file that it names is not there
            sweep(store, fenced=None)
        found = read_record(store, 0)
        assert found is not None
        publish(store, found)
    except (CorruptError, CommitConflict, OutputError) as error:
        check_line(str(error))
        return "refused"
    return "read"


def test_fifty_mutated_records_touch_nothing_but_their_own_range(undecided, tmp_path):
    outcomes = try_records(range(50), undecided, tmp_path)
    assert outcomes["refused"] > 25 and outcomes["read"] > 0  # the mutations reach both


@pytest.mark.slow
def test_five_hundred_mutated_records_touch_nothing_but_their_own_range(undecided, tmp_path):
    assert try_records(range(50, 550), undecided, tmp_path).total() == 500
