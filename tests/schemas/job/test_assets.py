"""The axis of a file that is up: one letter for all, or a map from patterns."""

import pytest
from pydantic import ValidationError

from schemas.job.assets import FolderSource
from schemas.job.identity import job_digest
from schemas.job.job import Job


def source(**keys):
    return FolderSource(source="urdf", folder="m", **keys)


def test_the_first_pattern_wins_and_what_none_matches_has_z_up():
    mixed = source(up={"odd/a.glb": "x", "**/*.glb": "y"})
    assert [mixed.up_of(name) for name in ("odd/a.glb", "odd/b.glb", "c.glb", "c.obj")] == ["x", "y", "y", "z"]
    assert [source(up="y").up_of(name) for name in ("a.obj", "b/c.glb")] == ["y", "y"]
    assert source().up_of("a.obj") == "z"


@pytest.mark.parametrize("up", ["w", "Y", {}, {"*.glb": "up"}, {"*.glb": None}, ["y"], 3, None, {"*.glb": ["y"]}])
def test_what_is_no_axis_is_refused_in_one_line(up):
    with pytest.raises(ValidationError) as caught:
        source(up=up)
    (fault,) = caught.value.errors()
    assert "must be x, y or z, or a map" in fault["msg"]


def test_the_digest_of_a_job_with_a_plain_letter_is_the_one_that_it_had():
    """As the version before maps computed it."""
    keys = {"source": "urdf", "folder": "m", "category_map": {"*.obj": "mug"}, "up": "y"}
    job = Job(name="j", assets={"objects": [keys]})
    assert job_digest(job, "c" * 64) == "2a98cd36192d5711e6a2502d718b8a394dcd9aed87ac5985e007aab10ed1d3f3"
