import hashlib

import pytest

from services.merge.digest import dataset_digest

TABLES = {"scenes": "1", "views": "2", "objects": "3", "assets": "4", "failures": "5", "timings": "6"}


def test_the_digest_is_that_of_the_tables_and_the_sorted_files():
    text = "verso dataset 1\nscenes 1\nviews 2\nobjects 3\nassets 4\nfailures 5\na/b\nx\na/ü\ny\n"
    assert dataset_digest(TABLES, [("a/b", "x"), ("a/ü", "y")]) == hashlib.sha256(text.encode()).hexdigest()


def test_timings_are_no_part_of_it():
    assert dataset_digest({**TABLES, "timings": "other"}, []) == dataset_digest(TABLES, [])


@pytest.mark.parametrize("paths", [["b", "a"], ["a", "a"], ["ü", "z"]])
def test_paths_out_of_order_or_twice_are_refused(paths):
    with pytest.raises(ValueError, match="sorted and unique"):
        dataset_digest(TABLES, [(path, "x") for path in paths])
