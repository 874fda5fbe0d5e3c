import json

import pytest

from schemas.dataset.layout import commit_path
from schemas.errors import CorruptError, OutputError
from tests.made_up_scenes import attempt_at, made_scene
from tests.stored_images import iter_records
from workers.store.commit import (
    decode_record,
    encode_record,
    read_record,
)
from workers.store.ledger import read_summary

pytestmark = pytest.mark.usefixtures("unflushed")


def test_a_record_reads_back_as_it_was_and_always_has_the_same_bytes(store):
    record = attempt_at(store, 0, 4).commit().record
    data = store.read(commit_path(0))
    assert decode_record(data, "x") == record
    assert encode_record(decode_record(data, "x")) == data
    assert json.loads(data)["schema_version"] == 1
    assert json.loads(data)["span"] == {"start": 0, "stop": 4, "retry": 0, "scenes": []}


def test_a_record_is_small_and_grows_by_sixteen_characters_a_scene(store):
    """The whole record of 16 scenes with all their images and shapes."""
    record = attempt_at(store, 40, 44).commit().record
    assert all(entry.path.startswith("manifest/_ranges/") for entry in record.files)
    small = len(store.read(commit_path(attempt_at(store, 0, 4, make=made_scene).commit().record.span.start)))
    large = len(store.read(commit_path(attempt_at(store, 20, 36, make=made_scene).commit().record.span.start)))
    assert large < 2048
    assert large - small < 12 * 16 + 50


def test_every_altered_byte_of_a_record_is_found(store):
    attempt_at(store, 0, 2).commit()
    data = store.read(commit_path(0))
    for position in range(0, len(data), 5):
        damaged = bytearray(data)
        damaged[position] ^= 1
        with pytest.raises((CorruptError, OutputError)):
            decode_record(bytes(damaged), "manifest/_commits/0.json")


@pytest.mark.parametrize("damage", [b"", b"{", b"null", b"[]", b'{"a": 1}', b"\x00\x01", b'{"kind": "verso-commit"}'])
def test_a_foreign_record_is_refused_by_name(store, damage):
    (store.root / commit_path(0)).write_bytes(damage)
    for read in (lambda: read_record(store, 0), lambda: read_summary(store, 0), lambda: list(iter_records(store))):
        with pytest.raises(CorruptError, match=r"manifest/_commits/0000000000\.json"):
            read()


def test_a_torn_record_is_refused_by_name(store):
    attempt_at(store, 0, 2).commit()
    data = store.read(commit_path(0))
    (store.root / commit_path(0)).write_bytes(data[: len(data) // 2])
    with pytest.raises(CorruptError, match=r"0000000000.json is torn"):
        read_record(store, 0)


def test_a_record_of_a_newer_version_is_refused_and_one_with_more_keys_is_read(store):
    record = attempt_at(store, 0, 2).commit().record
    newer = record.model_copy(update={"schema_version": 2})
    with pytest.raises(OutputError, match="schema_version 2, and this program reads up to 1: install a newer"):
        decode_record(encode_record(newer), "x")

    class More(type(record)):
        colour: str = "red"

    more = More(**record.model_dump())
    assert b"colour" in encode_record(more)
    assert decode_record(encode_record(more), "x") == record
