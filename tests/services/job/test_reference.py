"""docs/job.md, and the names of keys that error messages offer."""

from pathlib import Path

import pytest

from services.job.reference import allowed_keys, describe_allowed, list_keys, write_doc

ROOT = Path(__file__).resolve().parents[3]


def test_every_key_is_documented_and_the_page_is_current():
    assert [path for path, field in list_keys() if not field.description] == []
    assert (ROOT / "docs" / "job.md").read_text() == write_doc()


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("images.projection.splat", "whole number, >= 1, <= 15"),
        ("start.offset_m", "[low, high]"),
        ("cameras.depth.offset_m", "list of 3 numbers"),
        ("run.workers", "whole number, >= 1, <= 100000 or nothing"),
        ("assets.objects[urdf].up", "`x`, `y`, `z` or map"),
    ],
)
def test_types_and_bounds_are_told_in_words(key, words):
    assert describe_allowed(dict(list_keys())[key]) == words


def test_allowed_keys_are_the_siblings_also_below_a_position_in_a_list():
    assert allowed_keys(["assets", "split", "trian"]) == ["test", "train", "val"]
    assert {"diagonal_m", "folder", "instances"} <= set(allowed_keys(["assets", "objects", "0", "wieght"]))
