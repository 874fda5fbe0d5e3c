"""Files of a source: remembered, and noticed when they change."""

import pickle

import pytest

from schemas.errors import MeshError
from tests.workers.assets.oracles import CUBE, write
from workers.assets.external.listing import Entry, check_unchanged, describe_folder, hash_files, list_entries


def test_a_file_that_changed_since_is_noticed(tmp_path):
    path = write(tmp_path / "cube.obj", CUBE)
    entry = Entry("id", hash_files([path], tmp_path), "MIT")
    check_unchanged(tmp_path, entry)
    write(path, CUBE + "# more\n")
    with pytest.raises(MeshError, match="changed") as changed:
        check_unchanged(tmp_path, entry)
    path.unlink()
    with pytest.raises(MeshError, match="missing") as missing:
        check_unchanged(tmp_path, entry)
    # Neither is a function of job and seed, and it stays so on the way to another process.
    assert {pickle.loads(pickle.dumps(error.value)).kind for error in (changed, missing)} == {"environmental"}


def test_a_message_names_the_first_things_of_a_folder(tmp_path):
    assert describe_folder(tmp_path) == "nothing"
    for name in "gfedcba":
        write(tmp_path / name, "")
    assert describe_folder(tmp_path) == "a, b, c, d, e and 2 more"


def test_refused_candidates_are_counted_by_reason_and_others_keep_their_order(tmp_path):
    def make_entry(name):
        if name in ("a", "c"):
            raise MeshError("format" if name == "a" else "missing", name)
        return Entry(name, (), "MIT")

    listing = list_entries(tmp_path, {"mug": ["c", "d", "b"], "can": ["a", "c"]}, make_entry)
    assert {name: [e.instance_id for e in found] for name, found in listing.entries.items()} == {
        "mug": ["d", "b"],
        "can": [],
    }
    assert list(listing.skipped.items()) == [("format", 1), ("missing", 2)]
