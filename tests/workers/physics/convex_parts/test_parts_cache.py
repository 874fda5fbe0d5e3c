"""Convex parts that are kept: in memory, in files, and across torn files."""

import hashlib

import numpy as np
import pytest

from tests.workers.physics.convex_parts.test_step import angle_iron
from workers.physics import convex_parts as module
from workers.physics.convex_parts import Parts, PartsCache, decompose, key_of


def digest_of(parts):
    return hashlib.sha256(b"".join(cloud.tobytes() + b"|" for cloud in parts.clouds)).hexdigest()


def test_an_answer_comes_from_memory_then_from_the_folder_and_is_the_same(tmp_path, monkeypatch):
    made = decompose(angle_iron(), "kept", folder=tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(module, "_run", lambda *_: pytest.fail("made once more"))
    assert digest_of(decompose(angle_iron(), "kept", folder=None)) == digest_of(made), "from memory"
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    again = decompose(angle_iron(), "kept", folder=tmp_path)
    assert (again.method, digest_of(again)) == (made.method, digest_of(made))
    assert not again.clouds[0].flags.writeable


@pytest.mark.parametrize("harm", [lambda data: data[:-7], lambda _: b"", lambda data: data[:60] + b"x" + data[61:]])
def test_a_torn_file_is_made_again(tmp_path, monkeypatch, harm):
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    made = decompose(angle_iron(), "torn", folder=tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(harm(whole))
    monkeypatch.setattr(module, "_CACHE", PartsCache())
    assert digest_of(decompose(angle_iron(), "torn", folder=tmp_path)) == digest_of(made)
    assert path.read_bytes() == whole


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(tmp_path):
    (tmp_path / "file").write_text("no folder")
    assert len(decompose(angle_iron(), "nowhere", folder=tmp_path / "file" / "parts").clouds) == 2


def test_memory_is_bounded_and_the_latest_stay():
    cache = PartsCache(capacity_bytes=100)
    for key in "abc":
        cache.get(key, None, lambda: Parts((np.zeros((2, 3)),), "convex"))
    for key in "bc":
        cache.get(key, None, lambda: pytest.fail("forgotten"))
    made = []
    for key in ("a", "large", "large"):
        cache.get(
            key, None, lambda key=key: made.append(key) or Parts((np.zeros((9 if key == "large" else 2, 3)),), "convex")
        )
    assert made == ["a", "large", "large"]


def test_a_key_depends_on_where_one_input_ends():
    assert len({key_of("ab", "c"), key_of("a", "bc"), key_of("abc"), key_of(b"ab", "c")}) == 3
