"""Merging again what was read gives what the merge wrote, whatever the size of its blocks."""

import contextlib
import hashlib

import pytest

from services.merge.merge import read_success
from services.read import verify as remerge
from services.read.verdict import PathIndex, Verdict
from services.read.verify import Remerge
from services.read.verify_range import RangeCheck, read_records


@pytest.mark.parametrize("ranges", [1, 2, 128])
def test_the_files_and_the_digest_are_those_of_the_merge(tiny, tmp_path, monkeypatch, ranges):
    monkeypatch.setattr(remerge, "RANGES_PER_BLOCK", ranges)
    check = RangeCheck(tiny, None, None, PathIndex(tmp_path), Verdict())
    with contextlib.closing(check.index), contextlib.closing(Remerge(tmp_path)) as again:
        for start in range(3):
            again.add(check.check(read_records(tiny, start, [0], check.verdict)))
        success, files = again.finish()
    merged = read_success(tiny)
    assert {key: value for key, value in merged.items() if key in success} == success
    assert merged.keys() - success.keys() == {"first_scene", "stop_scene", "commits"}
    assert {path: hashlib.sha256(file.read_bytes()).hexdigest() for path, file in files.items()} == {
        path: hashlib.sha256(tiny.read(path)).hexdigest() for path in files
    }
