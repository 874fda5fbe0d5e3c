"""Categories by pattern, units and the axis that is up, guessed for a folder of meshes; and the job that says so."""

from schemas.job.assets import FolderSource
from services.init.collection import Guess, Item, drop_doubles
from services.init.command import write_job
from services.init.guess import category_of, guess_scales, guess_ups, is_category, map_categories, plain_axis
from services.job.bounded_yaml import parse_yaml
from services.job.job_file import validate_job
from workers.assets.external.placement import Measured

CATEGORIES = (
    ("mug/a.obj", None, "mug"),
    ("mug/b/c.obj", None, "mug"),
    ("002_master_chef_can/google_16k/textured.obj", None, "002_master_chef_can"),
    ("mug_03.obj", None, "mug"),
    ("mug 3.obj", "folder", "mug"),
    ("Blue Cup-12.glb", None, "Blue-Cup"),
    ("mug/a_7.obj", "file", "a"),
    ("mug/a_7.obj", "thing", "thing"),
    ("007.obj", None, "n007"),
    ("12/a.obj", None, "n12"),
    ("table/a.obj", None, "table_mesh"),
    ("Assets/a.obj", None, "Assets_mesh"),
    ("ä/ö.obj", None, "object"),
    ("näme/a.obj", None, "n-me"),
    (f"{'long' * 40}/a.obj", None, "long" * 16),
)
FOLDERS = {
    "one folder each": ({"mug/a.obj": "mug", "mug/b.obj": "mug", "can/a.obj": "can"}, (), ()),
    "deep": ({"mug/1/m.obj": "mug", "mug/2/m.obj": "mug", "mug/2/x/n.obj": "mug"}, (), ()),
    "flat": ({"mug_1.obj": "mug", "mug_2.obj": "mug", "mugtree.obj": "mugtree"}, (), ()),
    "two formats": ({"a/m.obj": "a", "a/n.OBJ": "a", "a/m.glb": "a"}, (), ()),
    "beside what is left out": ({"a/m.obj": "a", "a/n.obj": "a"}, ("a/dup.obj", "a/x.stl"), ()),
    "beside what is broken": ({"a/m.obj": "a", "a/n.obj": "a"}, ("a/torn.obj",), ("a/torn.obj",)),
    "strange names": ({"[a]/*.obj": "a", "[a]/b?.obj": "a", "b'\"/ü #.obj": "b"}, ("a/c.obj",), ()),
    "urdfs": ({"x/model.urdf": "x", "y/model.urdf": "y", "z/q/model.urdf": "z"}, ("x/textured.obj",), ()),
    "one category": ({"a/m.obj": "t", "b/c/n.obj": "t", "o.obj": "t"}, (), ()),
    "one category, some out": ({"a/m.obj": "t", "b/c/n.obj": "t", "o.obj": "t"}, ("b/p.obj",), ()),
}


def test_a_category_follows_from_where_a_file_lies():
    for path, source, category in CATEGORIES:
        assert category_of(path, source) == category and is_category(category)


def test_patterns_find_the_files_of_their_category_and_no_others(tmp_path):
    for name, (items, others, harmless) in FOLDERS.items():
        folder = tmp_path / name
        for path in (*items, *others):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).touch()
        found: dict[str, str] = {}
        for pattern, category in map_categories(items, others, harmless).items():
            for path in folder.glob(pattern):
                if path.is_file():
                    found.setdefault(path.relative_to(folder).as_posix(), category)
        assert {path: category for path, category in found.items() if path not in harmless} == items, name


def item(path, extents=(0.1, 0.1, 0.1), up=None, confidence="sure"):
    return Item(path, "c", Measured(extents, 8, 12, True, 0, (), up, confidence if up else None), path)


def cubes(*diagonals, suffix=".obj"):
    return [item(f"{k}{suffix}", (d / 3**0.5,) * 3) for k, d in enumerate(diagonals)]


def test_the_unit_is_one_that_things_on_a_table_have_and_what_is_normalised_is_resized():
    for diagonals, factor, diagonal_m, words in (
        ((0.2, 0.3), 1.0, None, "metres"),
        ((250.0,), 0.001, None, "millimetres, 25 cm"),
        ((25.0,), 0.01, None, "centimetres, 25 cm (as millimetres, 0.001, it would be 2.5 cm)"),
        ((1.0, 0.4, 0.7), 1.0, None, "metres"),
        ((0.0001,), 1.0, None, "very small"),
        ((3000.0, 150.0, 200.0), 0.001, None, "millimetres"),
        ((1.0, 1.0, 1.001), 1.0, 0.25, "all alike"),
        ((1.0,), 1.0, None, "metres"),  # a single one
        ((0.12, 0.12, 0.12), 1.0, None, "metres"),  # three cups of one size
    ):
        (scale,) = guess_scales(cubes(*diagonals))
        assert (scale.factor, scale.diagonal_m) == (factor, diagonal_m) and words in scale.why
    scales = guess_scales([*cubes(250.0), *cubes(0.2, suffix=".glb"), *cubes(300.0, suffix=".stl")])
    assert {scale.suffixes: scale.factor for scale in scales} == {(".glb",): 1.0, (".obj", ".stl"): 0.001}


