import pytest

from schemas.job.keys import set_key


def test_a_key_is_set_at_every_depth_and_missing_branches_are_made():
    tree = {"a": {"b": 1}, "list": [{"c": 2}, 3]}
    set_key(tree, "a.d.e", 4)
    set_key(tree, "list.0.c", 5)
    set_key(tree, "list.1", 6)
    set_key(tree, "new", 7)
    assert tree == {"a": {"b": 1, "d": {"e": 4}}, "list": [{"c": 5}, 6], "new": 7}


def test_keep_fills_only_what_is_missing():
    tree = {"a": {"b": 1, "none": None}}
    for path in ("a.b", "a.none", "a.c"):
        set_key(tree, path, 9, keep=True)
    assert tree == {"a": {"b": 1, "none": None, "c": 9}}


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("number.key", "'number' is 3 and has no keys"),
        ("number.key.more", "3 has no key 'key'"),
        ("nothing.key", "there is nothing at 'nothing'"),
        ("list.2", "'2' must be a position from 0 to 1"),
        ("list.first.key", "'first' must be a position from 0 to 1"),
    ],
)
def test_a_path_through_a_value_without_keys_is_refused(path, message):
    with pytest.raises(ValueError, match=message):
        set_key({"number": 3, "nothing": None, "list": [1, 2]}, path, 0)
