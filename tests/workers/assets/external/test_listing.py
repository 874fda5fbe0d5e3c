"""Files of a source: remembered, and noticed when they change."""

import pickle

import pytest

from schemas.errors import MeshError
from tests.workers.assets.oracles import CUBE, write
from workers.assets.external.listing import (
    Entry,
    check_unchanged,
    describe_folder,
    find_licence,
    hash_files,
    list_licences,
)


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


def test_the_nearest_licence_file_is_named_unless_the_user_states_one(tmp_path):
    for path in ("LICENSE", "mug/licence.txt", "mug/a/mug.obj", "bowl/bowl.obj"):
        write(tmp_path / path, "x")
    files = list_licences(tmp_path)
    assert find_licence(tmp_path / "mug/a/mug.obj", tmp_path, "unknown", files) == "see mug/licence.txt"
    assert find_licence(tmp_path / "bowl/bowl.obj", tmp_path, "unknown", files) == "see LICENSE"
    assert find_licence(tmp_path / "bowl/bowl.obj", tmp_path, "MIT", files) == "MIT"
    assert find_licence(tmp_path / "bowl/bowl.obj", tmp_path, "unknown", []) == "unknown"
