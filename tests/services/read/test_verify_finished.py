"""What the merge wrote is compared with the commits themselves, not with what `_SUCCESS` says of it."""

import hashlib
import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.dataset.layout import SUCCESS_FILE
from services.merge.merge import encode_success, read_success
from services.read.verdict import Verdict
from services.read.verify_files import Success, check_success
from tests.datasets import faults_of
from workers.store.local import LocalStore


def vouch(out, path: str) -> None:
    """Makes `_SUCCESS` name the bytes that a merged file has now."""
    success = read_success(LocalStore(out))
    assert success is not None
    data = (out / path).read_bytes()
    success["files"][path] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (out / SUCCESS_FILE).write_bytes(encode_success(success))


def test_success_that_was_removed_or_emptied_is_told(copy):
    (copy / SUCCESS_FILE).write_bytes(b"")
    assert faults_of(LocalStore(copy))[0].startswith("_SUCCESS: is empty: `verso replay")
    (copy / SUCCESS_FILE).unlink()
    (fault,) = faults_of(LocalStore(copy))
    assert fault.startswith("_SUCCESS: is missing, not finished: every scene is committed, and they were not merged")
    assert "run the job again" in fault


def test_every_key_of_success_counts(tiny):
    """Compared without the rest of verify: the keys of a whole one, each with another value, or gone."""
    whole = read_success(tiny)
    assert len(whole) > 8
    for key, value in whole.items():
        others = [{"x": 1}, 5, "f" * 64, None]
        for changed in [
            *({**whole, key: other} for other in others if other != value),
            {k: whole[k] for k in whole if k != key},
        ]:
            found = Verdict()
            check_success(Success(encode_success(changed), changed), whole, found)
            assert len(found.faults) == 1 and f"its {key} is not what the commits give" in found.faults[0]
    for data in (encode_success({**whole, "more": 1}), json.dumps(whole).encode()):
        found = Verdict()
        check_success(Success(data, json.loads(data)), whole, found)
        assert len(found.faults) == 1


def test_a_wrong_digest_is_found_by_the_whole_of_verify(copy):
    success = read_success(LocalStore(copy))
    (copy / SUCCESS_FILE).write_bytes(encode_success({**success, "digest": "0" * 64}))
    assert "_SUCCESS: its digest is not what the commits give" in faults_of(LocalStore(copy))[0]


def test_a_merged_table_with_other_bytes_and_the_same_rows_is_whole_where_success_vouches_for_it(copy):
    path = "manifest/views/category=box/part-00000.parquet"
    rows = pq.read_table(copy / path, partitioning=None)
    pq.write_table(rows, copy / path, compression="gzip")
    vouch(copy, path)
    assert faults_of(LocalStore(copy)) == []


@pytest.mark.parametrize("path", ["manifest/views/category=box/part-00000.parquet", "camPoses.csv", "objects.dat"])
def test_merged_rows_that_are_not_the_commits_are_told_even_where_success_vouches_for_them(copy, path):
    if path.endswith(".parquet"):
        rows = pq.read_table(copy / path, partitioning=None)
        fx = pa.array([value + 1.0 for value in rows.column("fx").to_pylist()])
        pq.write_table(rows.set_column(rows.column_names.index("fx"), rows.schema.field("fx"), fx), copy / path)
    else:
        (copy / path).write_text((copy / path).read_text().replace("1", "2", 3))
    vouch(copy, path)
    assert any(
        fault.startswith(f"{path}: does not hold the rows of the commits") for fault in faults_of(LocalStore(copy))
    )


def test_a_card_of_another_dataset_is_told(copy):
    card = copy / "DATASET.md"
    card.write_text(card.read_text().replace("pairs", "Pairs", 1))
    assert "DATASET.md: was altered" in faults_of(LocalStore(copy))[0]
    card.unlink()
    assert "DATASET.md: is missing" in faults_of(LocalStore(copy))[0]
