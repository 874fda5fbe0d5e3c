"""Categories by pattern, units and the axis that is up, guessed for a folder of meshes."""

import pytest

from services.init.collection import Item
from services.init.guess import (
    category_of,
    guess_scales,
    guess_ups,
    is_category,
    map_categories,
    plain_axis,
)
from workers.assets.external.placement import Measured


@pytest.mark.parametrize(
    ("path", "source", "category"),
    [
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
    ],
)
def test_a_category_follows_from_where_a_file_lies(path, source, category):
    assert category_of(path, source) == category
    assert is_category(category)


CASES = {
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


@pytest.mark.parametrize("name", CASES)
def test_patterns_find_the_files_of_their_category_and_no_others(tmp_path, name):
    items, others, harmless = CASES[name]
    for path in (*items, *others):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    found: dict[str, str] = {}
    for pattern, category in map_categories(items, others, harmless).items():
        for path in tmp_path.glob(pattern):
            if path.is_file():
                found.setdefault(path.relative_to(tmp_path).as_posix(), category)
    assert {path: category for path, category in found.items() if path not in harmless} == items


def item(path, extents=(0.1, 0.1, 0.1), up=None, confidence="sure"):
    return Item(path, "c", Measured(extents, 8, 12, True, 0, (), up, confidence if up else None), path)


def cubes(*diagonals, suffix=".obj"):
    return [item(f"{k}{suffix}", (d / 3**0.5,) * 3) for k, d in enumerate(diagonals)]


@pytest.mark.parametrize(
    ("diagonals", "factor", "words"),
    [
        ((0.2, 0.3), 1.0, "metres"),
        ((250.0,), 0.001, "millimetres, 25 cm"),
        ((25.0,), 0.01, "centimetres, 25 cm (as millimetres, 0.001, it would be 2.5 cm)"),
        ((1.0, 0.4, 0.7), 1.0, "metres"),
        ((0.0001,), 1.0, "very small"),
        ((3000.0, 150.0, 200.0), 0.001, "millimetres"),
    ],
)
def test_the_unit_is_one_that_things_on_a_table_have(diagonals, factor, words):
    (scale,) = guess_scales(cubes(*diagonals))
    assert (scale.factor, scale.diagonal_m) == (factor, None) and words in scale.why


def test_shapes_that_are_normalised_are_resized_and_a_single_one_is_not():
    (scale,) = guess_scales(cubes(1.0, 1.0, 1.001))
    assert scale.diagonal_m == 0.25 and "all alike" in scale.why
    assert guess_scales(cubes(1.0))[0].diagonal_m is None
    assert guess_scales(cubes(0.12, 0.12, 0.12))[0].diagonal_m is None, "three cups of one size"


def test_formats_with_different_units_are_different_sources():
    scales = guess_scales([*cubes(250.0), *cubes(0.2, suffix=".glb"), *cubes(300.0, suffix=".stl")])
    assert {scale.suffixes: scale.factor for scale in scales} == {(".glb",): 1.0, (".obj", ".stl"): 0.001}


def ups(*items):
    return {rule.pattern: rule.axis for rule in guess_ups(items)}


def test_a_format_follows_its_files_that_are_sure_and_one_that_is_sure_of_another_axis_is_named():
    sure = [item(f"{k}.obj", up="y") for k in range(5)]
    assert ups(*sure, item("box.obj")) == {"**/*.obj": "y"}
    assert ups(*sure, item("odd [1].obj", up="z")) == {"odd [[]1].obj": "z", "**/*.obj": "y"}
    assert plain_axis(guess_ups(sure)) == "y"


def test_a_folder_that_is_sure_of_another_axis_has_a_line_of_its_own():
    mine = [item(f"mine/{k}.obj", up="z") for k in range(6)]
    theirs = [item(f"theirs/{k}.obj", up="y") for k in range(2)]
    assert ups(*mine, *theirs, item("theirs/box.obj")) == {"theirs/**/*.obj": "y", "**/*.obj": "z"}


def test_gltf_has_y_up_unless_its_shapes_are_sure_of_another():
    assert ups(item("box.glb"), item("a.gltf", up="z", confidence="likely")) == {"**/*.glb": "y", "**/*.gltf": "y"}
    assert ups(item("mug.glb", up="z")) == {"**/*.glb": "z"}


def test_what_is_only_likely_counts_where_nothing_is_sure_and_nothing_at_all_is_said_to_be_unknown():
    (rule,) = guess_ups([item("a.obj", up="y", confidence="likely"), item("b.obj")])
    assert rule.axis == "y" and rule.why.startswith("likely: 1 of 2")
    (rule,) = guess_ups([item("a.obj"), item("b.obj")])
    assert rule.axis == "z" and rule.why.startswith("not known")
    assert ups(item("a.obj", up="y"), item("b.obj", up="x")) == {"a.obj": "y", "b.obj": "x", "**/*.obj": "z"}
