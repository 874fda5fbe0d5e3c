"""One range read back: damage is told once, by the file, and labels are derived where the files are whole."""

from pathlib import Path

from schemas.dataset.layout import commit_path
from services.read.verdict import PathIndex, Verdict
from services.read.verify import read_stored_job
from services.read.verify_range import RangeCheck, read_records
from tests.datasets import faults_of, make_dataset
from workers.store.local import LocalStore
from workers.store.tars import encode_label


def test_a_range_is_counted_and_its_rows_are_kept(tiny, tmp_path):
    found = Verdict()
    job, index = read_stored_job(tiny, found), PathIndex(tmp_path)
    records = read_records(tiny, 1, [0], found)
    one = RangeCheck(tiny, job.record, job.digest, index, found).check(records)
    assert (found.scenes, found.pairs, found.faults, one.staged) == (1, 1, [], 0)
    assert one.rows["views"].num_rows == 4
    assert found.files == len(one.files) > 20
    index.close()


def test_a_damaged_image_is_one_fault(copy):
    image = next(copy.glob("*/depth0*.png"))
    data = bytearray(image.read_bytes())
    data[len(data) // 2] ^= 1
    image.write_bytes(data)
    (fault,) = faults_of(LocalStore(copy))
    assert fault.startswith(
        f"{image.parent.name}/{image.name}: does not match the SHA-256 in its commit: `verso replay"
    )


def test_a_damaged_table_is_one_fault_and_the_other_ranges_are_read(copy):
    path = copy / "manifest/_ranges/0000000001/views.parquet"
    path.write_bytes(path.read_bytes()[:-9])
    faults = faults_of(LocalStore(copy))
    assert faults[0].startswith("manifest/_ranges/0000000001/views.parquet: does not match the SHA-256 in its commit")
    assert not any(".png" in fault for fault in faults)
    (copy / "camPoses.csv").unlink()
    assert any(fault.startswith("camPoses.csv: is merged and missing") for fault in faults_of(LocalStore(copy)))


def test_a_damaged_record_is_told_and_the_rest_is_read(copy):
    path = copy / commit_path(1)
    path.write_bytes(path.read_bytes().replace(b"span", b"spin", 1))
    faults = faults_of(LocalStore(copy))
    assert len(faults) == 1, faults
    assert faults[0].startswith(f"{commit_path(1)}: was altered after it was written")


def test_files_that_are_committed_and_not_yet_published_are_read_where_they_lie(copy):
    record = read_records(LocalStore(copy), 2, [0], Verdict())[0]
    staging = copy / "_staging/0000000002" / record.attempt
    for entry in record.files:
        if not entry.path.startswith("assets/"):
            (staging / entry.path).parent.mkdir(parents=True, exist_ok=True)
            Path(copy / entry.path).rename(staging / entry.path)
    told = "\n".join(faults_of(LocalStore(copy)))
    assert "committed files are in _staging, and not in their places: run the job again" in told
    assert "is committed and missing" not in told


def test_labels_in_an_archive_that_differ_from_the_tables_are_told_although_every_digest_holds(tmp_path, monkeypatch):
    def wrong(label: dict) -> bytes:
        return encode_label(label).replace(b'"split":"', b'"split":"no ')

    with monkeypatch.context() as patch:
        patch.setattr("workers.store.tars.encode_label", wrong)
        store, _ = make_dataset(tmp_path / "wrong", scenes=1, output={"layout": "tar"})
    told = faults_of(store)
    assert len(told) == 2
    assert ".tar: 00000.json differs from the tables at assets." in told[0]
    assert "verso replay" in told[0]
    store, _ = make_dataset(tmp_path / "right", scenes=1, output={"layout": "tar"})
    assert faults_of(store) == []
