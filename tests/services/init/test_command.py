"""`verso init`, and the job file that it writes."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.errors import MachineError
from schemas.job.assets import FolderSource
from services.cli.main import main
from services.init import command
from services.init.collection import Guess
from services.init.command import write_job
from services.init.guess import guess_scales, guess_ups
from services.job.bounded_yaml import parse_yaml
from services.job.job_file import load_job, validate_job
from tests.own_meshes import cup, mixed_folder, write_gltf, write_mesh
from tests.services.init.test_guess import cubes, item
from workers.assets.catalogue import open_catalogue


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    return mixed_folder(tmp_path_factory.mktemp("own") / "mixed meshes")


def init(*words, capsys):
    code = main(["init", *map(str, words)])
    told = capsys.readouterr()
    return code, told.out, told.err


def test_a_mixed_folder_becomes_a_job_that_offers_exactly_what_was_shown(mixed, tmp_path, capsys):
    out = tmp_path / "mine.yaml"
    code, told, _ = init(mixed, "--out", out, "--json", capsys=capsys)
    answer = json.loads(told.splitlines()[-1])
    assert (code, answer["ok"], answer["job"], answer["sheet"]) == (0, True, str(out), str(tmp_path / "mine.jpg"))
    job = load_job(out)
    catalogue = open_catalogue(job.assets, out.parent, tuple(job.categories))
    offered = {
        entry.files[0].path: category
        for listing in catalogue.objects
        for category, entries in listing.entries.items()
        for number, entry in enumerate(entries)
        if number not in listing.refused.get(category, ())
    }
    assert offered == {one["path"]: one["category"] for one in answer["objects"]} and len(offered) == 10
    assert (
        set(offered.values())
        == set(job.categories)
        == {"002_can", "bottles", "gltf-cup", "mugs", "robot", "standing", "table_mesh"}
    )
    assert all(not listing.doubts for listing in catalogue.objects), "nothing lies on its side"
    heights = {one["path"]: one["size_m"][2] for one in answer["objects"]}
    true = {"mugs/mug_2.glb": 0.12, "standing.glb": 0.09, "bottles/bottle 0.stl": 0.2, "gltf cup/model.gltf": 0.1}
    assert {path: heights[path] for path in true} == pytest.approx(true, abs=1e-6)
    reasons = {one["path"]: one["reason"] for one in answer["left_out"]}
    assert reasons["huge.stl"] == "size" and reasons["scene.dae"] == "format" and reasons["mugs/out.glb"] == "link"
    with Image.open(tmp_path / "mine.jpg") as page:
        assert page.size[0] > 1500 and np.asarray(page).std() > 20


def test_what_is_on_the_terminal_fits_it_and_says_what_next(mixed, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    code, told, _ = init(mixed, "--out", tmp_path / "a.yaml", "--sheet", tmp_path / "a.png", capsys=capsys)
    table = told.partition("a.yaml")[0].splitlines()[:-1]
    assert code == 0 and all(len(line) <= 90 for line in table)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert f"verso run {tmp_path / 'a.yaml'} --scenes 8" in told
    assert (
        "2 meshes not offered by themselves" in told and "torn.gltf (missing): its buffer gone.bin is missing" in told
    )


def test_nothing_is_overwritten(mixed, tmp_path, capsys):
    for name, words in (("a.yaml", ()), ("b.jpg", ("--sheet", tmp_path / "b.jpg"))):
        (tmp_path / name).write_text("mine")
        code, _, err = init(mixed, "--out", tmp_path / "a.yaml", *words, capsys=capsys)
        assert (code, err.count("\n")) == (2, 1) and "is there already" in err
        assert (tmp_path / name).read_text() == "mine"
        (tmp_path / name).unlink()


@pytest.mark.parametrize(
    ("by", "categories"),
    [("folder", {"x", "mug"}), ("file", {"cup", "mug"}), ("thing", {"thing"}), (None, {"x", "mug"})],
)
def test_categories_are_named_as_asked(tmp_path, capsys, by, categories):
    for name in ("x/cup_1.stl", "x/cup_2.stl", "mug 3.stl"):
        write_mesh(tmp_path / "m" / name, cup(0.1 + 0.01 * int(name[-5])))
    words = () if by is None else ("--category-from", by)
    assert init(tmp_path / "m", "--out", tmp_path / "j.yaml", *words, capsys=capsys)[0] == 0
    assert set(load_job(tmp_path / "j.yaml").categories) == categories
    assert "folder: m\n" in (tmp_path / "j.yaml").read_text(), "relative to the job file"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("none",), "none is not there"),
        (("empty",), "empty is empty"),
        (("broken",), "none of its 1 meshes can be used"),
        (("good", "--category-from", "a/b"), "--category-from a/b: write folder, file, or a name"),
        (("good", "--category-from", "table"), "--category-from table"),
        (("good", "--sheet", "a.gif"), "must end in .jpg or .png"),
        (("good", "--out", "file/a.yaml"), "cannot be written"),
    ],
)
def test_wrong_input_is_one_clear_line_and_leaves_nothing(tmp_path, capsys, monkeypatch, words, says):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    write_mesh(Path("good/a.stl"), cup())
    Path("broken").mkdir()
    Path("broken/a.obj").write_text("v 0 0 0\n")
    Path("file").write_text("")
    before = sorted(tmp_path.rglob("*"))
    code, _, err = init(*words, capsys=capsys)
    assert code == 2 and says in err.splitlines()[-1] and err.splitlines()[-1].startswith("verso: ")
    assert len(err.splitlines()) <= 3 and "Traceback" not in err
    assert sorted(tmp_path.rglob("*")) == before


def test_without_opengl_there_is_a_job_and_no_picture_unless_one_was_asked_for(tmp_path, capsys, monkeypatch):
    def no_gl():
        raise MachineError("no OpenGL here: install libegl1")

    monkeypatch.setattr(command, "shared_renderer", no_gl)
    write_gltf(tmp_path / "m", cup())
    code, _, err = init(tmp_path / "m", "--out", tmp_path / "a.yaml", capsys=capsys)
    assert code == 0 and err == "verso: no pictures: no OpenGL here: install libegl1\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.yaml", "m"]
    code, _, err = init(tmp_path / "m", "--out", tmp_path / "b.yaml", "--sheet", tmp_path / "b.png", capsys=capsys)
    assert code == 1 and "install libegl1" in err


@pytest.mark.minute
@pytest.mark.shared_data
def test_scanned_meshes_offer_their_urdfs_and_a_bottle_that_lies_is_stood_up(tmp_path, capsys):
    meshes = Path(__file__).resolve().parents[4] / "shared" / "data" / "meshes"
    code, told, _ = init(meshes, "--out", tmp_path / "j.yaml", "--json", capsys=capsys)
    objects = {one["category"]: one for one in json.loads(told.splitlines()[-1])["objects"]}
    assert code == 0 and set(objects) == {"blue_cup", "bowl", "cracker_box", "mug", "shampoo"}
    assert {name: one["up"] for name, one in objects.items()} == dict.fromkeys(objects, "z") | {"shampoo": "y"}
    assert objects["shampoo"]["size_m"][2] == pytest.approx(0.1686, abs=1e-3)
    assert "20000" in told and "0 of 1" in told
    assert objects["mug"]["missing_textures"] == 1 and objects["blue_cup"]["textures"] == 1


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
