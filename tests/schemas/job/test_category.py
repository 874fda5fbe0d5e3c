"""Categories have any names that the job's sources offer."""

import pytest
from pydantic import ValidationError

from schemas.job.assets import CATEGORIES, offered_by
from schemas.job.job import Job

FRUIT = {"source": "urdf", "folder": "fruit", "category_map": {"*.obj": "banana", "*.glb": "Pear-2", "t.obj": "table"}}


def job(**keys):
    return Job.model_validate({"name": "t", **keys})


def test_without_categories_a_job_has_all_that_its_sources_offer_once():
    assert tuple(job().categories) == CATEGORIES
    assert job(assets={"objects": [FRUIT]}).categories == {"banana": 1.0, "Pear-2": 1.0}
    mixed = {"objects": [FRUIT, {"source": "procedural"}, FRUIT]}
    assert list(job(assets=mixed).categories) == ["banana", "Pear-2", *CATEGORIES]
    assert "box" not in job(assets={"objects": [{"source": "shapenet", "folder": "s"}]}).categories


def test_a_folder_without_a_map_may_offer_anything_until_it_is_listed():
    packaged = {"source": "urdf", "folder": "pybullet_data"}
    assert tuple(job(assets={"objects": [packaged]}).categories) == CATEGORIES
    assert job(assets={"objects": [packaged]}, categories=["brick"]).categories == {"brick": 1.0}


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["mugg"], "no source offers it; did you mean 'mug'[?] offered: banana, Pear-2, bottle"),
        (["bananna"], "did you mean 'banana'"),
        (["zebra"], "no source offers it; offered: banana"),
        (["a/b"], "letters, digits, - and _"),
        (["../x"], "letters, digits"),
        ([""], "letters, digits"),
        (["x" * 65], "1 to 64"),
        (["002"], "write a letter too, such as n002"),
        (["table"], "what objects stand on"),
        (["Manifest"], "a folder of this name"),
    ],
)
def test_a_name_that_cannot_be_is_refused_with_the_remedy(names, words):
    sources = {"objects": [FRUIT, {"source": "procedural"}]}
    with pytest.raises(ValidationError, match=words) as refusal:
        job(assets=sources, categories=names)
    assert "[A-Za-z" not in str(refusal.value)


def test_a_map_refuses_the_same_names_and_takes_table():
    with pytest.raises(ValidationError, match="names a folder"):
        job(assets={"objects": [{**FRUIT, "category_map": {"*.obj": "a b"}}]})
    assert job(assets={"objects": [FRUIT]}).assets.objects[0].category_map["t.obj"] == "table"


def test_what_is_malformed_offers_nothing():
    assert offered_by([{}, {"source": 3}, {"source": "urdf", "category_map": 7}, {"source": "urdf"}]) == ()
