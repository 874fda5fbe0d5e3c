"""Categories by where files lie, and patterns that find them, held to pathlib's own glob."""

import pytest

from services.init.guess import category_of, is_category, map_categories, usable_name
from services.job.bounded_yaml import parse_yaml


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


@pytest.mark.parametrize(
    "text", ["", "---", "1", "table", "TABLE", "manifest", "a/b", "\x00", "x" * 300, "9" * 64, "😀", "_a_"]
)
def test_any_text_becomes_a_name(text):
    assert is_category(usable_name(text))


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


def test_a_folder_a_category_has_one_pattern():
    items = {f"{name}/{k}.obj": name for name in ("mug", "can") for k in range(100)}
    assert map_categories(items, (), ()) == {"can/*.obj": "can", "mug/*.obj": "mug"}


def test_names_are_yaml_as_they_are():
    assert parse_yaml(f"{{{category_of('no/a.obj', None)}_: 1}}") == {"no_": 1}