def test_up_follows_the_files_that_are_sure_and_others_are_named_apart():
    def ups(*items):
        return {rule.pattern: rule.axis for rule in guess_ups(items)}

    sure = [item(f"{k}.obj", up="y") for k in range(5)]
    assert ups(*sure, item("box.obj")) == {"**/*.obj": "y"} and plain_axis(guess_ups(sure)) == "y"
    assert ups(*sure, item("odd [1].obj", up="z")) == {"odd [[]1].obj": "z", "**/*.obj": "y"}
    mine, theirs = (
        [item(f"{name}/{k}.obj", up=up) for k in range(n)] for name, up, n in (("a", "z", 6), ("b", "y", 2))
    )
    assert ups(*mine, *theirs, item("b/box.obj")) == {"b/**/*.obj": "y", "**/*.obj": "z"}, "a folder has a line"
    assert ups(item("box.glb"), item("a.gltf", up="z", confidence="likely")) == {"**/*.glb": "y", "**/*.gltf": "y"}
    assert ups(item("mug.glb", up="z")) == {"**/*.glb": "z"}, "by the specification, unless the shapes are sure"
    assert ups(item("a.obj", up="y"), item("b.obj", up="x")) == {"a.obj": "y", "b.obj": "x", "**/*.obj": "z"}
    for confidence, axis, why in (("likely", "y", "likely: 1 of 2"), (None, "z", "not known")):
        (rule,) = guess_ups([item("a.obj", up=confidence and "y", confidence=confidence), item("b.obj")])
        assert rule.axis == axis and rule.why.startswith(why)


def test_of_one_mesh_in_several_formats_the_first_stays_and_different_names_are_different_meshes():
    items = [item(f"a/m{suffix}") for suffix in (".stl", ".obj", ".glb")] + [item("a/n.obj"), item("b/m.obj")]
    kept, left_out = drop_doubles(items)
    assert [one.path for one in kept] == ["a/m.glb", "a/n.obj", "b/m.obj"]
    assert {one.path for one in left_out} == {"a/m.stl", "a/m.obj"}


# ------------------------------------------------------------------------------------------------ the text of the job


def job_of(items, folder="meshes", category_map=None):
    found = category_map or {one.path: "thing" for one in items}
    guess = Guess(tuple(guess_scales(items)), tuple(guess_ups(items)), found)
    kinds = [(found.get(one.path, next(iter(found.values()))), one.suffix) for one in items]
    text = write_job("mine", "mine.yaml", folder, "s.jpg", kinds, guess)
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


def test_axes_that_differ_are_a_map_by_pattern_and_units_that_differ_are_sources_of_their_own():
    items = [item(f"{k}.obj", up="z") for k in range(4)] + [item("odd: {1}.obj", up="y"), item("a.glb", up="y")]
    text, job = job_of(items)
    assert job.assets.objects[0].up == {"odd: {1}.obj": "y", "**/*.glb": "y", "**/*.obj": "z"}
    assert '# stands on this axis alone, unlike its neighbours\n        "odd: {1}.obj": y' in text
    _, job = job_of([*cubes(250.0, 260.0), *cubes(0.2, suffix=".glb")])
    maps = {tuple(source.category_map): (source.scale, source.weight) for source in job.assets.objects}
    assert maps == {("0.glb",): (1.0, 1.0), ("0.obj", "1.obj"): (0.001, 2.0)}, "which weigh as many as they have"


def test_strange_names_are_written_as_they_are():
    for name in ("~", "null", "a b", "ü", "a'b\"c", "[x]", "#1", "yes", "a\\b", "- x", "1e3", "%x", "&a", "*", "0_1"):
        _, job = job_of([item(f"{name}.obj")], folder=name)
        assert job.assets.objects[0].folder == name and list(job.assets.objects[0].category_map) == [f"{name}.obj"]
    for category in ("no", "null", "0_1e", "1_000a", "on", "1e3", "thing"):
        assert list(job_of(cubes(0.2), category_map={"*.obj": category})[1].categories) == [category]
