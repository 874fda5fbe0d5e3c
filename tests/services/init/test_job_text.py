"""The job file that is written: it is a job, and says what was guessed."""

from collections import Counter

import pytest

from schemas.job.assets import FolderSource
from services.init.collection import Guess
from services.init.command import write_job
from services.init.guess import guess_scales, guess_ups
from services.job.bounded_yaml import parse_yaml
from services.job.job_file import validate_job
from tests.services.init.test_guess import cubes, item


def job_of(items, folder="meshes", category_map=None, sheet="s.jpg"):
    guess = Guess(
        tuple(guess_scales(items)), tuple(guess_ups(items)), category_map or {one.path: "thing" for one in items}
    )
    counts, suffixes = Counter({"thing": len(items)}), Counter(one.suffix for one in items)
    text = write_job("mine", "mine.yaml", folder, sheet, counts, suffixes, guess)
    return text, validate_job(parse_yaml(text), "j")


def test_it_is_a_job_with_its_guesses_and_the_reasons_beside_them():
    text, job = job_of(cubes(250.0, 300.0))
    (source,) = job.assets.objects
    assert isinstance(source, FolderSource)
    assert (source.scale, source.up, source.folder, source.copy_assets) == (0.001, "z", "meshes", False)
    assert job.categories == {"thing": 1.0} and job.scenes == 64
    assert "# .obj: 275 units across (the middle one): taken for millimetres, 27.5 cm" in text
    assert "# **/*.obj: not known: the shapes stand on several axes or on none" in text
    assert "look at the pictures (s.jpg)" in text


def test_axes_that_differ_are_a_map_by_pattern():
    items = [item(f"{k}.obj", up="z") for k in range(4)] + [item("odd: {1}.obj", up="y"), item("a.glb", up="y")]
    text, job = job_of(items)
    assert job.assets.objects[0].up == {"odd: {1}.obj": "y", "**/*.glb": "y", "**/*.obj": "z"}
    assert '# stands on this axis alone, unlike its neighbours\n        "odd: {1}.obj": y' in text


def test_two_units_are_two_sources_that_share_no_file_and_weigh_as_many_as_they_have():
    items = [*cubes(250.0, 260.0), *cubes(0.2, suffix=".glb")]
    _, job = job_of(items)
    maps = {tuple(source.category_map): (source.scale, source.weight) for source in job.assets.objects}
    assert maps == {("0.glb",): (1.0, 1.0), ("0.obj", "1.obj"): (0.001, 2.0)}


@pytest.mark.parametrize(
    "name", ["~", "null", "a b", "ü", "a'b\"c", "[x]", "#1", "yes", "a\\b", "- x", "1e3", "%x", "&a", "*", "0_1"]
)
def test_a_strange_folder_or_file_is_written_as_it_is(name):
    _, job = job_of([item(f"{name}.obj")], folder=name, category_map={f"{name}.obj": "thing"})
    assert job.assets.objects[0].folder == name
    assert list(job.assets.objects[0].category_map) == [f"{name}.obj"]


@pytest.mark.parametrize("category", ["no", "null", "0_1e", "1_000a", "on", "1e3", "thing"])
def test_a_category_is_the_word_that_it_was(category):
    items = cubes(0.2)
    guess = Guess(tuple(guess_scales(items)), tuple(guess_ups(items)), {"*.obj": category})
    text = write_job("mine", "mine.yaml", "m", None, {category: 1}, {".obj": 1}, guess)
    assert list(validate_job(parse_yaml(text), "j").categories) == [category]
